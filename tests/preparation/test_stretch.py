"""8-bit copies in which features are looked for."""

import numpy as np
import pytest

from heatsplat.contracts import SceneError
from heatsplat.preparation.stretch import Stretch


def frames() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    base = 20 + 5 * np.kron(rng.random((8, 10)), np.ones((8, 8)))
    return [(np.roll(base, f, 1) + 0.02 * rng.standard_normal(base.shape)).astype(np.float32) for f in range(6)]


def test_drift_of_the_level_leaves_the_copy_as_it_is():
    plain = frames()
    drifted = [frame + 3.0 * i for i, frame in enumerate(plain)]
    one, other = (
        Stretch([lambda f=f: f for f in plain])(plain[3]),
        Stretch([lambda f=f: f for f in drifted])(drifted[3]),
    )
    assert one.dtype == np.uint8 and np.ptp(one) > 150
    assert np.abs(one.astype(int) - other).max() <= 8  # rounding of float32, as equalisation enlarges it


def test_dead_pixels_are_filled_and_unknown_ones_do_no_harm():
    stuck = frames()
    for frame in stuck:
        frame[10, 13] = 90.0
    stretch = Stretch([lambda f=f: f for f in stuck])
    assert stretch.dead[10, 13] and stretch.dead.sum() == 1
    around = stretch(stuck[0])[8:13, 11:16].astype(int)
    assert abs(around[2, 2] - np.median(around)) < 40
    stuck[0][:5] = np.nan
    assert stretch(stuck[0]).shape == stuck[0].shape


def test_frames_of_one_temperature_are_refused():
    with pytest.raises(SceneError, match="one temperature"):
        Stretch([lambda: np.full((20, 20), 21.0, np.float32)] * 5)
