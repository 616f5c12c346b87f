"""The Gaussians at a moment: what they are and what is refused."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from heatsplat.contracts import SceneError
from heatsplat.export.basis import constant_basis
from heatsplat.export.moment import checked_box, inside, moments
from heatsplat.shots import at_time


def test_temperatures_are_those_that_the_model_sends(cooling):
    module, scene = cooling.module, cooling.module.scene
    frame = at_time(scene, scene.train.frames[0], 600.0)
    expected = scene.thermal_range.to_celsius(module.emissions(module.splats, frame)[:, 0])
    assert cooling.quantity == "temperature" and len(expected) == len(cooling.values)
    assert (cooling.values.clamp(*cooling.seen.limits) - expected.clamp(*cooling.seen.limits)).abs().max() < 0.1


def test_a_layer_is_what_it_says(cooling):
    (truth,) = moments(cooling.module, cooling.seen, 600.0, "truth")
    expected = cooling.module.scene.truth(cooling.seen.means, torch.tensor([600.0], dtype=torch.float64))[:, 0]
    assert (truth.values - expected).abs().max() < 0.1
    with pytest.raises(SceneError, match=r"layer=surface: this method and scene have camera, truth only"):
        moments(cooling.module, cooling.seen, 600.0, "surface")
    with pytest.raises(SceneError, match="layer must be one of auto, camera"):
        moments(cooling.module, cooling.seen, 600.0, "air")


def test_several_moments_and_none_outside_the_record(cooling):
    found = moments(cooling.module, cooling.seen, [100.0, 600.0, 900.0])
    assert [one.time_s for one in found] == [100.0, 600.0, 900.0]
    assert torch.equal(found[1].values, cooling.values) and not torch.equal(found[0].values, cooling.values)
    with pytest.raises(SceneError, match=r"time=-500 s lies outside the record, which runs from -30.638 to"):
        moments(cooling.module, cooling.seen, -500.0)


@pytest.mark.parametrize(
    ("times", "told"),
    [
        ("abc", "must be .* got abc"),
        ([1.0, "b"], "must be .* got b"),
        (float("nan"), "must be a number, got nan"),
        ([], "must be a number of seconds or a list of them"),
    ],
)
def test_what_is_no_time_is_refused(cooling, times, told):
    with pytest.raises(SceneError, match=f"time {told}"):
        moments(cooling.module, cooling.seen, times)


def test_a_scene_without_times_has_one_moment(cooling):
    still = replace(cooling.layer, basis=constant_basis(cooling.blended))
    seen = replace(cooling.seen, layers=[still], start_s=None, end_s=None)
    (moment,) = moments(cooling.module, seen, None)
    assert moment.time_s is None and torch.equal(moment.values, cooling.values)
    with pytest.raises(SceneError, match="leave time out"):
        moments(cooling.module, seen, 3.0)


@pytest.mark.parametrize("layer", ["auto", "camera"])
def test_nothing_is_beyond_the_range_of_images_where_values_are_clipped(cooling, layer):
    beyond = replace(cooling.layer, name="camera", basis=constant_basis(torch.tensor([-3.0, 0.5, 2.0])), clipped=True)
    found = moments(cooling.module, replace(cooling.seen, layers=[beyond]), 600.0, layer)[0]
    low, high = cooling.seen.limits
    assert found.values.tolist() == pytest.approx([low, 0.5 * (low + high), high], abs=0.01)


def test_a_box_cuts_out_gaussians_in_the_coordinates_of_the_data_set(cooling):
    scene = replace(cooling.module.scene, notes={**cooling.module.scene.notes, "origin": [1000.0, 0.0, -50.0]})
    moved = replace(cooling, module=SimpleNamespace(scene=scene, renderer=cooling.module.renderer))
    high, low = cooling.seen.means.quantile(0.7, dim=0).double(), cooling.seen.means.quantile(0.2, dim=0).double()
    box = checked_box("box", [(high + scene.origin).tolist(), (low + scene.origin).tolist()])
    cut = inside(moved, box)
    kept = ((cooling.seen.means >= low) & (cooling.seen.means <= high)).all(1)
    assert 0 < kept.sum() < len(kept)
    for name in ("means", "quats", "scales", "opacities"):
        assert torch.equal(getattr(cut.seen, name), getattr(cooling.seen, name)[kept])
    assert torch.equal(cut.values, cooling.values[kept]) and cut.quantity == cooling.quantity
    (lasting,) = moments(cooling.module, cut.seen, 600.0)  # its curves over time are those of these Gaussians
    assert torch.equal(lasting.values, cut.values) and torch.equal(
        cut.layer.basis.at(600.0), lasting.layer.basis.at(600.0)
    )
    for name, values in cooling.seen.attributes.items():
        assert torch.equal(cut.seen.attributes[name].nan_to_num(-1), values[kept].nan_to_num(-1))


def test_cameras_see_what_a_box_leaves_out(cooling):
    view = cooling.module.scene.train[0]
    nearest = cooling.seen.means[(view.camera.project(cooling.seen.means)[1]).argmin()].double()
    cut = inside(cooling, torch.stack([nearest - 0.01, nearest + 0.01]))
    assert len(cut.values) < len(cooling.values)
    assert torch.equal(cut.look(view).depth, cooling.look(view).depth)


def test_a_box_without_gaussians_says_where_they_lie(cooling):
    with pytest.raises(
        SceneError, match=r"holds none of the \d+ Gaussians, which lie between \[.*\] and \[.*\] \(98 %"
    ):
        inside(cooling, torch.tensor([[500.0, 0, 0], [501.0, 1, 1]], dtype=torch.float64))


@pytest.mark.parametrize(
    ("box", "told"),
    [
        ([0, 0, 0, 1, 1, 1], "must be two opposite corners"),
        ([[0, 0, 0]], "must be two opposite corners"),
        ([[0, 0], [1, 1]], "must be two opposite corners"),
        ([[0, 0, "a"], [1, 1, 1]], "must be two opposite corners"),
        ([[0, 0, float("nan")], [1, 1, 1]], "must be two opposite corners"),
        ([[0, 0, 0], [1, 0, 1]], "has no volume: its corners must differ in x, y and z"),
    ],
)
def test_what_is_no_box_is_refused(box, told):
    with pytest.raises(SceneError, match=f"box.*{told}"):
        checked_box("box", box)
    assert checked_box("box", None) is None
