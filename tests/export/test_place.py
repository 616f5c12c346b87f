"""Where a scene lies: by positions that are known exactly, and by its cameras."""

import math
from dataclasses import replace

import pytest
import torch

from heatsplat.contracts import SceneError, ViewSet
from heatsplat.export.formats.gltf import Gltf
from heatsplat.export.formats.las import Las
from heatsplat.export.formats.map import Map
from heatsplat.export.formats.ply import Ply
from heatsplat.export.formats.spz import Spz
from heatsplat.export.place import place_in_file, place_of, placed, unit_in_metres

rasterio = pytest.importorskip("rasterio", reason="rasterio is not installed (pip install -e '.[dev]')")


def table(scene, path, columns=("file", "latitude_deg", "longitude_deg", "altitude_m"), degrees=30.0, easting=500_000):
    """Positions of cameras whose world is turned by 30 degrees and 2 m a unit, at a known place of UTM zone 32."""
    from rasterio.warp import transform

    turn = math.radians(degrees)
    lines = [",".join(columns)]
    for frame in scene.frames:
        x, y, z = frame.camera.center.tolist()
        east = easting + 2 * (math.cos(turn) * x - math.sin(turn) * y)
        north = 5_200_000 + 2 * (math.sin(turn) * x + math.cos(turn) * y)
        (longitude,), (latitude,) = transform("EPSG:32632", "EPSG:4326", [east], [north])
        lines.append(f"{frame.name},{latitude:.12f},{longitude:.12f},{100 + 2 * z:.9f}")
    path.write_text("\n".join(lines) + "\n")
    return path


def test_positions_give_the_projection_the_scale_and_the_turn(cooling, tmp_path):
    place = place_of(cooling.module.scene, table(cooling.module.scene, tmp_path / "gps.csv"))
    assert place.crs == "EPSG:32632" and place.unit == "metre" and place.scale == pytest.approx(2.0, abs=1e-5)
    found = place(torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5]]))
    turn = math.radians(30.0)
    expected = [[5e5, 5.2e6, 100.0], [5e5 + 2 * math.cos(turn), 5.2e6 + 2 * math.sin(turn), 101.0]]
    assert (found - torch.tensor(expected, dtype=torch.float64)).abs().max() < 1e-3


@pytest.mark.parametrize(("middle_deg", "crs"), [(180.0 - 1e-6, "EPSG:32760"), (180.0 + 1e-6, "EPSG:32701")])
def test_positions_on_both_sides_of_the_180th_meridian_lie_in_the_zone_of_their_middle(
    cooling, tmp_path, middle_deg, crs
):
    scene, path, lines = cooling.module.scene, tmp_path / "gps.csv", ["file,latitude_deg,longitude_deg,altitude_m"]
    centers = torch.stack([frame.camera.center for frame in scene.frames]).double()
    longitudes = (middle_deg + 1e-5 * (centers[:, 0] - centers[:, 0].mean()) + 180.0) % 360.0 - 180.0
    assert longitudes.min() < -179 and longitudes.max() > 179
    for frame, longitude, (_, y, z) in zip(scene.frames, longitudes.tolist(), centers.tolist(), strict=True):
        lines.append(f"{frame.name},{-16.8 + 1e-5 * y:.9f},{longitude:.9f},{z}")
    path.write_text("\n".join(lines) + "\n")
    place = place_of(scene, path)
    assert place.crs == crs
    latitude, longitude = place.latitudes_longitudes(centers.mean(0, keepdim=True))[0]
    assert latitude == pytest.approx(-16.8, abs=1e-3) and abs(longitude) == pytest.approx(180.0, abs=1e-3)


def test_only_coordinates_without_a_place_on_the_earth_are_said_to_count_from_the_origin(cooling, tmp_path, caplog):
    scene = cooling.module.scene
    scene = replace(scene, notes={**scene.notes, "origin": [6e5, 5.6e6, 100.0]})
    assert place_in_file(scene, table(scene, tmp_path / "gps.csv")).crs == "EPSG:32632"
    assert "count from" not in caplog.text
    assert place_in_file(scene).crs is None
    assert "coordinates count from 600000, 5600000, 100 of the data set" in caplog.text
    assert [form.from_origin for form in (Ply, Gltf, Spz, Las, Map)] == [True, False, False, False, False]


def test_tables_as_programs_write_them_and_images_of_one_name(cooling, tmp_path):
    scene = cooling.module.scene
    frames = [replace(f, name=f"{'ab'[i % 2]}/{i // 2}.png") for i, f in enumerate(scene.train.frames)]
    none = ViewSet([], list)
    twice = replace(scene, train=ViewSet(frames, lambda i: None), val=none, test=none)
    path = table(twice, tmp_path / "gps.csv")
    spot = torch.zeros(1, 3)
    expected = place_of(scene, table(scene, tmp_path / "b.csv"))(spot)
    assert torch.allclose(place_of(twice, path)(spot), expected, atol=1e-3)
    text = path.read_text().replace(",", ";").replace(".", ",").replace(",png", ".png")
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert torch.allclose(place_of(twice, path)(spot), expected, atol=1e-3)
    path.write_bytes(("sep=;\r\n# by hand\r\n" + text).encode("utf-16"))
    assert torch.allclose(place_of(twice, path)(spot), expected, atol=1e-3)
    path.write_bytes(b"PK\x81")
    with pytest.raises(SceneError, match="gps.csv cannot be read: it is no text; save it as UTF-8"):
        place_of(twice, path)
    path.write_text(text.replace("a/", "").replace("b/", ""))
    with pytest.raises(SceneError, match="has positions of [01] of the images"):
        place_of(twice, path)


def test_rows_that_tell_no_position_are_left_out_of_a_table_and_names_may_hold_points(cooling, tmp_path):
    scene, spot = cooling.module.scene, torch.zeros(1, 3)
    expected = place_of(scene, table(scene, tmp_path / "a.csv"))(spot)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    blanks = ["x.png, , ,5", "y.png,nan,nan,5", "z.png,0.0,0.0,5", "w.png", "v.png,47,9,5,beyond,the,columns"]
    (tmp_path / "b.csv").write_text("\n".join([lines[0], *blanks, *lines[1:]]) + "\n")
    assert torch.allclose(place_of(scene, tmp_path / "b.csv")(spot), expected)
    clocks = {frame.name: f"2024-08-06_17.34.{i:02d}" for i, frame in enumerate(scene.frames)}
    frames = [replace(frame, name=f"{clocks[frame.name]}.tiff") for frame in scene.train.frames]
    none = ViewSet([], list)
    named = replace(scene, train=ViewSet(frames, lambda i: None), val=none, test=none)
    renamed = [",".join([clocks[line.partition(",")[0]], line.partition(",")[2]]) for line in lines[1:]]
    (tmp_path / "c.csv").write_text("\n".join([lines[0], *renamed]) + "\n")
    assert torch.allclose(place_of(named, tmp_path / "c.csv")(spot), expected, atol=1e-3)
    (tmp_path / "d.csv").write_text("\n".join([*lines, "other.png,147,9,500"]) + "\n")
    with pytest.raises(SceneError, match="other lies nowhere on the earth, at latitude 147 and longitude 9"):
        place_of(scene, tmp_path / "d.csv")


def test_the_scene_s_own_table_is_taken_unless_it_places_nothing(cooling, tmp_path, caplog):
    scene = replace(cooling.module.scene, positions=table(cooling.module.scene, tmp_path / "frames.csv"))
    assert place_of(scene, "auto").crs == "EPSG:32632" and place_of(scene).crs is None
    assert place_of(scene, "auto", torch.tensor([0.0, 0.0, 1.0])).crs is None
    (tmp_path / "few.csv").write_text("file,lat,lon,alt\nother.png,47,9,500\n")
    assert place_of(replace(scene, positions=tmp_path / "few.csv"), "auto").crs is None
    assert "has positions of 0 of the images" in caplog.text and "no place on the earth" in caplog.text


def test_positions_tell_the_scale_where_the_scene_does_not(cooling, tmp_path):
    scene = replace(cooling.module.scene, metres_per_unit=None)
    assert placed(scene) is None and unit_in_metres(scene, None) is None
    scene = replace(scene, positions=table(scene, tmp_path / "frames.csv"))
    assert unit_in_metres(scene, placed(scene)) == pytest.approx(2.0, abs=1e-5)
    assert unit_in_metres(replace(scene, metres_per_unit=5.0), placed(scene)) == 5.0
    (tmp_path / "few.csv").write_text("file,lat,lon,alt\nother.png,47,9,500\n")
    assert placed(replace(scene, positions=tmp_path / "few.csv")) is None


def strip(scene, wander=0.0):
    """The scene as cameras along a line of flight see it, in a world whose axes are east, north and up, 2 m a unit."""
    frames = []
    for i, frame in enumerate(scene.train.frames):
        viewmat = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
        viewmat[:3, 3] = -viewmat[:3, :3] @ torch.tensor([3.0 * i, wander * (-1) ** i, 20.0], dtype=torch.float64)
        frames.append(replace(frame, camera=replace(frame.camera, viewmat=viewmat)))
    views, none = ViewSet(frames, lambda i: None), ViewSet([], list)
    notes = scene.notes | {"axes": "east, north, up"}
    return replace(scene, train=views, val=none, test=none, notes=notes, metres_per_unit=2.0, weather=None)


def test_of_a_world_whose_axes_are_known_a_strip_tells_the_place(cooling, tmp_path):
    """At 100 km east of the middle of the zone its north is 0.96 degrees from that of the map."""
    scene = strip(cooling.module.scene)
    scene = replace(scene, positions=table(scene, tmp_path / "frames.csv", degrees=0.9606, easting=600_000))
    place = place_of(scene, "auto")
    found = place(torch.tensor([[0.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 1.0]]))
    assert place.crs == "EPSG:32632" and place.similarity.rotation[2, 2] == 1
    assert place.scale == pytest.approx(2.0, rel=4e-4)  # a grid metre is not quite one on the ground
    assert (found[0] - torch.tensor([6e5, 5.2e6, 100.0])).abs().max() < 0.05
    assert (found[1] - found[0] - torch.tensor([-3.353, 199.97, 0.0])).abs().max() < 0.1


def test_heights_are_of_the_column_that_has_them(cooling, tmp_path):
    """A preparation writes both columns of heights, empty where the camera's files do not say one, or neither."""
    scene = strip(cooling.module.scene)
    path = table(scene, tmp_path / "frames.csv", degrees=0.0)
    expected = place_of(scene, path)(torch.zeros(1, 3))
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([f"{head},above_takeoff_m", *(f"{row}," for row in rows)]))
    assert torch.allclose(place_of(scene, path)(torch.zeros(1, 3)), expected)
    path.write_text("\n".join([f"{head},above_takeoff_m", *(f"{row.rpartition(',')[0]},," for row in rows)]))
    assert torch.allclose(place_of(scene, path)(torch.zeros(1, 3))[:, :2], expected[:, :2])
    with pytest.raises(SceneError, match="has positions of 0 of the images"):  # without axes heights tell the turn
        place_of(replace(scene, notes={}), path)


def test_decimetres_do_not_tip_a_world_whose_axes_are_known(cooling, tmp_path):
    scene = strip(cooling.module.scene, wander=0.2)
    path = table(scene, tmp_path / "frames.csv", degrees=0.0)
    lines = path.read_text().splitlines()
    noisy = [lines[0]]
    for i, line in enumerate(lines[1:]):
        *others, height = line.split(",")
        noisy.append(",".join([*others, str(float(height) + 0.1 * (-1) ** i)]))
    path.write_text("\n".join(noisy))
    below = torch.tensor([[10.0, 0.0, -10.0]])
    expected = torch.tensor([[500_020.0, 5_200_000.0]], dtype=torch.float64)
    assert (place_of(scene, path)(below)[:, :2] - expected).norm() < 0.1
    with pytest.raises(SceneError, match="lie on a line .* leaves the turn about it open"):
        place_of(replace(scene, notes={}), path)


def test_a_world_whose_axes_are_known_is_not_turned(cooling):
    rotation = place_of(strip(cooling.module.scene)).similarity.rotation
    assert torch.equal(rotation, torch.eye(3, dtype=torch.float64))


def test_without_positions_up_is_known_and_axes_are_at_right_angles(cooling):
    place = place_of(cooling.module.scene)
    rotation = place.similarity.rotation
    assert place.crs is None
    assert torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-9)
    assert torch.linalg.det(rotation) == pytest.approx(1.0)
    along = place_of(cooling.module.scene, above=torch.tensor([1.0, 0.0, 0.0])).similarity.rotation
    assert torch.allclose(along[2], torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))


@pytest.mark.parametrize("metres", [0.0, 1e-4, 3.0])
def test_gps_that_has_nothing_to_do_with_the_cameras_places_nothing(cooling, tmp_path, caplog, metres):
    """Of a walk about a machine: one fix for all images, or fixes that are metres off. Scale and turn were those of its noise."""
    scene = replace(cooling.module.scene, metres_per_unit=None)
    noise = metres / 1e5 * torch.randn(len(scene.frames), 2, generator=torch.Generator().manual_seed(0)).double()
    lines = [f"{f.name},{47 + y:.12f},{9 + x:.12f},500" for f, (y, x) in zip(scene.frames, noise.tolist(), strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["file,lat,lon,alt", *lines]) + "\n")
    with pytest.raises(SceneError, match=r"does not place the cameras: at best they lie .* m from its positions"):
        place_of(scene, tmp_path / "a.csv")
    assert placed(replace(scene, positions=tmp_path / "a.csv")) is None and "does not place the cameras" in caplog.text


def test_cameras_at_one_place_are_placed_by_no_gps(cooling, tmp_path):
    scene = cooling.module.scene
    still = [replace(frame, camera=scene.train.frames[0].camera) for frame in scene.train.frames]
    none = ViewSet([], list)
    fixed = replace(scene, train=ViewSet(still, lambda i: None), val=none, test=none)
    path = table(scene, tmp_path / "a.csv")
    with pytest.raises(SceneError, match="does not place the cameras: all points lie at one place"):
        place_of(fixed, path)
    assert placed(replace(fixed, positions=path)) is None


def test_a_table_that_places_nothing_is_refused(cooling, tmp_path):
    scene = cooling.module.scene
    with pytest.raises(SceneError, match="has no column latitude_deg or"):
        place_of(scene, table(scene, tmp_path / "a.csv", ("file", "phi", "lambda", "altitude_m")))
    (tmp_path / "b.csv").write_text("file,lat,lon,alt\nother.png,47,9,500\n")
    with pytest.raises(SceneError, match="has positions of 0 of the images"):
        place_of(scene, tmp_path / "b.csv")
    names = [frame.name for frame in scene.train.frames[:4]]
    rows = [f"{name},47,9.00{i},500" for i, name in enumerate(names)]
    (tmp_path / "c.csv").write_text("\n".join(["file,lat,lon,alt", *rows]) + "\n")
    with pytest.raises(SceneError, match="lie on a line"):
        place_of(scene, tmp_path / "c.csv")
    with pytest.raises(SceneError, match="cannot be read"):
        place_of(scene, tmp_path / "none.csv")
