"""Evidence of a rolling read-out: where there is one, and nowhere else."""

from swinging import clean, points_on_a_wall, recorded

from heatsplat.effects.inspection import Inspection
from heatsplat.effects.physical.rolling_readout import EFFECT


def test_a_read_out_is_found_and_a_lag_is_none():
    found = [EFFECT.evidence(Inspection(points_on_a_wall(images))) for images in (recorded(0.012, 0.02), clean())]
    assert found[0].statistic > 2 * EFFECT.threshold > EFFECT.threshold > found[1].statistic
    assert EFFECT.evidence(Inspection(points_on_a_wall(recorded(0.012, 0.0)))).statistic < EFFECT.threshold
    assert "ms after the first" in found[0].reason
