"""A scene on the clock and with the temperatures of a run: what other data say of the same moment and of the same pixel."""

from dataclasses import replace

import pytest
import torch
from running import BARE, run

from heatsplat.contracts import SceneError, ThermalRange
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.runs.run import load
from heatsplat.thermal.composed import Composed
from heatsplat.thermal.energy_balance import EnergyBalance
from heatsplat.training.scales import on_scales, scales_of

PARTS = ("train", "val", "test")


@pytest.fixture(scope="module")
def trained():
    """A yard whose first frames train; they are held out of the same yard in ``later``."""
    return Synthetic(scene="outdoor", size="tiny", frames=8, split="block", split_position=1).scene


@pytest.fixture(scope="module")
def later():
    return Synthetic(scene="outdoor", size="tiny", frames=8, split="block", split_position=0).scene


def views_of(scene):
    return {view.frame.name: view for part in PARTS for view in getattr(scene, part)}


def test_a_scene_that_is_divided_otherwise_has_the_moments_of_training(trained, later):
    expected, before = views_of(trained), views_of(later)
    shared = sorted(expected.keys() & before.keys())
    assert len(shared) > 4 and all(before[name].time_s != expected[name].time_s for name in shared)
    scene = on_scales(later, scales_of(trained))
    found = views_of(scene)
    for name in shared:
        assert found[name].time_s == pytest.approx(expected[name].time_s, abs=1e-6)
        assert found[name].frame.environment.air_c == pytest.approx(expected[name].frame.environment.air_c)
    assert [frame.time_s for frame in scene.train.frames] == scene.train.times_s
    moment = expected[shared[2]].time_s
    assert scene.weather.at(moment).air_c == pytest.approx(trained.weather.at(moment).air_c)
    assert scene.weather.notes["utc_at_zero_s"] == pytest.approx(trained.weather.notes["utc_at_zero_s"])
    points, times = scene.points[:5], torch.tensor([moment])
    torch.testing.assert_close(scene.truth(points, times), trained.truth(points, times))


def test_the_clock_of_a_camera_moves_with_second_0(trained, later):
    """Of scenes without weather, which know the time of day by it."""
    scene = replace(later, weather=None, notes={"clock_at_zero_s": 1.7e9})
    moved = on_scales(scene, scales_of(trained))
    before, after = views_of(scene), views_of(moved)
    for name, view in after.items():
        assert moved.notes["clock_at_zero_s"] + view.time_s == pytest.approx(1.7e9 + before[name].time_s, abs=1e-6)
    assert moved.notes["clock_at_zero_s"] != 1.7e9 and scene.notes["clock_at_zero_s"] == 1.7e9


def test_image_values_mean_the_temperatures_of_training(trained):
    bounds = trained.thermal_range
    wider = replace(trained, thermal_range=ThermalRange(bounds.min_c - 7, bounds.max_c + 30))
    scene = on_scales(wider, scales_of(trained))
    assert scene.thermal_range == bounds
    for name, view in views_of(scene).items():
        celsius = wider.thermal_range.to_celsius(views_of(wider)[name].thermal)
        torch.testing.assert_close(bounds.to_celsius(view.thermal), celsius, rtol=0, atol=1e-4)


def test_the_same_scene_stays_as_it_is(trained):
    assert on_scales(trained, scales_of(trained)) is trained
    assert on_scales(trained, {}) is trained  # of a checkpoint that does not say


def test_a_first_frame_that_is_gone_is_missed_with_a_word(trained, caplog):
    gone = replace(trained, train=trained.train.subset(range(1, len(trained.train))))
    older = scales_of(trained) | {"frames": None}
    assert on_scales(gone, older) is gone and "which the data do not have now" in caplog.text


def test_a_static_scene_has_no_clock():
    scene = Synthetic(scene="static", size="tiny", frames=4).scene
    timeless = replace(
        scene,
        **{
            part: type(scene.train)([replace(f, time_s=None) for f in getattr(scene, part).frames], None)
            for part in PARTS
        },
    )
    assert scales_of(timeless)["first"] is None and on_scales(timeless, scales_of(scene)) is timeless


def test_a_run_without_wind_is_looked_at_under_a_record_that_has_gained_it(tmp_path, monkeypatch):
    film = Synthetic.load

    def still(self):
        scene = film(self)
        return replace(scene, weather=replace(scene.weather, wind_m_s=None))

    settings = (*BARE, "method=energy_balance", "max_steps=3")
    with monkeypatch.context() as filming:
        filming.setattr(Synthetic, "load", still)
        module, trainer = run(tmp_path, *settings)
        trainer.save_checkpoint(tmp_path / "still.ckpt")
    trained = load(tmp_path / "still.ckpt")  # with the record as it is now
    frame = module.scene.test.frames[0]
    assert trained.scene.weather.wind_m_s is not None and "raw_wind" not in trained.module.splats
    seen, expected = (one.render(frame).features for one in (trained.module, module))  # with derivatives, as trained
    assert torch.equal(seen, expected) and expected.std() > 0
    assert "none in training" in trained.module.thermal.effects()["convection"]["left_out"]
    assert Composed(EnergyBalance(clip="none")).optional == {"raw_wind"}


def test_a_run_without_sunlight_says_what_to_do_under_a_record_that_has_gained_it(tmp_path, monkeypatch):
    film = Synthetic.load

    def dark(self):
        scene = film(self)
        without = dict.fromkeys(("sun", "irradiance_w_m2", "direct_w_m2", "diffuse_w_m2"))
        return replace(scene, weather=replace(scene.weather, **without))

    with monkeypatch.context() as filming:
        filming.setattr(Synthetic, "load", dark)
        settings = (*BARE, "method=energy_balance", "thermal.solution=linear")  # the other has a kernel for the dark
        _, trainer = run(tmp_path, *settings, "max_steps=3", "trainer.max_steps=0")
        trainer.save_checkpoint(tmp_path / "dark.ckpt")
    with pytest.raises(
        SceneError, match=r"lacks normals, raw_sun: .*has gained or lost its irradiance since\. .*taken out again"
    ):
        load(tmp_path / "dark.ckpt")
