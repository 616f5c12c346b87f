"""What the processor can do at most: the rates of multiply-adds and of memory, against which kernels are judged."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from heatsplat.kernels.compilation import inline, kernel
from heatsplat.kernels.scheduling import parallel_for, use_threads
from heatsplat.kernels.simd import LANES, load, store

SHARE = 2**14  # numbers per parallel task
# Independent sums that hide the latency of a multiply-add. Eight fit the registers of AVX-512; on AVX2 they spill, four do not.
_CHAINS = 8, 4


def vector_rate(threads: int, seconds: float = 1.0) -> float:
    """Multiply-adds on sixteen floats per second, measured over ``threads`` threads for some seconds."""
    use_threads(threads)
    rounds = 200_000  # half a millisecond, which a busy machine grants to all threads at once now and then
    values = np.full((threads, (2 * max(_CHAINS) + 1) * LANES), 0.5, np.float32)
    rates = []
    for chains, multiply_add in zip(_CHAINS, (_multiply_add_eight, _multiply_add_four), strict=True):
        multiply_add(values, 1)
        taken = _quickest(lambda run=multiply_add: run(values, rounds), seconds / len(_CHAINS))
        rates.append(threads * rounds * chains / taken)
    return max(rates)


def memory_rate(threads: int, seconds: float = 1.0) -> float:
    """Bytes per second to and from memory, measured by doubling numbers in place for some seconds."""
    use_threads(threads)
    numbers = np.zeros(32 * 2**20, np.float32)  # 128 MB, more than any cache it should not measure
    _double(numbers)
    return 2 * numbers.nbytes / _quickest(lambda: _double(numbers), seconds)


def _quickest(work: Callable[[], None], seconds: float) -> float:
    """The least time that ``work`` took, of as many times as fit into ``seconds``."""
    best, end = np.inf, time.perf_counter() + seconds
    while time.perf_counter() < end:
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
    return best


@inline
def _eight_chains(row, values, rounds):
    """Eight chains of multiply-adds on a row of numbers."""
    own = values[row]
    factor = load(own, 16 * LANES)
    a, b, c, d = load(own, 0), load(own, LANES), load(own, 2 * LANES), load(own, 3 * LANES)
    e, f, g, h = load(own, 4 * LANES), load(own, 5 * LANES), load(own, 6 * LANES), load(own, 7 * LANES)
    for _ in range(rounds):
        a, b, c, d = a * factor + factor, b * factor + factor, c * factor + factor, d * factor + factor
        e, f, g, h = e * factor + factor, f * factor + factor, g * factor + factor, h * factor + factor
    store(own, 8 * LANES, a + b + c + d + e + f + g + h)


@inline
def _four_chains(row, values, rounds):
    """Four of them."""
    own = values[row]
    factor = load(own, 16 * LANES)
    a, b, c, d = load(own, 0), load(own, LANES), load(own, 2 * LANES), load(own, 3 * LANES)
    for _ in range(rounds):
        a, b, c, d = a * factor + factor, b * factor + factor, c * factor + factor, d * factor + factor
    store(own, 8 * LANES, a + b + c + d)


@kernel
def _multiply_add_eight(values, rounds):
    parallel_for(_eight_chains, values.shape[0], (values, rounds))


@kernel
def _multiply_add_four(values, rounds):
    parallel_for(_four_chains, values.shape[0], (values, rounds))


@inline
def _double_block(block, numbers):
    """Doubles SHARE numbers."""
    for k in range(block * SHARE, (block + 1) * SHARE, LANES):
        store(numbers, k, load(numbers, k) * np.float32(2.0))


@kernel
def _double(numbers):
    parallel_for(_double_block, numbers.shape[0] // SHARE, (numbers,))
