"""The table and the picture of hot and cold surfaces, of a wall whose left half is warm."""

import logging
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from fake_run import RANGE, WIDTH, wall, warmth

from heatsplat.callbacks import surfaces
from heatsplat.callbacks.surfaces import SURFACES_FILE, SURFACES_PICTURE, ExtremeSurfaces, best_two
from heatsplat.contracts import ViewSet
from heatsplat.export.place import Place
from heatsplat.geometry.alignment import Similarity
from heatsplat.geometry.looks import Look, surface_points
from heatsplat.io.tables import read_csv


def surface(frame):
    return torch.full((frame.camera.height, frame.camera.width), 4.0)


def render(frame, camera):
    """The wall in z = 4: a warm patch of 0.5 x 0.4 about (-0.5, 0.1), all else at 0.1."""
    points = surface_points(camera, surface(frame))
    patch = ((points[..., 0] + 0.5).abs() < 0.25) & ((points[..., 1] - 0.1).abs() < 0.2)
    image = torch.where(patch, warmth(frame.time_s).float(), torch.tensor(0.1) + 0.001 * points[..., 0].float())
    return SimpleNamespace(features=image[..., None])


@pytest.mark.parametrize("origin", [None, [599456.5, 5695495.25, -20.0]])
def test_the_warm_patch_is_found_in_the_coordinates_of_the_data_set(tmp_path, origin):
    scene = wall() if origin is None else replace(wall(), notes={"origin": origin})
    module = SimpleNamespace(scene=scene, modality="thermal", output_dir=tmp_path, render=render, surface=surface)
    ExtremeSurfaces(views=4, share=0.02).on_test_epoch_end(None, module)
    rows = read_csv(tmp_path / SURFACES_FILE)
    hottest, times = rows[0], module.scene.train.times_s
    middle = (min(times) + max(times)) / 2
    taken = min(times, key=lambda time_s: abs(time_s - middle))  # of an image: not between nights
    assert hottest["kind"] == "hottest" and hottest["time_s"] == pytest.approx(taken)
    assert hottest["mean_c"] == pytest.approx(float(RANGE.to_celsius(warmth(taken))), abs=0.01)
    assert hottest["area"] == pytest.approx(0.2, rel=0.2) and hottest["unit"] == "square units"
    place = np.array([-0.5, 0.1, 4.0]) + (origin or 0.0)
    assert [hottest[axis] for axis in "xyz"] == pytest.approx(place.tolist(), rel=0, abs=0.08)
    assert rows[-1]["kind"] == "coldest" and rows[-1]["mean_c"] < 15
    assert (tmp_path / SURFACES_PICTURE).stat().st_size > 1000 and WIDTH == 56


def test_what_masks_leave_out_is_no_surface(tmp_path):
    """No image told what the model shows there."""
    scene = wall()

    def masked(i):
        view = scene.train[i]
        camera = view.camera
        points = surface_points(camera, torch.full((camera.height, camera.width), 4.0))
        return replace(view, mask=(points[..., 0] + 0.5).abs() > 0.3)

    module = SimpleNamespace(
        scene=replace(scene, train=ViewSet(scene.train.frames, masked)),
        modality="thermal",
        output_dir=tmp_path,
        render=render,
        surface=surface,
    )
    ExtremeSurfaces(views=4, share=0.02).on_test_epoch_end(None, module)
    rows = read_csv(tmp_path / SURFACES_FILE)
    assert rows and all(row["most_c"] < 15 and abs(row["x"] + 0.5) > 0.2 for row in rows)


@pytest.mark.parametrize("timed", [True, False])
def test_surfaces_are_seen_without_what_is_known_of_single_images(tmp_path, timed):
    """Such as the level of an image of wild_thermal, which drifts."""
    scene, seen = wall(), []
    views = scene.train
    if not timed:
        views = ViewSet([replace(frame, time_s=None) for frame in views.frames], lambda i: scene.train[i])
    module = SimpleNamespace(
        scene=replace(scene, train=views), modality="thermal", output_dir=tmp_path, surface=surface
    )
    module.render = lambda frame, **asked: seen.append(frame) or render(replace(frame, time_s=0.0), **asked)
    ExtremeSurfaces(views=4, share=0.02).on_test_epoch_end(None, module)
    taken = {frame.frame_id for frame in scene.frames}
    assert len(seen) == 4 and not taken & {frame.frame_id for frame in seen}


def test_images_that_are_no_temperatures_have_none(tmp_path):
    ExtremeSurfaces().on_test_epoch_end(None, SimpleNamespace(scene=wall(thermal_range=None), modality="thermal"))
    assert not list(tmp_path.iterdir())


@pytest.fixture
def place(monkeypatch):
    """A place on the earth where a unit of the scene is 3 m."""
    shift = torch.tensor([599_000.0, 5_695_000.0, 0.0]).double()
    monkeypatch.setattr(Place, "latitudes_longitudes", lambda self, points: [(51.4, 4.43)] * len(points))
    return Place(Similarity(torch.tensor(3.0).double(), torch.eye(3).double(), shift), "EPSG:32631", "metre")


def test_surfaces_have_a_place_on_the_earth_where_cameras_do(place):
    points = [torch.tensor([1.0, 2.0, -3.0]).double()]
    (told,) = surfaces.on_earth(place, points)
    assert told == {
        "crs": "EPSG:32631", "east_m": 599_003.0, "north_m": 5_695_006.0, "height_m": -9.0,
        "latitude_deg": 51.4, "longitude_deg": 4.43,
    }  # fmt: skip
    assert surfaces.on_earth(None, points) == [{}]


@pytest.mark.parametrize(("metres", "area"), [(None, 0.2 * 9), (2.0, 0.2 * 4)])
def test_areas_are_in_metres_where_cameras_have_positions(tmp_path, monkeypatch, place, caplog, metres, area):
    monkeypatch.setattr(surfaces, "placed", lambda scene: place)
    scene = replace(wall(), positions="frames.csv", metres_per_unit=metres)
    module = SimpleNamespace(scene=scene, modality="thermal", output_dir=tmp_path, render=render, surface=surface)
    with caplog.at_level(logging.INFO):
        ExtremeSurfaces(views=4, share=0.02).on_test_epoch_end(None, module)
    hottest = read_csv(tmp_path / SURFACES_FILE)[0]
    assert hottest["area"] == pytest.approx(area, rel=0.2) and hottest["unit"] == "m²"
    assert ("taken for 3 m, by the positions of its cameras in frames.csv" in caplog.text) == (metres is None)


def test_surfaces_lie_beside_the_points_that_were_measured():
    scene = wall()
    low, high = surfaces.reach(scene)
    assert -1.5 < low[0] < -1.0 < 1.0 < high[0] < 1.5 and 3.5 < low[2] < 4.0 < high[2] < 4.5
    assert surfaces.reach(replace(scene, notes={"points_random": 300})) is None


def test_names_at_the_right_edge_stand_left_of_their_mark():
    seen = Look(None, torch.ones(48, 64), torch.full((48, 64), 20.0))
    left, right = (surfaces._marked(seen, [("C1", (column, 24.0))], 10.0, 50.0) for column in (30.0, 63.0))
    blank = surfaces._marked(seen, [], 10.0, 50.0)

    def drawn(picture):
        return np.argwhere((picture != blank).any(-1))[:, 1]

    assert drawn(right).min() < 630 - surfaces.NAME and drawn(left).max() > 300 + surfaces.MARK + 10


def test_the_first_surfaces_are_shown_before_many_others():
    many, hottest, coldest = {"H2", "H3", "H4", "C2", "C3", "C4"}, {"H1"}, {"C1", "H2"}
    assert sorted(best_two([many, hottest, coldest])) == [1, 2]
    assert best_two([many, hottest, coldest, {"H1", "C1", "C4"}]) == (0, 3)


def test_of_views_of_the_same_surfaces_the_fullest_comes_first():
    assert best_two([{"H1"}, {"H1", "C1", "H2"}, {"C1"}]) == (1, 1)
    assert best_two([{"C3"}, set(), {"H2", "C3"}])[0] == 2  # no view shows H1 and C1
    assert best_two([set()]) == (0, 0)
