"""Correction pixel by pixel against a scene whose temperature, distances and angles are known."""

import csv
import json
import weakref
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from recordings import write_flir

from heatsplat.contracts import Camera, Frame, SceneError, ThermalRange, View, ViewSet
from heatsplat.datamodules.colmap import Colmap
from heatsplat.geometry.projection import look_at
from heatsplat.geometry.sight_lines import cosines, distances, rays
from heatsplat.io.tiff import read_temperature
from heatsplat.physics.radiometry import (
    BandResponse,
    Conditions,
    PlanckResponse,
    directional_emissivity,
    measured_signal,
    surface_temperature,
)
from heatsplat.preparation import correction
from heatsplat.preparation.conditions import GivenConditions
from heatsplat.preparation.correction import PERCENT, Spread, _unsettled, correct_scene, corrected, preparation_of
from heatsplat.preparation.prepare import prepare

CAMERA = Camera(
    torch.eye(4, dtype=torch.float64),
    torch.tensor([[38.0, 0, 20.0], [0, 38.0, 16.0], [0, 0, 1]], dtype=torch.float64),
    40,
    32,
)
# A floor 10 units below that is seen at a slant, and a free sky above the horizon.
DOWN = torch.tensor([0.0, 0.95, 0.31], dtype=torch.float64)
ALONG = rays(CAMERA) @ DOWN
DEPTH = torch.where(ALONG > 0.1, 10.0 / ALONG.clamp(min=1e-9), torch.inf)
TRUE_K = 300.0 + 20.0 * torch.sin(torch.arange(40, dtype=torch.float64) / 5).expand(32, 40)
METRES = 4.0  # a unit
AIR = Conditions(emissivity=0.94, reflected_k=265.0, distance_m=60.0, air_k=285.0, humidity=0.8)
RESPONSES = [PlanckResponse(16000.0, 1430.0, 1.0, -7000, 0.012), BandResponse()]


def filmed(response, index):
    """What a camera measures of the floor."""
    metres = (distances(CAMERA, DEPTH) * METRES).nan_to_num(posinf=60.0)
    emissivity = 0.94
    if index is not None:
        emissivity = directional_emissivity(0.94, cosines(CAMERA, DEPTH).nan_to_num(1.0).clamp(min=0.17), index)
    return measured_signal(TRUE_K, response, replace(AIR, distance_m=metres, emissivity=emissivity))


@pytest.mark.parametrize("response", RESPONSES, ids=lambda r: type(r).__name__)
@pytest.mark.parametrize("index", [None, 1.5])
@pytest.mark.parametrize("prepared", [True, False])
def test_true_temperatures_come_back_where_one_distance_is_wrong_by_kelvins(response, index, prepared):
    done = AIR if prepared else Conditions()
    trained_on = surface_temperature(filmed(response, index), response, done) - 273.15
    found = corrected(trained_on, CAMERA, DEPTH, METRES, response, done, AIR, index)
    truth = TRUE_K - 273.15
    assert (found.celsius - truth).abs().max() < 1e-6
    floor = DEPTH.isfinite()
    assert (found.one - truth)[floor].abs().max() > (0.3 if index is None else 1.0)
    if index is not None:
        assert (found.distance_only - truth)[floor].abs().max() > 0.1
    assert found.distance_m[~floor].isnan().all() and (~floor).any()


def scene():
    """Three views of the floor, as a trained scene has them."""
    celsius = surface_temperature(filmed(BandResponse(), 1.5), BandResponse(), Conditions()) - 273.15
    span = ThermalRange(0.0, 60.0)
    image = span.to_unit(celsius).float()[..., None]
    frames = [Frame(f"{i}.tiff", i, CAMERA, time_s=2.0 * i) for i in range(3)]
    views = ViewSet(frames, lambda i: View(frames[i], thermal=image))
    train, test, points = views.subset([0, 1]), views.subset([2]), torch.rand(30, 3)
    scene = {
        "name": "floor",
        "thermal_range": span,
        "train": train,
        "test": test,
        "points": points,
        "point_colors": None,
    }
    return SimpleNamespace(**scene, notes={"axes": "east, north, up"}, origin=torch.zeros(3, dtype=torch.float64))


def test_a_scene_becomes_a_corrected_one_that_loads(tmp_path):
    given = GivenConditions(
        emissivity=0.94, reflected_c=265.0 - 273.15, distance_m=60.0, air_c=285.0 - 273.15, humidity_percent=80
    )
    page = correct_scene(scene(), lambda frame: DEPTH, [], tmp_path / "new", given, BandResponse(), 1.5, METRES)
    image = read_temperature(tmp_path / "new" / "images" / "1.tiff")
    np.testing.assert_allclose(image, TRUE_K.numpy() - 273.15, atol=1e-3)  # the images were float32
    text = page.read_text()
    assert "against one distance of 60.0 m" in text and "| both |" in text
    assert (tmp_path / "new" / "report" / "correction.png").stat().st_size > 1000
    module = Colmap(root=str(tmp_path / "new"))
    module.setup()
    frames = [*module.scene.train.frames, *module.scene.test.frames]
    assert sorted(frame.time_s for frame in frames) == [-2.0, 0.0, 2.0]  # 0 is the first training frame
    torch.testing.assert_close(frames[0].camera.K, CAMERA.K)
    assert module.scene.metres_per_unit == METRES


def test_a_corrected_scene_has_the_coordinates_of_the_data_set(tmp_path):
    utm, floor = torch.tensor([500000.0, 5500000.0, 100.0], dtype=torch.float64), scene()
    floor.origin = utm  # what a data set in UTM loses when it is loaded
    correct_scene(floor, lambda frame: DEPTH, [], tmp_path, GivenConditions(), BandResponse(), None, METRES)
    again = Colmap(root=str(tmp_path))
    again.setup()
    found = again.scene
    torch.testing.assert_close(
        found.train.frames[0].camera.center + found.origin, CAMERA.center + utm, rtol=0, atol=1e-6
    )
    points = torch.cat([found.points.double() + found.origin, floor.points.double() + utm]).sort(0).values
    torch.testing.assert_close(points[::2], points[1::2], rtol=0, atol=1e-4)


def test_a_corrected_scene_is_not_corrected_again(tmp_path):
    given = GivenConditions(emissivity=0.9)
    correct_scene(scene(), lambda frame: DEPTH, [], tmp_path / "a", given, BandResponse(), None, METRES)
    with pytest.raises(SceneError, match="is corrected already.*ckpt of a run on the scene that it was made from"):
        correct_scene(
            scene(),
            lambda frame: DEPTH,
            [tmp_path, tmp_path / "a"],
            tmp_path / "b",
            given,
            BandResponse(),
            None,
            METRES,
        )


def test_images_are_held_one_at_a_time(tmp_path):
    floor, alive, held = scene(), [], []
    thermal = floor.train[0].thermal

    def decode(i):
        held.append(sum(image() is not None for image in alive))
        image = thermal.clone()
        alive.append(weakref.ref(image))
        return View(frames[i], thermal=image)

    frames = [Frame(f"{i}.tiff", i, CAMERA, time_s=2.0 * i) for i in (4, 0, 3, 1, 2)]
    floor.train, floor.test = ViewSet(frames, decode), ViewSet([], decode)
    correct_scene(floor, lambda frame: DEPTH, [], tmp_path, GivenConditions(), BandResponse(), 1.5, METRES)
    assert len(held) == 5 and max(held) <= 1
    rows = list(csv.DictReader((tmp_path / "frames.csv").open()))
    assert [row["file"] for row in rows] == sorted(row["file"] for row in rows)


def test_percentiles_of_what_comes_in_parts_are_those_of_all():
    generator = torch.Generator().manual_seed(0)
    parts = [torch.randn(300, 400, generator=generator, dtype=torch.float64) * scale for scale in (0.01, 1.0, 20.0)]
    parts[1][:50] = torch.nan
    parts[2][:100] = 0.0
    spread = Spread()
    for part in parts:
        spread.add(part)
    known = torch.cat([part[part.isfinite()] for part in parts]).numpy()
    assert spread.count == known.size and spread.mean_size == pytest.approx(np.abs(known).mean(), rel=1e-6)
    truth = np.percentile(known, PERCENT)
    np.testing.assert_allclose(spread.percentiles(PERCENT), truth, rtol=1 / 2048, atol=1e-4)
    assert np.isnan(Spread().percentiles(PERCENT)).all() and np.isnan(Spread().mean_size)
    nothing = Spread()
    nothing.add(-torch.zeros(5))
    assert [f"{value:+.3f}" for value in nothing.percentiles(PERCENT)] == ["+0.000"] * len(PERCENT)


def test_places_of_the_preparation_stay(tmp_path):
    (tmp_path / "frames.csv").write_text(
        "file,time_s,latitude_deg,longitude_deg,median\n0.tiff,9,50.5,7.5,20\n1.tiff,9,50.6,,21\n"
    )
    correct_scene(
        scene(),
        lambda frame: DEPTH,
        [tmp_path / "none", tmp_path],
        tmp_path / "new",
        GivenConditions(),
        BandResponse(),
        None,
        METRES,
    )
    rows = list(csv.DictReader((tmp_path / "new" / "frames.csv").open()))
    assert [row["latitude_deg"] for row in rows] == ["50.5", "50.6", ""] and rows[0]["longitude_deg"] == "7.5"
    assert set(rows[0]) == {"file", "time_s", "latitude_deg", "longitude_deg"}


def test_a_table_of_the_users_own_tells_nothing_of_a_preparation(tmp_path):
    (tmp_path / "frames.csv").write_text("image,seconds\n0.tiff,9\n1.tiff,10\n")
    target = tmp_path / "new"
    correct_scene(scene(), lambda frame: DEPTH, [tmp_path], target, GivenConditions(), BandResponse(), None, METRES)
    assert set(next(csv.DictReader((target / "frames.csv").open()))) == {"file", "time_s"}


def test_without_a_distance_that_is_given_the_typical_one_is_compared_with(tmp_path):
    page = correct_scene(scene(), lambda frame: DEPTH, [], tmp_path, GivenConditions(), BandResponse(), None, METRES)
    far = float((distances(CAMERA, DEPTH) * METRES)[DEPTH.isfinite()].median())
    text = page.read_text()
    assert f"against one distance of {far:.1f} m" in text
    assert "| angle of each pixel |" not in text  # nobody asked for angles


def test_air_that_nothing_tells_of_is_said_of_any_image(tmp_path, monkeypatch):
    last = max(frame.name for part in (scene().train, scene().test) for frame in part.frames)

    def prepared(name, folders):
        return None, AIR if name == last else Conditions()

    monkeypatch.setattr(correction, "preparation_of", prepared)
    page = correct_scene(scene(), lambda frame: DEPTH, [], tmp_path, GivenConditions(), BandResponse(), None, METRES)
    assert correction.ASSUMED in page.read_text()


@pytest.mark.parametrize("share", [1.0, 0.8])
def test_splats_that_lie_elsewhere_than_the_points_are_doubted(tmp_path, share):
    there = DEPTH.isfinite()
    y, x = there.nonzero().unbind(1)
    points = (
        torch.stack([(x + 0.5 - 20.0) / 38.0, (y + 0.5 - 16.0) / 38.0, torch.ones(len(x))], 1) * DEPTH[there][:, None]
    )
    shown = scene()
    shown.points = (points * share).float()
    page = correct_scene(shown, lambda frame: DEPTH, [], tmp_path, GivenConditions(), BandResponse(), None, METRES)
    assert ("lie 25 % farther than the points" in page.read_text()) == (share < 1)


@pytest.mark.parametrize("far", [False, True])
def test_pixels_beyond_all_measured_points_are_doubted(tmp_path, far):
    there = DEPTH.isfinite()
    limit = DEPTH[there].median() if far else DEPTH[there].max()
    y, x = (there & (limit >= DEPTH)).nonzero().unbind(1)
    points = (
        torch.stack([(x + 0.5 - 20.0) / 38.0, (y + 0.5 - 16.0) / 38.0, torch.ones(len(x))], 1) * DEPTH[y, x][:, None]
    )
    shown = scene()
    shown.points = points.float()
    page = correct_scene(shown, lambda frame: DEPTH, [], tmp_path, GivenConditions(), BandResponse(), None, METRES)
    assert ("% of the pixels lie farther than the points" in page.read_text()) == far
    assert "nearer than the points" not in page.read_text()  # where points are, distances are right


def test_cameras_that_are_turned_against_each_other_agree_on_the_normals_of_a_floor():
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    eyes = torch.tensor([[0.0, -8.0, 6.0], [2.0, 0.0, 9.0], [9.0, 6.0, 4.0]], dtype=torch.float64)
    poses = [look_at(eye, 0.0 * up, up) for eye in eyes]
    cameras = [replace(CAMERA, viewmat=pose) for pose in poses]

    def floor(camera):  # z = 0
        along = rays(camera) @ camera.viewmat[:3, :3].double()
        return (-camera.center[2] / along[..., 2]).where(along[..., 2] < 0, torch.inf)

    spots = 2.0 * torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) - 1.0
    few = [(camera, floor(camera)) for camera in cameras]
    assert _unsettled(few, spots * torch.tensor([1.0, 1.0, 0.0])) == ""
    assert "Too few points" in _unsettled(few, spots[:5])


@pytest.mark.parametrize("tilt", [0.0, 0.02])
def test_normals_on_which_views_disagree_are_doubted(tmp_path, tilt):
    y, x = DEPTH.isfinite().nonzero().unbind(1)
    local = (
        torch.stack([(x + 0.5 - 20.0) / 38.0, (y + 0.5 - 16.0) / 38.0, torch.ones(len(x))], 1) * DEPTH[y, x][:, None]
    )
    shown = scene()
    shown.points = ((local - CAMERA.viewmat[:3, 3]) @ CAMERA.viewmat[:3, :3]).float()
    columns = torch.arange(40, dtype=torch.float64) - 20.0

    def depth_of(frame):  # of the middle view every wall is turned about the upright
        return DEPTH / (1.0 + tilt * columns) if frame.name == "1.tiff" else DEPTH

    page = correct_scene(shown, depth_of, [], tmp_path, GivenConditions(emissivity=0.9), BandResponse(), 1.5, METRES)
    assert ("angles are not settled" in page.read_text()) == (tilt > 0)
    assert "% of the pixels have no known angle" in page.read_text()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"metres": None}, "correct.metres_per_unit"),
        ({"metres": -4}, "correct.metres_per_unit must be above 0"),
        ({"index": 0.9}, "correct.refractive_index must be above 1"),
        ({"index": "glass"}, "correct.refractive_index must be a number, got glass"),
        ({"thermal_range": None}, "floor has no temperatures"),
        ({"depth": torch.full((32, 40), torch.inf)}, "shows no surface"),
    ],
)
def test_what_cannot_be_corrected_is_refused_with_the_remedy(tmp_path, change, said):
    floor = scene()
    floor.thermal_range = change.get("thermal_range", floor.thermal_range)
    depth = change.get("depth", DEPTH)
    with pytest.raises(SceneError, match=said):
        correct_scene(
            floor, lambda frame: depth, [], tmp_path, GivenConditions(), BandResponse(), change.get("index"),
            change.get("metres", METRES),
        )  # fmt: skip


@pytest.mark.parametrize(("own", "scale"), [(None, 3.0), (2.0, 2.0)])
def test_positions_tell_the_scale_where_the_scene_does_not(monkeypatch, own, scale):
    monkeypatch.setattr(correction, "placed", lambda scene: SimpleNamespace(scale=3.0))
    floor = SimpleNamespace(metres_per_unit=own, name="floor", positions="frames.csv")
    module = SimpleNamespace(cameras=SimpleNamespace(of="cameras of the run"))
    trained = SimpleNamespace(config={"data": {"root": None}}, scene=floor, depth=None, module=module)
    monkeypatch.setattr(correction, "load", lambda ckpt, **given: trained)
    monkeypatch.setattr(
        correction, "correct_scene", lambda *given: given[7] if given[-1] == module.cameras.of else None
    )
    settings = {"conditions": {}, "band_um": (8, 14), "refractive_index": None}
    assert correction.correct("a.ckpt", None, metres_per_unit=None, **settings) == scale
    assert correction.correct("a.ckpt", None, metres_per_unit=7.0, **settings) == 7.0


def test_the_working_folder_is_no_preparation_of_a_scene_without_a_folder(tmp_path, monkeypatch):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "0.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    floor = SimpleNamespace(metres_per_unit=1.0, name="floor")
    given = {"root": None, "scene": "floor"}
    module = SimpleNamespace(cameras=SimpleNamespace(of=None))
    trained = SimpleNamespace(config={"data": given}, scene=floor, depth=None, module=module)
    monkeypatch.setattr(correction, "load", lambda ckpt, **_: trained)
    monkeypatch.setattr(correction, "correct_scene", lambda *given: given[2])
    settings = {"conditions": {}, "band_um": (8, 14), "refractive_index": None, "metres_per_unit": None}
    assert correction.correct("a.ckpt", tmp_path / "corrected", **settings) == []
    given["root"] = "data"
    assert correction.correct("a.ckpt", tmp_path / "corrected", **settings) == [Path("data"), Path("data/floor")]


def test_cameras_are_those_that_the_run_learned(tmp_path):
    def moved(frame):
        pose = frame.camera.viewmat.clone()
        pose[0, 3] += torch.nn.Parameter(torch.tensor(0.5 + frame.frame_id))  # as what is learned
        return replace(frame.camera, viewmat=pose)

    asked = []

    def depth_of(frame):
        asked.append(float(frame.camera.viewmat[0, 3].numpy()))
        return DEPTH

    given = GivenConditions(), BandResponse(), None, METRES
    correct_scene(scene(), depth_of, [], tmp_path / "new", *given, camera_of=moved)
    assert set(asked) == {0.5, 1.5, 2.5}
    module = Colmap(root=str(tmp_path / "new"))
    module.setup()
    frames = [*module.scene.train.frames, *module.scene.test.frames]
    shifts = [(frame.camera.viewmat[:3, 3] - frame.camera.viewmat[:3, :3] @ module.scene.origin)[0] for frame in frames]
    assert sorted(float(shift) for shift in shifts) == pytest.approx([0.5, 1.5, 2.5], abs=1e-5)


def test_pixels_that_were_cut_off_are_left_out_and_counted(tmp_path, caplog):
    floor = scene()
    ends = torch.zeros(32, 40, dtype=torch.int8)
    ends[20:22, 5:9], ends[30, 0] = 1, -1
    train = floor.train
    floor.train = ViewSet(train.frames, lambda i: replace(train[i], ends=ends if i == 1 else None))
    page = correct_scene(floor, lambda _: DEPTH, [], tmp_path / "new", GivenConditions(), BandResponse(), None, METRES)
    first, second = (read_temperature(tmp_path / "new" / "images" / f"{i}.tiff") for i in (0, 1))
    assert np.isfinite(first).all()
    np.testing.assert_array_equal(np.isnan(second), ends.numpy() != 0)
    assert "9 pixels were cut off" in caplog.text and "9 pixels were cut off" in page.read_text()


def test_the_scene_itself_is_no_target(tmp_path):
    (tmp_path / "a").mkdir()
    with pytest.raises(SceneError, match="is the folder of the scene that is to be corrected.*give another one"):
        correct_scene(
            scene(), lambda frame: DEPTH, [tmp_path, tmp_path / "a"], tmp_path / "a" / ".." / "a",
            GivenConditions(), BandResponse(), None,
            METRES,
        )  # fmt: skip
    assert not list((tmp_path / "a").iterdir())


def test_what_a_preparation_did_is_found_again(tmp_path):
    prepare(str(write_flir(tmp_path / "files", 2)), tmp_path / "scene", conditions={}, uncertainty={}, counts={})
    response, done = preparation_of("IR_0000.tiff", [tmp_path / "elsewhere", tmp_path / "scene"])
    assert isinstance(response, PlanckResponse) and done.emissivity == pytest.approx(0.95)
    assert preparation_of("other.tiff", [tmp_path / "scene"]) == (None, Conditions())
    record = tmp_path / "scene" / "images" / "IR_0000.json"
    record.write_text(json.dumps({"conditions": 3}))
    with pytest.raises(SceneError, match="IR_0000.json is no record of a preparation"):
        preparation_of("IR_0000.tiff", [tmp_path / "scene"])
