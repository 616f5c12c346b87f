"""Verdicts on recordings of real cameras, of which something is known."""

from pathlib import Path

import pytest
import torch

from datamodules.colmap import Colmap
from datamodules.formats.images import read_image
from heatsplat.contracts import Camera, Frame, SceneData, ThermalRange, View, ViewSet
from heatsplat.effects.catalogue import decide

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
HEATH, REPEATS = DATA / "m3t_heath" / "colmap_scene", DATA / "flir" / "static_repeats"


@pytest.mark.skipif(not HEATH.is_dir(), reason=f"needs the flight in {HEATH}")
def test_the_drift_of_a_flight_is_the_sensors_and_not_the_heaths():
    verdicts = decide(Colmap(root=str(HEATH), raw="raw16").scene)
    assert verdicts["frame_offset"].on or verdicts["agc"].on, verdicts["frame_offset"]
    for name in ("relaxation", "harmonic_source", "conduction", "view_dependence", "attenuation", "thermal_opacity"):
        assert not verdicts[name].on, verdicts[name]


@pytest.mark.skipif(not REPEATS.is_dir(), reason=f"needs the still frames in {REPEATS}")
def test_a_still_scene_by_a_still_camera_calls_for_nothing_but_the_sensor():
    files = sorted(REPEATS.glob("*.png"))
    images = [torch.from_numpy(read_image(file).astype("float32") / 255.0) for file in files]
    images = [image if image.ndim == 2 else image.mean(2) for image in images]
    height, width = images[0].shape
    K = torch.tensor([[600.0, 0, width / 2], [0, 600.0, height / 2], [0, 0, 1]])
    frames = [Frame(file.name, i, Camera(torch.eye(4), K, width, height), 1.0 * i) for i, file in enumerate(files)]
    views = ViewSet(frames, lambda i: View(frames[i], images[i][..., None]))
    empty = views.subset([])
    scene = SceneData("repeats", views, empty, empty, torch.zeros(0, 3), thermal_range=ThermalRange(18.902, 33.162))
    on = {name for name, verdict in decide(scene).items() if verdict.on}
    assert on <= {"frame_offset", "agc", "fixed_pattern", "point_spread"}
