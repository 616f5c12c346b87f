"""Sums of gradient slots against one addition after the other in NumPy."""

import numpy as np
import pytest

from heatsplat.kernels.compilation import kernel
from heatsplat.kernels.constants import (
    ALPHA_MIN,
    DEPTH_GRADIENT,
    LOG_OPACITY_GRADIENT,
    OPACITY_GRADIENTS,
    SUMS,
    TWO_LN_2,
)
from heatsplat.kernels.simd import LANES
from heatsplat.kernels.slots import clear_invisible, fetch_slots, sum_slots

COUNT = 37  # the last sixteen are not all there
INVISIBLE = [0, 3, 17, 18, 36]
WITHOUT_SLOTS = [5, 20]  # visible, but nothing of the image shows them
FAINT = [4, 33]  # too transparent to be seen: opacities do not learn
ROOM = LANES * SUMS + 2 * LANES  # sums of sixteen Gaussians and room for a slot


@kernel
def all_summed(
    count, seen, with_depth, ranks, spans, slots, opacities, raw, sums, v_opacities, v_features, maps, absgrad
):  # fmt: skip
    row = 0
    for block in range(seen.shape[0]):
        first, lanes = block * LANES, np.int64(seen[block])
        fetch_slots(first, lanes, spans, slots)
        clear_invisible(first, min(LANES, count - first), lanes, ranks, v_opacities, v_features, absgrad)
        row = sum_slots(
            first, lanes, row, spans, slots, opacities, raw, with_depth, ranks, sums, block * ROOM,
            v_opacities, v_features, maps, absgrad,
        )  # fmt: skip
    return row


@pytest.mark.parametrize(
    ("ranks", "raw"),
    [(False, False), (True, False), (True, True)],
    ids=["features of all", "features of the visible", "logits"],
)
@pytest.mark.parametrize(
    ("modalities", "colours", "depth", "mapped", "absolute"),
    [
        (1, 1, False, 0, False),
        (1, 1, True, 3, True),
        (2, 4, False, 1, True),
        (2, 9, True, 0, True),
    ],  # 7 columns to 19: past one vector
)
def test_sums_are_those_of_one_addition_after_the_other(modalities, colours, depth, mapped, absolute, ranks, raw):
    generator = np.random.default_rng(colours)
    visible = np.setdiff1d(np.arange(COUNT), INVISIBLE)
    lengths = generator.integers(1, 9, COUNT)
    lengths[INVISIBLE + WITHOUT_SLOTS] = 0
    spans, end = np.zeros((COUNT, 2), np.int32), 0
    for gaussian in generator.permutation(COUNT):  # slots lie in the order of depth
        spans[gaussian] = end, end + lengths[gaussian]
        end += lengths[gaussian]
    columns = OPACITY_GRADIENTS + modalities + colours + depth + mapped + 2 * absolute
    slots = np.full((end + LANES, columns), np.nan, np.float32)  # nothing behind the last slot counts
    slots[:end] = generator.standard_normal((end, columns)) * 10.0 ** generator.integers(-3, 4, (end, 1))
    opacities = generator.uniform(0.1, 0.9, (modalities, COUNT)).astype(np.float32)
    opacities[-1, FAINT] = ALPHA_MIN / 2
    bits = [sum(1 << k for k in range(LANES) if first + k in visible) for first in range(0, COUNT, LANES)]
    sums = np.full(len(bits) * ROOM, np.nan, np.float32)
    v_opacities = np.full((modalities, COUNT), np.nan, np.float32)
    v_features = np.full((len(visible) if ranks else COUNT, colours), np.nan, np.float32)
    maps = np.full((len(visible), mapped), np.nan, np.float32)
    absgrad = np.full((COUNT, 2) if absolute else (0, 0), np.nan, np.float32)

    seen = np.array(bits, np.uint16)
    rows = all_summed(
        COUNT, seen, depth, ranks, spans, slots, opacities, raw, sums, v_opacities, v_features, maps, absgrad
    )  # fmt: skip

    wanted = np.zeros((COUNT, columns), np.float32)
    for gaussian in visible:
        for slot in range(*spans[gaussian]):
            wanted[gaussian] += slots[slot]
    moments, logs, features, depths, mapped_sums, absolutes = np.split(
        wanted, np.cumsum([OPACITY_GRADIENTS, modalities, colours, depth, mapped]), axis=1
    )
    assert rows == len(visible)
    places = visible // LANES * ROOM + visible % LANES * SUMS
    np.testing.assert_array_equal(sums[places[:, None] + np.arange(OPACITY_GRADIENTS)], moments[visible])
    np.testing.assert_array_equal(sums[places + DEPTH_GRADIENT], depths[visible, 0] if depth else 0)
    np.testing.assert_array_equal(sums[places + LOG_OPACITY_GRADIENT], logs[visible].sum(1))
    np.testing.assert_array_equal(v_features, features[visible] if ranks else features)
    np.testing.assert_array_equal(maps, mapped_sums[visible])
    slopes = logs.T * (1 - opacities) if raw else logs.T / opacities
    np.testing.assert_allclose(v_opacities, np.where(opacities >= ALPHA_MIN, slopes, 0), rtol=1e-6)
    np.testing.assert_allclose(absgrad, absolutes * TWO_LN_2 if absolute else absgrad, rtol=1e-6)
    assert not v_opacities[:, INVISIBLE].any() and not v_opacities[-1, FAINT].any()
