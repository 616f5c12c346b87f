"""GeoTIFF as rasterio reads it: what lies where on the map, and how warm it is."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from heatsplat.contracts import SceneError
from heatsplat.export.basis import constant_basis
from heatsplat.export.formats.map import Map
from heatsplat.export.moment import moments
from heatsplat.export.place import place_of
from heatsplat.io.pictures import MARKED
from heatsplat.io.tables import read_csv
from heatsplat.training.cameras import RefinedCameras

rasterio = pytest.importorskip("rasterio", reason="rasterio is not installed (pip install -e '.[dev]')")


@pytest.fixture
def two_plates(cooling):
    """Two opaque discs of 0.2 and 0.8 (image values), the warm one higher, east and north of the other."""
    seen = replace(
        cooling.seen,
        means=torch.tensor([[0.0, 0.0, 0.0], [2.0, 1.0, 0.5]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1),
        scales=torch.tensor([[0.3, 0.3, 0.01]]).repeat(2, 1),
        opacities=torch.full((2,), 0.99),
        layers=[replace(cooling.layer, basis=constant_basis(torch.tensor([0.2, 0.8])))],
        attributes={"time constant": torch.tensor([100.0, 900.0])},
    )
    return moments(cooling.module, seen, 600.0)[0]


def test_temperature_and_attributes_lie_where_they_are(two_plates, tmp_path):
    form = Map(resolution=0.02, bounds=[-3, -3, 3, 3], above=[0, 0, 1], unseen="keep")
    form.write(two_plates, tmp_path / "a.tif")
    bounds = two_plates.module.scene.thermal_range
    with rasterio.open(tmp_path / "a.tif") as found:
        assert found.descriptions[0] == "temperature [deg C]" and found.descriptions[1] == "time_constant"
        assert (found.width, found.height) == (300, 300) and np.isnan(found.nodata)
        places = place_of(two_plates.module.scene, above=torch.tensor([0.0, 0.0, 1.0]))(two_plates.seen.means).tolist()
        for (x, y, _), unit, seconds in zip(places, (0.2, 0.8), (100.0, 900.0), strict=True):
            (values,) = found.sample([(x, y)])
            assert values[0] == pytest.approx(bounds.to_celsius(unit), abs=0.02)
            assert values[1] == pytest.approx(seconds, rel=1e-4)
        (nothing,) = found.sample([(0.5 * (places[0][0] + places[1][0]), 0.5 * (places[0][1] + places[1][1]))])
        assert np.isnan(nothing).all()


def test_what_was_seen_does_not_depend_on_what_cameras_were_learned(two_plates, tmp_path, monkeypatch):
    module, shown = two_plates.module, []
    cameras = RefinedCameras()
    cameras.prepare(module.scene)
    for turned_px in (0.0, 20.0):
        torch.nn.init.constant_(cameras.moves, turned_px)
        monkeypatch.setitem(module._modules, "cameras", cameras)
        Map(resolution=0.1, above=[0, 0, 1]).write(two_plates, tmp_path / "a.tif")
        with rasterio.open(tmp_path / "a.tif") as found:
            shown.append(np.isfinite(found.read(1)))
    assert np.array_equal(*shown) and shown[0].any()


def test_attributes_that_few_of_a_pixel_lack_are_those_of_the_others(two_plates, tmp_path):
    """A Gaussian without a U-value before one that has it: as 0 it would make the wall a better one."""
    seen = two_plates.seen
    seen = replace(
        seen,
        means=torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.0, 0.0], [2.0, 1.0, 0.5]]),
        quats=seen.quats[[0, 0, 1]], scales=seen.scales[[0, 0, 1]], opacities=torch.tensor([0.3, 0.99, 0.99]),
        layers=[replace(two_plates.layer, basis=constant_basis(torch.tensor([0.2, 0.2, 0.8])))],
        attributes={"u": torch.tensor([torch.nan, 1.5, torch.nan])},
    )  # fmt: skip
    moment = moments(two_plates.module, seen, 600.0)[0]
    Map(resolution=0.02, bounds=[-3, -3, 3, 3], above=[0, 0, 1], unseen="keep").write(moment, tmp_path / "a.tif")
    with rasterio.open(tmp_path / "a.tif") as found:
        places = place_of(moment.module.scene, above=torch.tensor([0.0, 0.0, 1.0]))(seen.means).tolist()
        (wall,), (unknown,) = (found.sample([place[:2]]) for place in (places[1], places[2]))
    assert wall[1] == pytest.approx(1.5, rel=1e-3)
    assert np.isfinite(unknown[0]) and np.isnan(unknown[1])


def test_a_quotient_is_that_of_what_a_pixel_mixes(two_plates, tmp_path, monkeypatch):
    """Not the mean of what each of two Gaussians would have alone."""
    seen = two_plates.seen
    seen = replace(
        seen,
        means=torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.0, 0.0]]),
        opacities=torch.tensor([0.5, 0.99]),
        attributes={
            "loss": torch.tensor([10.0, 30.0]), "driven": torch.tensor([1.0, 2.0]), "u": torch.tensor([10.0, 15.0])
        },
    )  # fmt: skip
    moment = moments(two_plates.module, seen, 600.0)[0]
    monkeypatch.setattr(moment.module.thermal, "quotients", lambda told: {"u": told["loss"] / told["driven"]})
    Map(resolution=0.02, bounds=[-3, -3, 3, 3], above=[0, 0, 1], unseen="keep").write(moment, tmp_path / "a.tif")
    with rasterio.open(tmp_path / "a.tif") as found:
        places = place_of(moment.module.scene, above=torch.tensor([0.0, 0.0, 1.0]))(seen.means).tolist()
        ((_, loss, driven, u),) = found.sample([places[1][:2]])
    assert u == pytest.approx(loss / driven, rel=1e-5)
    front = (driven - 2.0) / (1.0 - 2.0)  # share of the one before the other
    assert 0.3 < front < 0.7 and abs(u - (front * 10.0 + (1 - front) * 15.0)) > 0.2


def test_the_last_band_is_the_height_of_the_surface(two_plates, tmp_path, monkeypatch):
    """Also of a map that is looked at in strips, and of places that float32 tells to a millimetre only by the camera."""
    form = Map(resolution=0.02, bounds=[-3, -3, 3, 3], above=[0, 0, 1], unseen="keep", height=True)
    form.write(two_plates, tmp_path / "a.tif")
    monkeypatch.setattr("heatsplat.geometry.closest_depth.AT_ONCE", 7 * 300)
    form.write(two_plates, tmp_path / "strips.tif")
    places = place_of(two_plates.module.scene, above=torch.tensor([0.0, 0.0, 1.0]))(two_plates.seen.means).tolist()
    with rasterio.open(tmp_path / "a.tif") as found, rasterio.open(tmp_path / "strips.tif") as strips:
        assert found.descriptions[-1] == "height [metre]"
        heights, values = found.read(found.count), found.read(1)
        assert np.array_equal(np.isfinite(heights), np.isfinite(values))
        for x, y, z in places:
            for file in (found, strips):
                assert next(file.sample([(x, y)]))[-1] == pytest.approx(z, abs=0.01)


def test_areas_of_an_isotherm_lie_beside_the_map_and_in_its_picture(two_plates, tmp_path):
    settings = {"resolution": 0.02, "bounds": [-3, -3, 3, 3], "above": [0, 0, 1], "unseen": "keep"}
    bounds = two_plates.module.scene.thermal_range
    Map(**settings).write(two_plates, tmp_path / "plain.tif")
    Map(**settings, height=True, isotherm=[bounds.to_celsius(0.5), None]).write(two_plates, tmp_path / "a.tif")
    (row,) = read_csv(tmp_path / "a_areas.csv")
    with rasterio.open(tmp_path / "a.tif") as found:
        warm = found.read(1) >= bounds.to_celsius(0.5)
    assert row["area_m2"] == pytest.approx(warm.sum() * 0.02**2, rel=1e-5)
    place = place_of(two_plates.module.scene, above=torch.tensor([0.0, 0.0, 1.0]))(two_plates.seen.means)[1].tolist()
    assert np.hypot(row["spot_x"] - place[0], row["spot_y"] - place[1]) < 0.9
    assert row["spot_height"] == pytest.approx(place[2], abs=0.01)
    with Image.open(tmp_path / "a.png") as picture, Image.open(tmp_path / "plain.png") as plain:
        green = [(np.asarray(one.convert("RGB")) == MARKED).all(2).sum() for one in (picture, plain)]
    assert green[0] > 100 and green[1] == 0


def test_bounds_beside_the_scene_are_refused(two_plates, tmp_path):
    for bounds in ([51.40, 4.43, 51.41, 4.44], [500, 500, 510, 510]):
        with pytest.raises(SceneError, match="what.bounds=.* holds no pixel of the scene, which runs from"):
            Map(resolution=0.1, bounds=bounds, above=[0, 0, 1]).write(two_plates, tmp_path / "a.tif")
    assert not list(tmp_path.iterdir())


def test_a_map_has_a_picture(two_plates, tmp_path):
    Map(resolution=0.02, bounds=[-3, -3, 3, 3], above=[0, 0, 1], unseen="keep").write(two_plates, tmp_path / "a.tif")
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.width > 600 and picture.height > 600  # two pixels for one, and a bar beside


def test_a_map_that_lies_elsewhere_is_told_or_refused(cooling, tmp_path, caplog):
    places, count = torch.Generator().manual_seed(3), 20  # of one temperature, discs would fit wherever they overlap
    seen = replace(
        cooling.seen,
        means=torch.rand(count, 3, generator=places) * torch.tensor([4.0, 4.0, 0.5]) - torch.tensor([2.0, 2.0, 0.0]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        scales=torch.tensor([[0.3, 0.3, 0.01]]).repeat(count, 1),
        opacities=torch.full((count,), 0.8),
        layers=[replace(cooling.layer, basis=constant_basis(torch.linspace(0.1, 0.9, count)))],
        attributes={},
    )
    discs = moments(cooling.module, seen, 600.0)[0]
    settings = {"resolution": 0.1, "above": [0, 0, 1], "unseen": "keep"}
    Map(**settings, bounds=[-3, -3, 3, 3]).write(discs, tmp_path / "a.tif")
    with rasterio.open(tmp_path / "a.tif") as file:
        profile, values, tags = file.profile, file.read(1), file.tags()
    with rasterio.open(tmp_path / "moved.tif", "w", **profile | {"count": 1}) as file:
        file.write(np.roll(values, 4, axis=1) + 2.0, 1)
        file.update_tags(**tags | {"scene": "a week later"})
    with caplog.at_level("INFO", logger="heatsplat"):
        Map(**settings, bounds=[-3, -3, 3, 3], against=tmp_path / "moved.tif").write(discs, tmp_path / "b.tif")
    assert re.search("moved.tif lies 0.4 metre to the east and -?0 to the north of this map", caplog.text)
    assert "shows that shift" in caplog.text
    with pytest.raises(
        SceneError, match="a.tif has 60 x 60 pixels of 0.1 from .-3, 3. on, this map 60 x 60 .* from .-2, 3. on"
    ):
        Map(**settings, bounds=[-2, -3, 4, 3], against=tmp_path / "a.tif").write(discs, tmp_path / "c.tif")
    with rasterio.open(tmp_path / "a.tif", "r+") as file:
        file.set_band_description(1, "value")  # as of a run on greys
    with pytest.raises(SceneError, match=r"a.tif is a map of value, this one of temperature \[deg C\]"):
        Map(**settings, bounds=[-3, -3, 3, 3], against=tmp_path / "a.tif").write(discs, tmp_path / "c.tif")
    assert not (tmp_path / "c.tif").exists()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"resolution": 0}, "what.resolution must be above 0"),
        ({"resolution": "abc"}, "what.resolution must be a number, got abc"),
        ({"bounds": 5}, "what.bounds must be a list of 4 numbers, got 5"),
        ({"above": 1}, "what.above must be a list of 3 numbers, got 1"),
        ({"bounds": [3, 0, 1, 2]}, "what.bounds must be"),
        ({"unseen": "show"}, "what.unseen must be one of nan, keep, got 'show'"),
        ({"above": [0, 0, 0]}, "what.above must be a direction"),
        ({"isotherm": [30]}, "what.isotherm must be"),
        ({"isotherm": [30, None], "least_area": 0}, "what.least_area must be above 0"),
        ({"least_area": 2.0}, "what.least_area is of the areas of an isotherm: give what.isotherm"),
    ],
)
def test_settings_that_make_no_map_are_named(settings, message):
    with pytest.raises(SceneError, match=message):
        Map(**settings)


def test_an_unquoted_nan_is_the_word():
    """As Hydra reads what.unseen=nan."""
    assert Map(unseen=float("nan")).unseen == "nan"
