"""Regions of a scene against temperatures that Planck's law itself gives, and tables that are none of regions."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from running import TINY, run
from scipy.integrate import quad
from scipy.ndimage import binary_dilation
from scipy.optimize import brentq

from heatsplat.composition import build, compose
from heatsplat.contracts import Camera, Frame, SceneData, SceneError, ThermalRange, View, ViewSet
from heatsplat.datamodules.formats.colmap import pinholes, write_model
from heatsplat.geometry.sight_lines import rays
from heatsplat.io.tiff import read_temperature, write_temperature
from heatsplat.physics.planck import Band
from heatsplat.physics.radiometry import BandResponse, Conditions
from heatsplat.preparation.conditions import GivenConditions, InputUncertainty
from heatsplat.preparation.correction import correct, correct_scene, corrected
from heatsplat.preparation.regions import MIRRORS, Region, Regions, read_regions, region_of

ORIGIN = torch.tensor([4000.0, -200.0, 30.0], dtype=torch.float64)
CAMERA = Camera(
    torch.eye(4, dtype=torch.float64),
    torch.tensor([[38.0, 0, 20.0], [0, 38.0, 16.0], [0, 0, 1]], dtype=torch.float64),
    40,
    32,
)
# A wall 8 units away, with a metal plate and a pane of glass on it; the metal has a strip of tape.
DEPTH = torch.full((32, 40), 8.0, dtype=torch.float64)
X, Y = (8.0 * rays(CAMERA)[..., i] for i in (0, 1))
METAL = (X > -3.0) & (X < -0.5) & (Y > -1.9) & (Y < 1.9)
TAPE = METAL & (Y > -0.4) & (Y < 0.4)
GLASS = (X > 0.5) & (X < 3.0) & (Y > -1.9) & (Y < 1.9)
METRES = 2.5
GIVEN = GivenConditions(emissivity=0.95, reflected_c=12.0, air_c=8.0, humidity_percent=70)
TABLE = """name,x1,y1,z1,x2,y2,z2,emissivity,reflected_c
metal,3997,-201.9,37.5,3999.5,-198.1,38.5,0.2,-30
glass,4003,-198.1,38.5,4000.5,-201.9,37.5,0.85,
tape,3997,-200.4,37.9,3999.5,-199.6,38.1,0.95,
"""
SURFACES = {
    "metal": (0.2, -30.0),
    "glass": (0.85, 12.0),
    "tape": (0.95, 12.0),
    "wall": (0.95, 12.0),
}  # emissivity, reflected °C


def radiance(celsius: float) -> float:
    """Of a black body in 7.5 to 14 µm, W/(m² sr), by Planck's law and adaptive quadrature."""
    kelvin, h, c, k = celsius + 273.15, 6.62607015e-34, 299792458.0, 1.380649e-23

    def spectral(micrometres):
        wavelength = 1e-6 * micrometres
        return 1e-6 * 2 * h * c**2 / wavelength**5 / math.expm1(h * c / (wavelength * k * kelvin))

    return quad(spectral, 7.5, 14.0, epsabs=0, epsrel=1e-12)[0]


def of_air(metres: float, celsius: float, share: float) -> float:
    """FLIR's transmittance of air, as its manuals print it."""
    water = share * math.exp(1.5587 + 0.06939 * celsius - 0.00027816 * celsius**2 + 0.00000068455 * celsius**3)
    one, other = (
        math.exp(-math.sqrt(metres) * (a + b * math.sqrt(water)))
        for a, b in ((0.006569, -0.002276), (0.01262, -0.00667))
    )
    return 1.9 * one + (1 - 1.9) * other


def apparent(celsius: float, emissivity: float, reflected_c: float, metres: float) -> float:
    """What a camera that knows of a black body alone reads, °C."""
    passed = of_air(metres, 8.0, 0.7)
    sent = emissivity * passed * radiance(celsius) + (1 - emissivity) * passed * radiance(reflected_c)
    sent += (1 - passed) * radiance(8.0)
    return brentq(lambda found: radiance(found) - sent, -80.0, 200.0, xtol=1e-9)


@pytest.fixture(scope="module")
def filmed():
    """True and measured °C [H, W] of the wall: every surface has two temperatures, and the same distance along rings alone."""
    kinds = np.where(METAL & ~TAPE, "metal", np.where(TAPE, "tape", np.where(GLASS, "glass", "wall")))
    warm = {"metal": 60.0, "tape": 61.0, "glass": 15.0, "wall": 22.0}
    truth = np.array([[warm[kind] + 6.0 * (row % 2) for kind in line] for row, line in enumerate(kinds)])
    metres = METRES * 8.0 * rays(CAMERA).norm(dim=-1).numpy()
    seen = {}
    for key in zip(truth.ravel(), kinds.ravel(), metres.round(9).ravel(), strict=True):
        if key not in seen:
            seen[key] = apparent(key[0], *SURFACES[key[1]], key[2])
    keys = zip(truth.ravel(), kinds.ravel(), metres.round(9).ravel(), strict=True)
    return torch.from_numpy(truth), torch.tensor([seen[key] for key in keys], dtype=torch.float64).reshape(32, 40)


def at_edges(part):
    """Pixels of a part [H, W] and around it that have neighbours on the other side."""
    near = np.ones((3, 3), dtype=bool)
    return binary_dilation(part, near) & binary_dilation(~part, near)


def boxes(tmp_path, text=TABLE):
    path = tmp_path / "regions.csv"
    path.write_text(text, encoding="utf-8")
    return read_regions(path)


def scene(celsius):
    span = ThermalRange(-40.0, 80.0)
    frames = [Frame(f"{i}.tiff", i, CAMERA, time_s=2.0 * i) for i in range(3)]
    image = span.to_unit(celsius).double()[..., None]
    views = ViewSet(frames, lambda i: View(frames[i], thermal=image))
    points = torch.stack([X, Y, DEPTH], -1).reshape(-1, 3)[::7].float()
    notes = {"origin": ORIGIN.tolist()}
    return SceneData(
        name="wall", train=views.subset([0, 1]), val=views.subset([]), test=views.subset([2]), points=points,
        thermal_range=span, notes=notes,
    )  # fmt: skip


def corrected_by(tmp_path, celsius, regions, index=None, given=GIVEN, depth=DEPTH):
    target = tmp_path / "new"
    page = correct_scene(
        scene(celsius), lambda frame: depth, [], target, given, BandResponse(Band(nodes=64)), index, METRES, regions
    )
    return read_temperature(target / "images" / "1.tiff"), page.read_text(encoding="utf-8"), target


def test_temperatures_come_back_in_every_region(tmp_path, filmed):
    truth, measured = filmed
    image, text, target = corrected_by(tmp_path, measured, boxes(tmp_path))
    edge = np.isnan(image)
    np.testing.assert_allclose(image[~edge], truth.float().numpy()[~edge], atol=2e-3)  # images are float32
    assert (edge == at_edges((METAL & ~TAPE).numpy())).all()  # of metal alone the other side would be kelvins off
    without, *_ = corrected_by(tmp_path, measured, [])
    for part, least in ((METAL & ~TAPE, 20.0), (GLASS, 0.1)):
        assert np.abs(without - truth.numpy())[part].min() > least
    rows = {cells[0]: cells for line in text.splitlines() if len(cells := line.strip("| ").split(" | ")) == 11}
    for name, part in (("metal", METAL & ~TAPE), ("glass", GLASS), ("tape", TAPE)):
        _, _, reflected, pixels, images, before, after, *_, at_edge = rows[name]
        assert float(reflected) == SURFACES[name][1] and (int(pixels), int(images)) == (3 * part.sum(), 3)
        kept = part.numpy() & ~edge
        assert float(after) == pytest.approx(truth.numpy()[kept].mean(), abs=6e-3)
        assert float(before) == pytest.approx(without[kept].mean(), abs=6e-3)
        assert int(at_edge) == 3 * (part.sum() - kept.sum())
    assert f"in no region {3 * (edge & ~(METAL | GLASS).numpy()).sum():,}." in text
    assert "Most of what 'metal' sends is reflected" in text and "Most of what 'glass'" not in text
    assert "are assumed" not in text.split("## What")[0].replace("20 °C and 50 % are assumed", "")
    assert (target / "report" / "regions.png").stat().st_size > 1000 and "report/regions.png" in text


def test_what_an_uncertain_emissivity_leaves_is_what_another_one_changes(tmp_path, filmed):
    """Against the whole correction with an emissivity and a reflected temperature that are off by so much."""
    _, measured = filmed
    regions = boxes(tmp_path)
    few = InputUncertainty(emissivity=1e-3, reflected_c=0.1)
    done = Conditions()

    def image(regions):
        whole = Regions(regions, few, ORIGIN)
        wanted = GIVEN.conditions(replace(done, distance_m=20.0))
        return corrected(measured, CAMERA, DEPTH, METRES, BandResponse(), done, wanted, None, whole)

    found = image(regions).parts
    assert not found.edge[GLASS].any()
    for change, name in (({"emissivity": 0.2 + 1e-3}, "emissivity"), ({"reflected_c": -29.9}, "reflected_k")):
        other = image([replace(regions[0], **change), *regions[1:]]).celsius - image(regions).celsius
        here = METAL & ~TAPE & found.edge.logical_not()
        torch.testing.assert_close(other[here].abs(), found.unsure[name][here], rtol=0.02, atol=1e-4)
    assert found.unsure["emissivity"][here].min() > 5 * found.unsure["emissivity"][GLASS].max()
    assert found.unsure["emissivity"][~(METAL | GLASS)].isnan().all()


def test_depths_that_run_across_edges_leave_pixels_out_instead_of_wrong(tmp_path, filmed):
    truth, measured = filmed
    soft = DEPTH + 0.2 * torch.sin(torch.arange(40.0, dtype=torch.float64))  # boxes of metal and glass are a unit deep
    deep = TABLE.replace("37.9,3999.5,-199.6,38.1", "37.5,3999.5,-199.6,38.5")
    image, text, _ = corrected_by(tmp_path, measured, boxes(tmp_path, deep), depth=soft)
    found = np.isfinite(image)
    assert np.abs(image - truth.numpy())[found].max() < 2.0  # of metal it would be 60
    assert found[~at_edges((METAL & ~TAPE).numpy()) & ~at_edges(METAL.numpy())].mean() > 0.97
    thin = TABLE.replace("-200.4,37.9,3999.5,-199.6", "-200.2,37.9,3999.5,-200")  # a pixel
    assert (
        "pixels of 'tape' are left out because they lie at its edges"
        in corrected_by(tmp_path, measured, boxes(tmp_path, thin))[1]
    )


@pytest.mark.parametrize("emissivity", [0.9, MIRRORS / 2])
def test_the_angle_counts_where_fresnels_law_of_a_dielectric_holds(filmed, emissivity):
    """A region that holds everything, against a scene that is all like it."""
    _, measured = filmed
    slant = 8.0 / (1.0 + rays(CAMERA)[..., 0])
    everything = torch.full((3,), 1e6, dtype=torch.float64)
    whole = Regions([Region("all", -everything, everything, emissivity, -60.0)], InputUncertainty(), ORIGIN)
    wanted = GIVEN.conditions(Conditions(distance_m=20.0))
    alike = replace(wanted, emissivity=emissivity, reflected_k=213.15)
    found, bare = (
        corrected(measured, CAMERA, slant, METRES, BandResponse(), Conditions(), *settings)
        for settings in ((wanted, 1.5, whole), (alike, 1.5))
    )
    truth = bare.alike if emissivity > MIRRORS else bare.distance_only
    torch.testing.assert_close(found.celsius, truth, rtol=0, atol=1e-9)
    assert (bare.alike - bare.distance_only).abs().max() > 0.05  # the angle matters here


def test_the_report_names_regions_that_keep_their_emissivity_at_every_angle(tmp_path, filmed):
    _, text, _ = corrected_by(tmp_path, filmed[1], boxes(tmp_path), index=1.5)
    assert "stays the same at every angle: metal." in text


def test_pixels_that_reflect_more_than_was_measured_are_left_out_and_counted(tmp_path, filmed):
    hot = boxes(tmp_path, TABLE.replace("0.2,-30", "0.2,70"))
    image, text, target = corrected_by(tmp_path, filmed[1], hot)
    here = (METAL & ~TAPE).numpy()
    assert np.isnan(image[here]).all() and np.isfinite(image[~(here | at_edges(here))]).all()
    assert f"{3 * here.sum():,} of the {3 * here.sum():,} pixels of 'metal' have no temperature" in text
    bounds = (target / "temperature_bounds.json").read_text()
    assert "-1" not in bounds and "nan" not in bounds.lower()


@pytest.mark.parametrize(("own_c", "possible"), [(-150.0, False), (-90.0, True)])
def test_what_no_surface_is_as_cold_as_is_impossible_too(tmp_path, own_c, possible):
    """Less than nothing is left beside the reflection in theory; in practice already where next to nothing is."""
    sent = 0.2 * radiance(own_c) + 0.8 * radiance(10.0)
    measured = brentq(lambda found: radiance(found) - sent, -80.0, 50.0, xtol=1e-10)
    everything = torch.full((3,), 1e6, dtype=torch.float64)
    whole = Regions([Region("all", -everything, everything, 0.2, 10.0)], InputUncertainty(), ORIGIN)
    image, still = torch.full_like(DEPTH, measured), Conditions(air_k=measured + 273.15)
    found = corrected(image, CAMERA, DEPTH, 1e-9, BandResponse(Band(nodes=64)), still, still, None, whole)
    if possible:
        torch.testing.assert_close(found.celsius, torch.full_like(DEPTH, own_c), rtol=0, atol=1e-3)
    assert found.celsius.isnan().all() != possible


def test_pixels_outside_of_regions_that_have_no_temperature_are_counted(tmp_path, filmed):
    given = replace(GIVEN, emissivity=0.2, reflected_c=60.0)
    image, text, _ = corrected_by(tmp_path, filmed[1], boxes(tmp_path), given=given)
    outside = np.isnan(image) & ~(METAL | GLASS).numpy()
    assert np.isnan(image[at_edges(GLASS.numpy())]).all()  # on the other side they would have none
    assert outside.sum() > 800 and f"{3 * outside.sum():,} pixels outside of all regions have no temperature" in text


def test_a_region_that_no_image_shows_is_named_with_where_the_scene_lies(tmp_path, filmed):
    away = boxes(tmp_path, TABLE + "roof,0,0,0,1,1,1,0.9,\n")
    _, text, _ = corrected_by(tmp_path, filmed[1], away)
    assert "The region 'roof' has no pixel" in text and "The scene's points lie between [39" in text
    assert "| roof | 0.9 | 12.0 | 0 | 0 | – | – | – | – | 0 | 0 |" in text
    alone = boxes(tmp_path, TABLE.splitlines()[0] + "\nroof,0,0,0,1,1,1,0.9,\n")
    _, text, target = corrected_by(tmp_path / "b", filmed[1], alone)
    assert "regions.png" not in text and not (target / "report" / "regions.png").exists()


@pytest.mark.parametrize("said", [False, True])
def test_what_nothing_says_of_reflections_is_told(tmp_path, filmed, said):
    text = corrected_by(tmp_path, filmed[1], boxes(tmp_path), given=replace(GIVEN, reflected_c=12.0 if said else None))[
        1
    ]
    assert ("Nothing says what the surfaces of the regions reflect, so 20 °C" in text) != said
    kelvin = boxes(tmp_path, TABLE.replace("0.2,-30", "0.2,293"))
    assert "if it was meant in kelvin, give 19.85" in corrected_by(tmp_path, filmed[1], kelvin)[1]


def test_of_boxes_that_overlap_the_smallest_counts():
    def box(half):
        corner = torch.full((3,), half, dtype=torch.float64)
        return Region(f"{half}", -corner, corner, 0.9)

    places = torch.tensor([[0.5, 0, 0], [1.5, 0, 0], [2.5, 0, 0], [3.5, 0, 0], [torch.nan, 0, 0], [torch.inf, 0, 0]])
    assert region_of([box(2.0), box(1.0), box(3.0)], places.double()).tolist() == [1, 0, 2, -1, -1, -1]
    shifted = replace(box(1.0), low=torch.tensor([0.0, -1, -1]), high=torch.tensor([2.0, 1, 1]))
    assert region_of([box(1.0), shifted], places[:2].double()).tolist() == [0, 1]  # of equally large ones the first


def test_a_table_is_read_as_programs_write_it(tmp_path):
    metal, glass, tape = boxes(tmp_path)
    assert (metal.name, metal.emissivity, metal.reflected_c) == ("metal", 0.2, -30.0)
    assert glass.low.tolist() == [4000.5, -201.9, 37.5] and glass.high.tolist() == [4003, -198.1, 38.5]
    assert glass.reflected_c is None
    german = TABLE.replace(",", ";").replace(".", ",").replace("tape", "#1 Klebeband, matt")
    again = boxes(tmp_path, german)
    assert again[2].name == "#1 Klebeband, matt"
    assert [one.low.tolist() for one in again] == [one.low.tolist() for one in (metal, glass, tape)]
    measured = "name,values,time (s),clock (UTC),min (°C),mean (°C),max (°C),standard deviation (°C),pixels"
    of_viewer = (
        f'{measured},x1,y1,z1,x2,y2,z2,"above 30 °C (%)",emissivity\n'
        'box 1,"temperature",3.000,2026-07-01T06:00:00.000,1,2,3,0.5,99,0,0,0,1,1,1,5.00,0.3\n'
    )
    (box,) = boxes(tmp_path, of_viewer)
    assert (box.name, box.emissivity, box.high.tolist()) == ("box 1", 0.3, [1, 1, 1])


HEAD, ROW = "name,x1,y1,z1,x2,y2,z2,emissivity,reflected_c", "metal,0,0,0,1,1,1,0.2,"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name,x1,y1,z1,x2,y2,z2\nmetal,0,0,0,1,1,1\n", "has no column emissivity; needed are name, x1"),
        ("name,x1,y1,z1,x2,y2,z2,emissivty\nm,0,0,0,1,1,1,1\n", r"no column emissivity \(is 'emissivty' meant to be em"),
        (f"{HEAD.replace('reflected_c', 'reflected')}\n{ROW}\n", r"'reflected' means nothing here \(is 'reflected' meant"),
        (f"{HEAD},name\n{ROW},a\n", "two columns 'name'"),
        (f"{HEAD}\n", "has no region: below the names of columns"),
        (f"{HEAD}\n{ROW}\n{ROW}\n", "line 3: there is a region 'metal' already"),
        (f"{HEAD}\n{ROW}\ntin,1,1,1,0,0,0,0.3,\n", "line 3: 'tin' is the same box as 'metal'"),
        (f"{HEAD}\n,0,0,0,1,1,1,0.2,\n", "line 2: the region has no name"),
        (f"{HEAD}\nline 1,,,,,,,0.2,\n", "line 2, 'line 1' has no corners: .*delete the line"),
        (f"{HEAD}\nm,0,0,zero,1,1,1,0.2,\n", "line 2, 'm': z1 is 'zero', a coordinate is needed"),
        (f"{HEAD}\nm,0,0,0,1,,1,0.2,\n", "line 2, 'm': y2 is '', a coordinate is needed"),
        (f"{HEAD}\nm,0,0,0,1,1,1e300,0.2,\n", "z2 is 1e.300, a coordinate of the scene is needed"),
        (f"{HEAD}\nm,0,0,nan,1,1,1,0.2,\n", "z1 is nan, a coordinate is needed"),
        (f"{HEAD}\nm,0,2,0,1,2,0,0.2,\n", "line 2, 'm': both corners have the same y and z, .*make it larger"),
        (f"{HEAD}\nm,0,0,0,1,1,1,,\n", "line 2, 'm': emissivity is '', a number above 0 and up to 1 is needed"),
        (f"{HEAD}\nm,0,0,0,1,1,1,95,\n", "emissivity is 95, it must lie between 0.001 and 1; if per cent are meant, 0.95"),
        (f"{HEAD}\nm,0,0,0,1,1,1,0,\n", "emissivity is 0, it must lie between"),
        (f"{HEAD}\nm,0,0,0,1,1,1,-0.2,\n", "emissivity is -0.2, it must lie between"),
        (f"{HEAD}\nm,0,0,0,1,1,1,0.2,warm\n", "reflected_c is 'warm', a temperature in °C is needed"),
        (f"{HEAD}\nm,0,0,0,1,1,1,0.2,-300\n", "reflected_c is -300, it must lie between -272.15 and"),
        (f"{HEAD}\nm,0,0,0,1,1\n", "line 2: 6 cells for 9 columns"),
        ("", "is empty"),
    ],
)  # fmt: skip
def test_a_table_of_no_regions_is_refused_with_line_and_remedy(tmp_path, text, said):
    with pytest.raises(SceneError, match=f"regions.csv.*{said}"):
        boxes(tmp_path, text)


def test_boxes_before_and_behind_a_camera_are_drawn(tmp_path, filmed):
    around = boxes(tmp_path, TABLE + "room,3900,-300,-70,4100,-100,130,0.9,\nbehind,4000,-200,0,4001,-199,1,0.9,\n")
    _, text, target = corrected_by(tmp_path, filmed[1], around)
    assert (target / "report" / "regions.png").stat().st_size > 1000 and "The region 'behind' has no pixel" in text


def test_a_table_that_is_not_there_is_refused_before_the_run_is_loaded(tmp_path):
    settings = {"conditions": {}, "band_um": (8, 14), "refractive_index": None, "metres_per_unit": 1.0}
    with pytest.raises(SceneError, match="correct.regions=none.csv: there is no file"):
        correct("no.ckpt", tmp_path, regions="none.csv", **settings)


def test_a_trained_scene_is_corrected_in_its_regions_and_trains_again(tmp_path):
    """From a folder to a run on the corrected one, as commands do it: three walls side by side, the middle one of metal."""
    root, poses, depth = tmp_path / "scene", {}, 4.0
    for i in range(8):
        camera = CAMERA.viewmat.clone()
        camera[0, 3] = 0.1 * (i - 3.5)
        poses[f"{i}.tiff"] = replace(CAMERA, viewmat=camera)
        x = depth * rays(CAMERA)[..., 0] - camera[0, 3]
        write_temperature(root / "images" / f"{i}.tiff", torch.where(x.abs() < 1.0, 5.0, 20.0).float().numpy())
    kinds, camera_of = pinholes(poses)
    across = torch.cartesian_prod(*(torch.linspace(-2.5, 2.5, 26, dtype=torch.float64) for _ in range(2)))
    points = torch.cat([across, torch.full((len(across), 1), depth, dtype=torch.float64)], 1).numpy()
    viewmats = {name: camera.viewmat.numpy() for name, camera in poses.items()}
    colours = np.full(points.shape, 128, dtype=np.uint8)
    write_model(root / "sparse" / "0", viewmats, kinds, points, colours, camera_of=camera_of)
    settings = ("method=3dgs", "data=colmap", "max_steps=30", *TINY[1:], "doctor=false", "test=false")
    run(tmp_path / "run", *settings, f"data.root={root}")
    table = tmp_path / "regions.csv"
    table.write_text("name;x1;y1;z1;x2;y2;z2;emissivity;reflected_c\nmetal;-1,0;-9;3;1,0;9;5;0,3;-10\n")
    target = tmp_path / "corrected"
    given = ("conditions.emissivity=0.95", "conditions.reflected_c=0", "correct.metres_per_unit=1")
    prepare = compose(
        ["correct=scene", f"ckpt={tmp_path / 'run'}", f"target={target}", f"correct.regions={table}", *given], "prepare"
    )
    build(prepare["correct"], target=target)
    image = read_temperature(target / "images" / "3.tiff")
    x = (depth * rays(CAMERA)[..., 0] - poses["3.tiff"].viewmat[0, 3]).numpy()
    middle = np.abs(x) < 0.7
    band, air = Band(nodes=64), Conditions(distance_m=4.0).transmittance().item()
    kelvin = torch.tensor([278.15, 263.15, 293.15], dtype=torch.float64)
    measured, reflected, of_air = band.radiance(kelvin).tolist()
    own = (measured - 0.7 * air * reflected - (1 - air) * of_air) / (0.3 * air)
    truth = band.temperature(torch.tensor([own], dtype=torch.float64)).item() - 273.15
    assert np.median(image[middle]) == pytest.approx(truth, abs=0.05) and truth > 30
    assert 20.0 < np.median(image[np.abs(x) > 1.4]) < 22.0
    assert np.isnan(image[np.abs(np.abs(x) - 1.0) < 0.11]).mean() > 0.5
    module, _ = run(tmp_path / "again", *settings, f"data.root={target}")
    assert module.scene.thermal_range.max_c > 30
