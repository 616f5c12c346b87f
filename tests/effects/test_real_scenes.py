"""Verdicts on recordings of real cameras, of which something is known."""

from pathlib import Path

import pytest
import torch

from heatsplat.contracts import Camera, Frame, SceneData, ThermalRange, View, ViewSet
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.formats.images import read_image
from heatsplat.effects.catalogue import decide
from heatsplat.effects.observations import observe
from heatsplat.physics.noise import noise_of

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
HEATH, REPEATS = DATA / "m3t_heath" / "colmap_scene", DATA / "flir" / "static_repeats"
NOISE_K = (0.03, 0.15)  # of uncooled cameras; their makers promise 0.05 to 0.07 K at the best of settings


def on(verdicts):
    return {name for name, verdict in verdicts.items() if verdict.on}


@pytest.mark.skipif(not HEATH.is_dir(), reason=f"needs the flight in {HEATH}")
def test_the_drift_of_a_flight_is_the_sensors_and_not_the_heaths():
    """45 s over a heath; the level of the images goes up and down by 3 K as a sawtooth, with the sensor's shutter."""
    scene = Colmap(root=str(HEATH), raw="raw16").scene
    verdicts = decide(scene)
    assert verdicts["frame_offset"].on, verdicts["frame_offset"]
    for name in ("relaxation", "harmonic_source", "conduction"):  # nothing warms or cools by itself in that time
        assert not verdicts[name].on, verdicts[name]
    for name in ("solar", "radiation", "convection"):
        assert not verdicts[name].on and "lacks weather" in verdicts[name].reason
    # Strips flown straight down see no point from the side or from afar, and there are no visible images.
    for name in ("directional_emissivity", "view_dependence", "reflection", "attenuation", "thermal_opacity"):
        assert not verdicts[name].on, verdicts[name]
    # What else the camera does. Nobody measured it: this is what is found, and found with a wide margin but for the blur.
    assert on(verdicts) == {"frame_offset", "fixed_pattern", "tone", "point_spread"}
    few = torch.stack([scene.train[i].thermal[..., 0] for i in range(0, len(scene.train), 9)])
    assert NOISE_K[0] < noise_of(few.double()) * scene.thermal_range.span_k < NOISE_K[1]


@pytest.fixture(scope="module")
def repeats():
    files = sorted(REPEATS.glob("*.png"))
    images = [torch.from_numpy(read_image(file).astype("float32") / 255.0) for file in files]
    images = [image if image.ndim == 2 else image.mean(2) for image in images]
    height, width = images[0].shape
    K = torch.tensor([[600.0, 0, width / 2], [0, 600.0, height / 2], [0, 0, 1]])
    frames = [Frame(file.name, i, Camera(torch.eye(4), K, width, height), 1.0 * i) for i, file in enumerate(files)]
    views = ViewSet(frames, lambda i: View(frames[i], images[i][..., None]))
    empty = views.subset([])
    return SceneData("repeats", views, empty, empty, torch.zeros(0, 3), thermal_range=ThermalRange(18.902, 33.162))


def rms_of_steps(scene):
    """Noise of a pixel by differences of successive images, each less its mean: another way than that of ``noise.py``."""
    steps = torch.stack([view.thermal[..., 0] for view in scene.train]).double().diff(dim=0)
    steps = steps - steps.mean((1, 2), keepdim=True)
    return float((steps.square().mean((1, 2)) / 2).sqrt().median())


@pytest.mark.skipif(not REPEATS.is_dir(), reason=f"needs the still frames in {REPEATS}")
def test_the_noise_of_a_still_camera_is_what_changes_from_image_to_image(repeats):
    noise, span_k = observe(repeats).noise, repeats.thermal_range.span_k
    assert noise == pytest.approx(rms_of_steps(repeats), rel=0.15)
    assert NOISE_K[0] < noise * span_k < NOISE_K[1]


@pytest.mark.skipif(not REPEATS.is_dir(), reason=f"needs the still frames in {REPEATS}")
def test_a_still_scene_by_a_still_camera_calls_for_nothing_but_the_sensor(repeats):
    verdicts = decide(repeats)
    levels = torch.stack([view.thermal.mean() for view in repeats.train])
    assert levels.max() - levels.min() > 10 * rms_of_steps(repeats)  # nothing changed in the scene: the sensor drifts
    drift = on(verdicts) & {"frame_offset", "agc"}  # a gain for each image comes with a shift, and stands for both
    assert len(drift) == 1, on(verdicts)
    # Each pixel looks at one point all the time: what is its own flaw and what the point's heat is in every image alike,
    # and only their sum is seen. A pattern, or a falloff, would show by a point that moves through the image.
    for name in ("fixed_pattern", "vignetting"):
        assert verdicts[name].statistic is None and "cannot tell its pattern from the scene" in verdicts[name].reason
    # 160 x 120 detectors fill these 480 x 640 pixels, so that no edge is sharp.
    assert on(verdicts) - drift == {"point_spread"}
