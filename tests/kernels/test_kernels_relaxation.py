"""Rows of gradients that no Gaussian in view writes. (Values and slopes: tests/physics/test_fused.py.)"""

import numpy as np
import pytest

from heatsplat.kernels.relaxation import BLOCK, clear_others


@pytest.mark.parametrize("count", [1, BLOCK, 3 * BLOCK + 7])
def test_rows_out_of_view_are_cleared_and_no_others(count):
    ids = np.random.default_rng(0).permutation(count)[: count // 3].astype(np.int64)
    v_gains = np.ones((count, 2, 5), np.float32)
    clear_others(ids, np.ones(count, np.bool_), v_gains)
    expected = np.zeros((count, 2, 5), np.float32)
    expected[ids] = 1
    np.testing.assert_array_equal(v_gains, expected)
