"""Strategies: numbers over many orders of magnitude, evenly in their logarithm, and at the edges."""

import math

import torch
from hypothesis import strategies as st


def logarithmic(low: float, high: float, *edges: float) -> st.SearchStrategy[float]:
    """Numbers of [low, high] as float32 holds them, uniform in their logarithm, its ends, and ``edges``."""
    between = st.floats(math.log(low), math.log(high)).map(lambda x: min(max(math.exp(x), low), high))
    return st.one_of(between, between, between, st.sampled_from([low, high, *edges])).map(single)


def single(value: float) -> float:
    """The number as float32 holds it, so that types can be compared on one input."""
    return torch.tensor(value, dtype=torch.float32).double().item()


def seeds() -> st.SearchStrategy[int]:
    return st.integers(0, 2**31 - 1)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)
