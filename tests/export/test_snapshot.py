"""What an export takes of a scene is what the renderer would show of it."""

import re
from dataclasses import replace

import pytest
import torch
from exported import started

from heatsplat.contracts import SceneError
from heatsplat.export.moment import moments
from heatsplat.export.snapshot import _ends, _Visible, snapshot
from heatsplat.shots import at_time

TOLERANCE = 0.05
FEW = "data.frames=8"  # of scenes that take long to film


def started_alone(folder, *overrides):
    """A module at its first step whose scene has no truth, which takes longest to be put into a table."""
    module = started(folder, *overrides)
    module.scene = replace(module.scene, truth=None)
    return module


def shown(layer, time_s):
    values = layer.basis.at(time_s)
    return values.clamp(0, 1) if layer.clipped else values


@pytest.mark.parametrize("composite", ["temperature", "stefan_boltzmann"])
def test_emission_over_time_is_that_of_the_model(tmp_path, composite):
    module = started_alone(tmp_path, "method=etgs", "thermal.frequencies=4", f"composite={composite}")
    seen, scene = snapshot(module), module.scene
    camera = seen.layers[0]
    assert camera.name == "camera" and camera.worst <= TOLERANCE and seen.unit == "°C"
    low, high = seen.table_ends
    for frame in scene.train.frames[:: len(scene.train) // 4]:
        expected = scene.thermal_range.to_celsius(module.emissions(module.splats, frame)[:, 0])
        place = (shown(camera, frame.time_s) - low) / (high - low) * (len(seen.table) - 1)
        below = place.long().clamp(0, len(seen.table) - 2)
        found = seen.table[below] + (place - below) * (seen.table[below + 1] - seen.table[below])
        assert (found - expected.clamp(*seen.limits)).abs().max() <= 1.2 * TOLERANCE


def test_a_coarser_one_has_fewer_samples_and_keeps_to_what_it_aims_at(tmp_path):
    module = started_alone(tmp_path, "method=etgs", "thermal.frequencies=4")
    fine, coarse = (snapshot(module, coarser).layers[0] for coarser in (1.0, 8.0))
    assert (fine.tolerance, coarse.tolerance) == pytest.approx((TOLERANCE, 8 * TOLERANCE))
    assert fine.worst <= TOLERANCE < coarse.worst <= 8 * TOLERANCE
    assert len(coarse.basis.times_s) < len(fine.basis.times_s)


@pytest.mark.parametrize("clipped", [True, False])
def test_a_gaussian_far_beyond_the_range_leaves_the_others_their_temperatures(tmp_path, clipped):
    module = started_alone(tmp_path, "method=etgs", "thermal.frequencies=0", "composite=stefan_boltzmann")
    scene, time_s = module.scene, module.scene.train.frames[3].time_s
    expected = scene.thermal_range.to_celsius(module.emissions(module.splats, scene.train.frames[3])[:, 0])[1:]
    with torch.no_grad():
        module.splats.raw["initial_state"][0] += 10.0
    seen = snapshot(module)
    if not clipped:  # as of surfaces that a camera sees through something
        camera = replace(seen.layers[0], clipped=False)
        ends = _ends([camera], 0.0)
        seen = replace(seen, layers=[camera], table_ends=ends, table=_Visible(module).table(ends))
        assert ends[1] > 5.0
    (moment,) = moments(module, seen, time_s)
    inside = (expected > scene.thermal_range.min_c) & (expected < scene.thermal_range.max_c)
    assert inside.all() and (moment.values[1:] - expected).abs().max() < 1.2 * TOLERANCE


def test_the_truth_of_a_synthetic_scene_is_a_layer(tmp_path):
    module = started(tmp_path, "method=etgs", "thermal.frequencies=0")
    seen, scene = snapshot(module), module.scene
    truth = seen.layers[-1]
    time = scene.train.frames[7].time_s
    expected = scene.truth(seen.means, torch.tensor([time], dtype=torch.float64))[:, 0]
    found = scene.thermal_range.to_celsius(truth.basis.at(time))
    assert truth.name == "truth" and (found - expected).abs().max() < 2 * TOLERANCE


def test_a_static_scene_has_one_moment_and_what_cannot_be_seen_is_left_out(tmp_path):
    module = started(tmp_path, "method=3dgs", "data.scene=static")
    with torch.no_grad():
        module.splats.raw["opacity_logits"][:5] = -20.0
        module.splats.raw["quats"][5] = 0.0
    seen = snapshot(module)
    assert len(seen.means) == len(module.splats) - 6 and bool(seen.quats.any(1).all())
    assert seen.layers[0].basis.rank == 0 and seen.left_out == []


def test_where_nothing_can_be_seen_there_is_nothing_to_export(tmp_path):
    module = started(tmp_path, "method=3dgs", "data.scene=static")
    with torch.no_grad():
        module.splats.raw["opacity_logits"][:] = -20.0
    with pytest.raises(SceneError, match=f"none of the {len(module.splats)} Gaussians of scene 'static' can be seen"):
        snapshot(module)


def test_what_depends_on_the_view_is_said(tmp_path):
    module = started(
        tmp_path, "method=3dgs", "data.scene=static", "thermal.sh_degree=2", "thermal.sh_degree_interval=1"
    )
    module.thermal.on_step(9)
    with torch.no_grad():
        module.splats.raw["sh_rest"].normal_(0, 0.1, generator=torch.Generator().manual_seed(0))
    (said,) = snapshot(module).left_out
    assert "depends on the view" in said and module.scene.train.frames[0].name in said
    usual, worst = (float(number) for number in re.findall(r"by ([0-9.e+-]+) °C", said))
    assert 0 < usual < worst


def test_parts_of_the_heat_can_be_left_out(tmp_path):
    haze = ("data.scene=haze", "data.frames=4")  # each of which sees the scene through air of its own
    module = started_alone(tmp_path, "method=auto", "effects=none", "effects.attenuation=on", *haze)
    seen = snapshot(module)
    (without,) = (layer for layer in seen.layers if layer.name == "without attenuation")
    frame = module.scene.train.frames[0]
    with torch.no_grad(), module.thermal.without("attenuation"):
        bare = module.emissions(module.splats, frame)[:, 0]
    with torch.no_grad():
        whole = module.emissions(module.splats, frame)[:, 0]
    assert without.label == "without attenuation" and not torch.allclose(bare, whole, atol=1e-3)
    assert (shown(without, frame.time_s) - bare.clamp(0, 1)).abs().max() < 1e-3
    assert list(module.thermal.parts) == ["attenuation"]  # and it is back


def test_visible_light_comes_with_its_own_opacity(tmp_path):
    module = started_alone(tmp_path, "method=ravigs", FEW)
    with torch.no_grad():
        module.splats.raw["opacity_logits"][:, 1] -= 1.0
    seen = snapshot(module)
    assert seen.colours.shape == (len(seen.means), 3) and 0 <= seen.colours.min() <= seen.colours.max() <= 1
    assert (seen.colour_opacities < seen.opacities).all()
    assert seen.attributes.keys() >= {"emissivity"}


@pytest.mark.parametrize("method", [pytest.param("energy_balance", marks=pytest.mark.slow), "thermogs", "auto"])
def test_of_many_gaussians_under_weather_few_are_examined(tmp_path, monkeypatch, method):
    """Against the model itself, of all Gaussians at moments of no special kind."""
    monkeypatch.setattr("heatsplat.export.basis.EXAMINED", 100)
    module = started_alone(
        tmp_path, f"method={method}", "data.scene=outdoor", FEW, *(["effects=none"] if method == "auto" else [])
    )
    with torch.no_grad():
        draw = torch.Generator().manual_seed(0)
        for name in set(module.splats.names) & {"log_rate", "raw_sun", "raw_wind", "initial_state"}:
            rows = module.splats[name]
            rows += 0.3 * torch.randn(rows.shape, generator=draw)
    seen, scene = snapshot(module), module.scene
    camera, frame = seen.layers[0], scene.train.frames[0]
    assert camera.worst <= TOLERANCE
    worst = 0.0
    for share in torch.rand(40, generator=draw).tolist():
        time_s = seen.start_s + share * (seen.end_s - seen.start_s)
        true = scene.thermal_range.to_celsius(module.emissions(module.splats, at_time(scene, frame, time_s))[:, 0])
        found = scene.thermal_range.to_celsius(shown(camera, time_s))
        worst = max(worst, (found - true).abs().max().item())
    assert worst <= 1.2 * TOLERANCE


def test_of_very_many_gaussians_the_truth_may_err_by_more(tmp_path, monkeypatch):
    module = started(tmp_path, "method=etgs", "data.scene=cooling")
    few = {layer.name: layer for layer in snapshot(module).layers}
    monkeypatch.setattr("heatsplat.export.snapshot.MANY", len(module.splats) - 1)
    many = {layer.name: layer for layer in snapshot(module).layers}
    assert few["truth"].tolerance == pytest.approx(TOLERANCE) == many["camera"].tolerance
    assert many["truth"].tolerance == pytest.approx(4 * TOLERANCE) and many["truth"].worst <= 4 * TOLERANCE
    assert many["truth"].basis.rank < few["truth"].basis.rank


METHODS = (
    "3dgs",
    "etgs",
    "ti3dgs",
    "ravigs",
    "thermalgs",
    "hexplane_4dgs",
    "thermal3dgs",
    "ntr_gaussian",
    "through_air",
)


@pytest.mark.parametrize("method", METHODS)
def test_some_gaussians_are_what_they_are_among_all(tmp_path, method):
    scene = "outdoor" if method == "ntr_gaussian" else "glass" if method == "ravigs" else "cooling"
    module = started(tmp_path, f"method={method}", f"data.scene={scene}", *([] if scene == "cooling" else [FEW]))
    frame, ids = module.scene.train.frames[3], torch.tensor([2, 5, 40])
    with torch.no_grad():
        sent = [module.emissions(module.splats, frame, some) for some in (None, ids)]
        warm = [module.thermal.temperature(module.splats, frame.time_s or 0.0, some) for some in (None, ids)]
    torch.testing.assert_close(sent[1], sent[0][ids])
    if warm[0] is not None:
        torch.testing.assert_close(warm[1], warm[0][ids])
