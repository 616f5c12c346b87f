"""Sixteen lanes against NumPy: what each operation gives, at the ends of its range and with NaN."""

import numpy as np
import pytest

from heatsplat.kernels import simd
from heatsplat.kernels.compilation import inline, kernel

NAN, INF = np.nan, np.inf
SPECIAL = np.array([0, -0.0, 1, -1, NAN, INF, -INF, 1e-38, -1e38, 3.7, -3.7, 0.5, 2.5, 1e9, NAN, 7], np.float32)
PLAIN = np.array([1, 2, -3, 0.25, 5, NAN, 2, -INF, 1e38, 3.7, -3.6, 1, 2, -1e9, 4, NAN], np.float32)


@kernel
def arithmetic(x, y, out):
    a, b = simd.load(x, 0), simd.load(y, 0)
    simd.store_vector(out, 0, simd.minimum(a, b))
    simd.store_vector(out, 1, simd.maximum(a, b))
    simd.store_vector(out, 2, simd.select(a < b, a, b))
    simd.store_vector(out, 3, simd.floor(a))
    simd.store_vector(out, 4, simd.ceil(a))
    simd.store_vector(out, 5, simd.absolute(a))
    simd.store_vector(out, 6, 2.0 * a - b / 4.0)
    simd.store_vector(out, 7, -a)
    return simd.bits(a < b), simd.bits((a >= b) | (a == b)), simd.bits(~(a > b) & simd.first_lanes(10))


def test_operations_are_those_of_numpy_with_nan_and_infinity():
    x, y, out = SPECIAL.copy(), PLAIN.copy(), np.zeros((8, 16), np.float32)
    below, at_least, not_above = arithmetic(x, y, out)
    with np.errstate(invalid="ignore", over="ignore"):
        expected = [
            np.where(x < y, x, y), np.where(x > y, x, y), np.where(x < y, x, y), np.floor(x), np.ceil(x), np.abs(x),
            np.float32(2) * x - y / np.float32(4), -x,
        ]  # fmt: skip
        masks = x < y, x >= y, ~(x > y) & (np.arange(16) < 10)
    for found, wanted in zip(out, expected, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=2e-7)
    for found, wanted in zip((below, at_least, not_above), masks, strict=True):
        assert found == sum(1 << k for k in range(16) if wanted[k])


@inline
def _both(x):
    return simd.exp2(x), simd.log2(x)


@kernel
def powers(x, out, logarithms):
    for k in range(0, x.shape[0], 16):
        power, logarithm = _both(simd.load(x, k))
        simd.store(out, k, power)
        simd.store(logarithms, k, logarithm)


def test_exp2_over_its_whole_range():
    x = np.concatenate([np.linspace(-126, 127.99, 65520), [-126, -0.5, 0.5, 0, -8, 8] + [0.0] * 10]).astype(np.float32)
    powers(x, found := np.empty_like(x), np.empty_like(x))
    exact = np.exp2(x.astype(np.float64))
    assert (np.abs(found / exact - 1)).max() < 2e-7
    assert found[x == 0].tolist() == [1.0] * int((x == 0).sum())


def test_log2_of_opacities():
    x = np.geomspace(2.0**-16, 2.0**16, 65536).astype(np.float32)
    powers(x, np.empty_like(x), found := np.empty_like(x))
    assert np.abs(found - np.log2(x.astype(np.float64))).max() < 1e-6


@kernel
def sums(x, out):
    seven = simd.registers(7)
    for k in range(7):
        seven[k] = simd.load_vector(x, k)
    simd.store_first(out, 0, simd.totals(seven), 7)
    return simd.total(simd.load(x, 0))


def test_sums_over_lanes():
    x = np.random.default_rng(0).normal(size=(7, 16)).astype(np.float32)
    out = np.full(16, -1, np.float32)
    single = sums(x, out)
    np.testing.assert_allclose(out[:7], x.sum(1, dtype=np.float64), rtol=1e-5, atol=1e-6)
    assert single == pytest.approx(x[0].sum(dtype=np.float64), rel=1e-5)
    assert (out[7:] == -1).all()  # nothing beyond what was asked for is written


@kernel
def transpose(x, out, rows):
    a, b, c = simd.load_columns(x, 0, 3, rows)
    simd.store_columns(out, 0, (c, a, b), rows)


@pytest.mark.parametrize("rows", [1, 7, 16, 40])
def test_columns_are_read_and_written_up_to_the_last_row(rows):
    x = np.arange(48, dtype=np.float32).reshape(16, 3)
    out = np.full((16, 3), -1, np.float32)
    transpose(x, out, rows)
    here = min(rows, 16)
    np.testing.assert_array_equal(out[:here], x[:here][:, [2, 0, 1]])
    assert (out[here:] == -1).all()


@kernel
def of_doubles(x, y, out):
    a, b = simd.load(x, 0), simd.load(y, 0)
    simd.store_vector(out, 0, simd.minimum(a, b))
    simd.store_vector(out, 1, simd.maximum(a, b))
    simd.store_vector(out, 2, simd.select(a < b, a, simd.filled(x, 0.1)))
    simd.store_vector(out, 3, 2.0 * a - b / 3.0)
    simd.store_vector(out, 4, -a)
    simd.store_vector(out, 5, simd.exp(-b))
    return simd.total(a)


def test_doubles_keep_all_their_digits():
    x, y = np.random.default_rng(0).normal(size=(2, 16))
    y *= 300
    out = np.zeros((6, 16))
    total = of_doubles(x, y, out)
    expected = [np.minimum(x, y), np.maximum(x, y), np.where(x < y, x, 0.1), 2 * x - y / 3, -x, np.exp(-y)]
    for found, wanted in zip(out, expected, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=5e-16)
    assert total == pytest.approx(x.sum(), rel=1e-14)
    columns = np.arange(48, dtype=np.float64).reshape(16, 3) / 3
    transpose(columns, moved := np.full((16, 3), -1.0), 7)
    np.testing.assert_array_equal(moved[:7], columns[:7][:, [2, 0, 1]])
    assert (moved[7:] == -1).all()


@kernel
def exponentials(x, out):
    simd.store(out, 0, simd.exp(simd.load(x, 0)))


def test_exp_of_floats_ends_at_the_smallest_number():
    x = np.array([0, 1, -1, 10, -10, 80, -80, -87, -88, -1e3, -1e30, 0.5, -0.5, 2, -2, -50], np.float32)
    exponentials(x, found := np.empty_like(x))
    np.testing.assert_allclose(found, np.maximum(np.exp(x.astype(np.float64)), 2.0**-126), rtol=8e-6)


@kernel
def words(x):
    return simd.bytes_of(simd.load(x, 0))


def test_low_bytes_become_two_words():
    x = np.arange(250, 266, dtype=np.int32)
    low, high = words(x)
    assert np.array([low, high]).astype("<i8").tobytes() == (x & 255).astype(np.uint8).tobytes()


@kernel
def reversed_scalars(x, out):
    for k in range(x.size):
        simd.store_scalar(out, x.size - 1 - k, simd.load_scalar(x, k))


def test_scalars_are_elements_of_the_flat_order():
    x, out = np.arange(24, dtype=np.float32).reshape(2, 3, 4), np.zeros((4, 6), np.float32)
    reversed_scalars(x, out)
    np.testing.assert_array_equal(out.ravel(), x.ravel()[::-1])
