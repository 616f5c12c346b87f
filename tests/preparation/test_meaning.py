import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from heatsplat.contracts import SceneError
from heatsplat.preparation.meaning import Meaning

HERE = Path("image.png")


def celsius(calibration, values):
    return (calibration.apparent_k(torch.tensor(values, dtype=torch.float64)) - 273.15).tolist()


def test_kelvin_times_100_is_recognised_and_nothing_else_is_guessed():
    room = np.linspace(28315, 31315, 100).reshape(10, 10).astype(np.uint16)
    calibration, note = Meaning().of_counts(room, HERE)
    assert celsius(calibration, [29315.0]) == pytest.approx([20.0])
    assert "kelvin x 100" in note
    for other in (room // 4, np.linspace(0, 65535, 100).astype(np.uint16), room * 0 + 19000):
        with pytest.raises(SceneError, match="image.png holds 16-bit counts .*counts.scale"):
            Meaning().of_counts(other, HERE)
    with pytest.raises(SceneError, match=r"As DJI's 1/64 K they would be 29.5 °C \(counts.scale=0.015625\)"):
        Meaning().of_counts(room * 0 + 19371, HERE)
    with pytest.raises(
        SceneError, match=r"As 0.04 K of FLIR's Vue, Duo and Tau they would be 6.6 °C \(counts.scale=0.04\)"
    ):
        Meaning().of_counts(room * 0 + 6994, HERE)
    with pytest.raises(SceneError, match=r"As 0.1 K of a Lepton in low gain they would be 21.9 °C"):
        Meaning().of_counts(room * 0 + 2950, HERE)


def test_what_is_said_goes_before_what_is_guessed():
    sample = np.full((2, 2), 20000, np.uint16)
    assert celsius(Meaning(scale=1 / 64).of_counts(sample, HERE)[0], [19200.0]) == pytest.approx([26.85])
    assert "for image.png 39.4 .. 39.4 °C" in Meaning(scale=1 / 64).of_counts(sample, HERE)[1]
    assert celsius(Meaning(scale=0.1, offset_c=-50.0).of_counts(sample, HERE)[0], [700.0]) == pytest.approx([20.0])
    planck = Meaning(planck=[17945.85, 1435.0, 1.0, -2539, 0.0125])
    assert 5 < celsius(planck.of_counts(sample, HERE)[0], [11441.0])[0] < 20  # a FLIR ONE out of doors


def test_floats_are_celsius_unless_they_may_be_kelvin():
    assert celsius(Meaning().of_floats(np.full((2, 2), 20.0, np.float32), HERE)[0], [21.5]) == pytest.approx([21.5])
    with pytest.raises(SceneError, match="kelvin, or a furnace"):
        Meaning().of_floats(np.full((2, 2), 295.0, np.float32), HERE)
    said = Meaning(offset_c=-273.15).of_floats(np.full((2, 2), 295.0, np.float32), HERE)[0]
    assert celsius(said, [293.15]) == pytest.approx([20.0])


def test_floats_whose_file_says_fahrenheit_are_asked_about(tmp_path):
    pixels, tags = np.full((4, 5), 70.0, np.float32), ImageFileDirectory_v2()
    tags[270] = '{"unit": "F"}'
    Image.fromarray(pixels).save(tmp_path / "a.tiff", tiffinfo=tags)
    with pytest.raises(SceneError, match="a.tiff says .* °F: give counts.scale=0.555556 counts.offset_c=-17.7778, or"):
        Meaning().of_floats(pixels, tmp_path / "a.tiff")
    told = Meaning(scale=0.555556, offset_c=-17.7778).of_floats(pixels, tmp_path / "a.tiff")[0]
    assert celsius(told, [70.0]) == pytest.approx([21.11], abs=0.01)
    assert Meaning(offset_c=0.0).of_floats(pixels, tmp_path / "a.tiff")[1].startswith("floats: °C = 1 * value")


def test_floats_whose_file_says_kelvin_are_asked_about_however_hot(tmp_path):
    pixels, tags = np.full((4, 5), 1100.0, np.float32), ImageFileDirectory_v2()
    tags[270] = "unit: K"
    Image.fromarray(pixels).save(tmp_path / "a.tiff", tiffinfo=tags)
    with pytest.raises(
        SceneError, match="a.tiff says .* kelvin: give counts.offset_c=-273.15, or counts.offset_c=0 where"
    ):
        Meaning().of_floats(pixels, tmp_path / "a.tiff")
    assert celsius(Meaning(offset_c=-273.15).of_floats(pixels, tmp_path / "a.tiff")[0], [1100.0]) == pytest.approx(
        [826.85]
    )


def test_greys_have_temperatures_where_there_are_bounds(tmp_path):
    assert Meaning().of_greys(tmp_path)[0] is None
    assert celsius(Meaning(bounds_c=[10, 40]).of_greys(tmp_path)[0], [0.0, 255.0]) == pytest.approx([10.0, 40.0])
    (tmp_path / "images").mkdir()
    (tmp_path / "temperature_bounds.json").write_text('{"absolute_min_temperature": 0, "absolute_max_temperature": 51}')
    found, note = Meaning().of_greys(tmp_path / "images")
    assert celsius(found, [100.0]) == pytest.approx([20.0]) and "temperature_bounds.json" in note


@pytest.mark.parametrize(
    ("unit", "instead"),
    [
        ("F", r"\(F - 32\)"),
        ("degF", r"\(F - 32\)"),
        ("Fahrenheit", r"\(F - 32\)"),
        ("K", "K - 273.15"),
        ("kelvin", "K - 273.15"),
    ],
)
def test_bounds_in_another_unit_are_refused(tmp_path, unit, instead):
    bounds = {"absolute_min_temperature": 32, "absolute_max_temperature": 212, "Unit": unit}
    (tmp_path / "temperature_bounds.json").write_text(json.dumps(bounds))
    said = rf"bounds.json: 'Unit' is '{unit}', and temperatures are read in °C: write {instead}"
    with pytest.raises(SceneError, match=said):
        Meaning().of_greys(tmp_path)
    (tmp_path / "temperature_bounds.json").write_text(json.dumps(bounds | {"Unit": "C"}))
    assert "32 .. 212 °C" in Meaning().of_greys(tmp_path)[1]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"planck": [1.0, 2.0]}, "counts.planck"),
        ({"scale": -1.0}, "counts.scale"),
        ({"bounds_c": [1.0]}, "bounds_c"),
        ({"band_um": [14.0, 8.0]}, "band_um"),
    ],
)
def test_what_cannot_be_is_refused_by_its_name(wrong, said):
    with pytest.raises(SceneError, match=said):
        Meaning(**wrong)


def test_a_scale_is_one_of_kelvin_for_floats_as_for_counts():
    for read in (Meaning(scale=0.01).of_counts, Meaning(scale=0.01).of_floats):
        assert celsius(read(np.full((2, 2), 29815.0, np.float32), HERE)[0], [29815.0]) == pytest.approx([25.0])
    both = Meaning(scale=0.1, offset_c=-40.0).of_floats(np.full((2, 2), 600.0, np.float32), HERE)[0]
    assert celsius(both, [600.0]) == pytest.approx([20.0])
