"""Responses to the sun's beam, against integrals by quadrature."""

import numpy as np
import pytest
from scipy.integrate import quad

from heatsplat.kernels.sunlight import recent_sunlight

rng = np.random.default_rng(0)
NORMALS = rng.standard_normal((4, 3))
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
RATES = np.array([1e-4, 1e-3, 1e-2, 1e-1])
STEPS = np.array([600.0, 300.0, 900.0])
BEAMS = rng.standard_normal((4, 3))
SHARES = rng.random((4, 2))
SLOTS = np.array([0, 1, 1, 0])
LAST = 0.4  # of the last step has passed


def found(seen: np.ndarray, normals=NORMALS, rates=RATES) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    responses, slopes, vectors = np.empty(4), np.empty(4), np.empty((4, 3))
    recent_sunlight(normals, np.log(rates), STEPS, BEAMS, seen, SLOTS, LAST, responses, slopes, vectors)
    return responses, slopes, vectors


@pytest.mark.parametrize("seen", [np.ones((4, 0)), SHARES])
def test_responses_are_integrals_over_what_surfaces_have_had(seen):
    times = np.concatenate([[0.0], STEPS.cumsum()])
    end = times[2] + LAST * STEPS[2]
    for i, response in enumerate(found(seen)[0]):
        shares = seen[i, SLOTS] if seen.size else np.ones(4)
        light = shares * np.maximum(BEAMS @ NORMALS[i], 0.0)

        def answered(s, rate=RATES[i], light=light):
            return rate * np.exp(-rate * (end - s)) * np.interp(s, times, light)

        ends = [*times[:3], end]
        whole = sum(quad(answered, a, b, epsabs=1e-13)[0] for a, b in zip(ends, ends[1:], strict=False))
        assert response == pytest.approx(whole, rel=1e-9, abs=1e-12)


def test_slopes_and_vectors_are_derivatives():
    seen, step = SHARES, 1e-6
    _, slopes, vectors = found(seen)
    after, before = (found(seen, rates=RATES * np.exp(sign * step))[0] for sign in (1, -1))
    np.testing.assert_allclose(slopes, (after - before) / (2 * step), rtol=1e-6, atol=1e-9)
    for axis in range(3):
        after, before = (found(seen, normals=NORMALS + sign * step * np.eye(3)[axis])[0] for sign in (1, -1))
        np.testing.assert_allclose(vectors[:, axis], (after - before) / (2 * step), rtol=1e-6, atol=1e-9)
