"""Renders as a protocol wants them: one file per test view, in °C."""

from types import SimpleNamespace

import pytest
import torch

from heatsplat.callbacks.temperatures import TemperatureRenders
from heatsplat.contracts import Camera, Frame, SceneData, ThermalRange, View, ViewSet
from heatsplat.io.tiff import read_temperature

BOUNDS = ThermalRange(10.0, 30.0)


def shown(folder, image: str, bounds: ThermalRange | None = BOUNDS, modality: str = "thermal") -> None:
    none = ViewSet([], list)
    scene = SceneData("a", none, none, none, torch.zeros(0, 3), thermal_range=bounds)
    module = SimpleNamespace(scene=scene, modality=modality, output_dir=folder)
    frame = Frame("near_00004.png", 4, Camera(torch.eye(4), torch.eye(3), 3, 2))
    outputs = {
        "view": View(frame),
        "prediction": torch.full((2, 3, 1), 0.25),
        "companions": {"clean": torch.full((2, 3, 1), 0.5)},
    }
    TemperatureRenders(image=image).on_test_batch_end(None, module, outputs)


@pytest.mark.parametrize(("image", "celsius"), [("thermal", 15.0), ("clean", 20.0)])
def test_a_view_is_written_in_celsius(tmp_path, image, celsius):
    shown(tmp_path, image)
    assert (read_temperature(tmp_path / "submission" / "near_00004.tiff") == celsius).all()


def test_what_is_no_temperature_is_not_written(tmp_path):
    shown(tmp_path, "thermal", bounds=None)
    shown(tmp_path, "thermal", modality="rgb")
    assert not list(tmp_path.iterdir())
