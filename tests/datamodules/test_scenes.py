"""Scenes as one: nothing moves relative to its own cameras and weather, and no scene sees another."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from weathered import HOUR_S, make_scene, make_weather

from heatsplat.contracts import Camera, SceneError, ThermalRange, View, ViewSet
from heatsplat.datamodules.base import SceneDataModule
from heatsplat.datamodules.scenes import DAY_S, Scenes, joined
from heatsplat.renderers.settings import Renderer


def room(name="one", width=50.0, metres=1.0, **changed):
    """A scene with real cameras and images; the image of a view says its position."""
    scene = make_scene(40)
    generator = torch.Generator().manual_seed(len(name))
    frames = []
    for number, frame in enumerate(scene.train.frames):
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
        viewmat[:3, 3] = torch.randn(3, generator=generator, dtype=torch.float64)
        lens = torch.tensor([[20.0, 0.0, 4.0], [0.0, 20.0, 4.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
        frames.append(replace(frame, camera=Camera(viewmat, lens, 8, 8), frame_id=number))

    def views(which):
        own = [frames[i] for i in which]
        return ViewSet(own, lambda i: View(own[i], thermal=torch.full((8, 8, 1), own[i].frame_id / 10)))

    return replace(
        scene,
        name=name,
        train=views([0, 1]),
        val=views([2]),
        test=views([2]),
        thermal_range=ThermalRange(10.0, 10.0 + width),
        metres_per_unit=metres,
        **changed,
    )


def test_every_scene_keeps_its_view_of_itself_in_metres():
    parts = room(), room("other", metres=0.5)
    whole = joined(parts, far=100.0)
    assert len(whole.points) == 80 and whole.metres_per_unit == 1.0 and whole.name == "one+other"
    for number, scene in enumerate(parts):
        own = whole.points[40 * number : 40 * (number + 1)].double()
        for before, after in zip(scene.train.frames, whole.train.frames[2 * number :], strict=False):
            local = scene.points.double() @ before.camera.viewmat[:3, :3].T + before.camera.viewmat[:3, 3]
            again = own @ after.camera.viewmat[:3, :3].T + after.camera.viewmat[:3, 3]
            torch.testing.assert_close(again, scene.metres_per_unit * local, rtol=0, atol=2e-5)
            assert after.time_s - before.time_s in whole.notes["delays_s"] and after.name.startswith(scene.name)
            elsewhere = whole.points[40 * (1 - number) :][:40].double()
            assert (elsewhere - after.camera.center).norm(dim=1).min() > 100.0
    ids = [frame.frame_id for part in (whole.train, whole.test) for frame in part.frames]
    assert sorted(ids) == list(range(6))
    assert whole.extent == pytest.approx(max(parts[0].extent, 0.5 * parts[1].extent))


def test_clocks_move_by_whole_days_and_take_the_weather_along():
    parts = room(), room("other", weather=make_weather(pressure_hpa=None))
    whole = joined(parts, far=100.0)
    first, second = whole.notes["delays_s"]
    assert first == 0.0 and second == DAY_S  # records of 22 hours
    assert whole.weather.pressure_hpa is None and whole.weather.sun is not None
    for scene, delay in zip(parts, (first, second), strict=True):
        for time in (0.0, 7.3 * HOUR_S):
            before, after = scene.weather.at(time), whole.weather.at(time + delay)
            assert (before.air_c, before.irradiance_w_m2) == pytest.approx((after.air_c, after.irradiance_w_m2))
    assert joined((room(), room("other", weather=None)), far=100.0).weather is None


@pytest.mark.parametrize(("far", "shows"), [(100.0, False), (1e10, True)])
def test_a_renderer_that_cuts_at_far_shows_no_other_scene(far, shows):
    """A camera 5 m before the first scene looks along x, where the second one stands 100 m behind."""
    along = torch.tensor([[0.0, -1.0, 0.0, 2.0], [0.0, 0.0, -1.0, 0.5], [1.0, 0.0, 0.0, 5.0], [0.0, 0.0, 0.0, 1.0]])
    lens = torch.tensor([[8.0, 0.0, 8.0], [0.0, 8.0, 8.0], [0.0, 0.0, 1.0]])
    scene = room()
    frames = [replace(frame, camera=Camera(along, lens, 16, 16)) for frame in scene.train.frames]
    scene = replace(scene, train=ViewSet(frames, lambda i: View(frames[i])))
    whole = joined((scene, room("other")), far=100.0)
    count = len(whole.points)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    sizes, opacities, values = torch.full((count, 3), 0.2), torch.full((1, count), 0.5), torch.ones(count, 1)
    renderer = Renderer(backend="reference", far=far)
    camera = whole.train.frames[0].camera
    seen = renderer(whole.points, quats, sizes, opacities, values, camera, None, (1,)).meta["visible_ids"]
    assert (seen < 40).sum() > 30 and ((seen >= 40).any() == shows)


def test_images_are_brought_to_one_range():
    parts = room(width=40.0), room("other", width=20.0)
    whole = joined(parts, far=100.0)
    assert (whole.thermal_range.min_c, whole.thermal_range.max_c) == (10.0, 50.0)
    for scene, position in ((parts[0], 1), (parts[1], 1)):
        number = parts.index(scene)
        before = scene.thermal_range.to_celsius(scene.train[position].thermal)
        view = whole.train[2 * number + position]
        torch.testing.assert_close(whole.thermal_range.to_celsius(view.thermal), before)
        assert view.frame == whole.train.frames[2 * number + position]
    assert torch.equal(whole.labels, torch.cat([part.labels for part in parts]))


@pytest.mark.parametrize(
    ("other", "far", "message"),
    [
        (room("other", metres=None), 100.0, "'other' cannot be joined with others: it lacks metres"),
        (room("other"), 3.0, "m across, more than data.far=3 m"),
        (
            room("other", weather=make_weather(up=torch.tensor([0.0, 1.0, 0.0]).double())),
            100.0,
            "must agree on what is up",
        ),
    ],
)
def test_scenes_that_do_not_fit_are_refused(other, far, message):
    with pytest.raises(SceneError, match=message):
        joined((room(), other), far)


def test_the_module_makes_one_part_of_each_name():
    class Rooms(SceneDataModule):
        def load(self):
            return room(self.scene_name)

    module = Scenes(each=partial(Rooms), scenes=["a", "bb", "ccc"], far=50.0)
    assert module.scene.name == "a+bb+ccc" and len(module.scene.train) == 6 and len(module.scene.test) == 3
    for scenes in (None, ["a"], "a,b"):
        with pytest.raises(SceneError, match="two or more scenes"):
            Scenes(each=partial(Rooms), scenes=scenes)
    named = Scenes(each=partial(Rooms, root="own"), scenes=["a", "bb"], root="/data")
    assert [part.root for part in named.parts] == ["/data"] * 2
