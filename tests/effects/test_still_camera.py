"""A camera that stands still sees pixels over time and nothing else: heat and drift have to be told apart by them."""

import pytest
import torch

from heatsplat.contracts import Camera, Frame, SceneData, ThermalRange, View, ViewSet
from heatsplat.effects.catalogue import decide

FRAMES, HEIGHT, WIDTH = 30, 48, 64


def scene(images):
    K = torch.tensor([[60.0, 0, WIDTH / 2], [0, 60.0, HEIGHT / 2], [0, 0, 1]])
    frames = [Frame(f"{i}.png", i, Camera(torch.eye(4), K, WIDTH, HEIGHT), 10.0 * i) for i in range(FRAMES)]
    views = ViewSet(frames, lambda i: View(frames[i], images[i].float()[..., None]))
    return SceneData(
        "still", views, views.subset([]), views.subset([]), torch.zeros(0, 3), thermal_range=ThermalRange(15.0, 35.0)
    )


def recorded(cools, drifts, seed):
    generator = torch.Generator().manual_seed(seed)
    blocks = torch.rand(2, 6, 8, generator=generator).repeat_interleave(8, 1).repeat_interleave(8, 2)
    times = torch.arange(FRAMES)[:, None, None] * 10.0
    fades = torch.exp(-(0.002 + 0.01 * blocks[1]) * times) if cools else torch.ones_like(times)
    images = 0.2 + 0.5 * blocks[0] * fades
    if drifts:
        images = images + 0.1 * torch.cumsum(torch.randn(FRAMES, 1, 1, generator=generator) * 0.2, 0)
    return images + 0.003 * torch.randn(FRAMES, HEIGHT, WIDTH, generator=generator)


@pytest.mark.parametrize("drifts", [False, True])
@pytest.mark.parametrize("cools", [False, True])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_cooling_and_drift_before_a_still_camera_are_told_apart(cools, drifts, seed):
    verdicts = decide(scene(recorded(cools, drifts, seed)))
    assert verdicts["relaxation"].on == cools, verdicts["relaxation"]
    assert (verdicts["frame_offset"].on or verdicts["agc"].on) == drifts, verdicts["frame_offset"]
    assert not any(verdicts[name].on for name in ("harmonic_source", "view_dependence", "attenuation", "vignetting"))
