"""The course of the air's extinction, from which training starts."""

import math
from dataclasses import replace

import pytest
import torch

from heatsplat.contracts import SceneData, ViewSet
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.effects.catalogue import CATALOGUE
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.physical import attenuation
from heatsplat.thermal.attenuation import Attenuation


@pytest.fixture(scope="module")
def haze():
    return Synthetic(scene="haze", size="tiny", frames=72).scene


def test_training_starts_from_the_extinction_of_each_moment(haze):
    """0.25 / m (1 + 0.9 sin): to within 1 % of the thickest."""
    found = attenuation.evidence(Inspection(haze, CATALOGUE)).settings
    part = Attenuation(depth=found["depth"], moments=found["moments"])
    part.prepare(haze)
    times = haze.train.times_s
    duration_s = 1800.0
    begins_s = duration_s - times[-1]  # times count from the first training image
    expected = [0.25 * (1 + 0.9 * math.sin(2 * math.pi * 2.3 * (t + begins_s) / duration_s)) for t in times]
    started = [part.extinction(t).item() for t in times]
    assert max(abs(a - b) for a, b in zip(expected, started, strict=True)) < 0.01 * 0.475


def test_one_number_is_enough_where_it_does_not_change(haze):
    found = attenuation.settings(torch.tensor([0.4], dtype=torch.float64), Inspection(haze))
    assert found == {"depth": 0.4, "moments": 0}
    assert attenuation.settings(torch.tensor([0.0]), Inspection(haze))["depth"] == attenuation.THINNEST


def at_times(scene: SceneData, time_of) -> SceneData:
    frames = [replace(frame, time_s=time_of(k, frame.time_s)) for k, frame in enumerate(scene.train.frames)]
    return replace(scene, train=ViewSet(frames, lambda k: replace(scene.train[k], frame=frames[k])))


@pytest.mark.parametrize(
    "time_of",
    [lambda k, time_s: None, lambda k, time_s: time_s if k else None, lambda k, time_s: 5.0],
    ids=["no times", "one without", "one moment"],
)
def test_haze_without_a_record_starts_from_one_number(haze, time_of):
    """Images differ by their air, but nothing says when: the mean is what training can start from."""
    found = attenuation.evidence(Inspection(at_times(haze, time_of), CATALOGUE))
    assert found.statistic > attenuation.EFFECT.threshold and found.told
    assert found.settings["moments"] == 0 and 0.4 < found.settings["depth"] < 0.7  # 0.25 / m at 2.2 m
