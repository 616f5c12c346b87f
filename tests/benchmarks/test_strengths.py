"""How strong the effects of drawn scenes are."""

import pytest
import torch

from benchmarks.strengths import beside_levels, strengths
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene.drawn import drawn
from heatsplat.effects.observations import observe


@pytest.fixture(scope="module")
def tracks():
    return observe(Synthetic(scene="static", size="tiny", frames=8).scene).tracks


def test_a_level_of_each_point_counts_for_nothing(tracks):
    frames = tracks.weights.shape[1]
    assert beside_levels(torch.ones(frames, 52, 64, dtype=torch.float64), tracks) == pytest.approx(0.0, abs=1e-9)
    noise = torch.randn(frames, 1, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    offsets = noise.expand(-1, 52, 64)
    assert beside_levels(offsets, tracks) == pytest.approx(float(noise.std()), rel=0.2)
    assert beside_levels(3.0 * offsets, None) == pytest.approx(3.0 * float(noise.square().mean().sqrt()))


def test_each_effect_of_a_drawn_scene_has_a_strength():
    number = next(n for n in range(100) if drawn(n).preset.effects == {"vignetting"})
    quiet, loud = (
        strengths(Synthetic(scene=f"drawn_{number}", size="tiny", frames=6, noise_k=noise_k, bits=16))
        for noise_k in (0.1, 0.2)
    )
    assert quiet.keys() == {"vignetting"}
    assert quiet["vignetting"] == pytest.approx(2.0 * loud["vignetting"], rel=0.01) and quiet["vignetting"] > 0.1
