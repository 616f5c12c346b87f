"""Renders as a protocol wants them: one file per test view, in °C."""

from types import SimpleNamespace

import pytest
import torch

from heatsplat.callbacks import temperatures
from heatsplat.callbacks.temperatures import TemperatureRenders
from heatsplat.contracts import Camera, Frame, SceneData, ThermalRange, View, ViewSet
from heatsplat.io.tiff import read_temperature

BOUNDS = ThermalRange(10.0, 30.0)


def shown(
    folder, image: str, bounds: ThermalRange | None = BOUNDS, modality: str = "thermal", names=("near_00004.png",)
) -> None:
    none, camera = ViewSet([], list), Camera(torch.eye(4), torch.eye(3), 3, 2)
    frames = [Frame(name, number, camera) for number, name in enumerate(names)]
    scene = SceneData("a", none, none, ViewSet(frames, list), torch.zeros(0, 3), thermal_range=bounds)
    module = SimpleNamespace(scene=scene, modality=modality, output_dir=folder)
    renders = TemperatureRenders(image=image)
    for number, frame in enumerate(frames):
        outputs = {
            "view": View(frame),
            "prediction": torch.full((2, 3, 1), 0.25 * (number + 1)),
            "companions": {"clean": torch.full((2, 3, 1), 0.5)},
        }
        renders.on_test_batch_end(None, module, outputs)


@pytest.mark.parametrize(("image", "celsius"), [("thermal", 15.0), ("clean", 20.0)])
def test_a_view_is_written_in_celsius(tmp_path, image, celsius):
    shown(tmp_path, image)
    assert (read_temperature(tmp_path / "submission" / "near_00004.tiff") == celsius).all()


def test_views_of_one_name_in_several_folders_are_written_side_by_side(tmp_path):
    shown(tmp_path, "thermal", names=("left/0001.png", "right/0001.png"))
    found = {path.name: read_temperature(path).mean() for path in (tmp_path / "submission").iterdir()}
    assert found == {"left_0001.tiff": 15.0, "right_0001.tiff": 20.0}


def test_names_of_many_views_are_looked_through_once(tmp_path, monkeypatch):
    asked, own = [], temperatures.file_stems
    monkeypatch.setattr(temperatures, "file_stems", lambda names: asked.append(len(names)) or own(names))
    shown(tmp_path, "thermal", names=("left/0001.png", "right/0001.png", "right/0002.png"))
    assert asked == [3] and len(list((tmp_path / "submission").iterdir())) == 3


def test_what_is_no_temperature_is_not_written(tmp_path):
    shown(tmp_path, "thermal", bounds=None)
    shown(tmp_path, "thermal", modality="rgb")
    assert not list(tmp_path.iterdir())
