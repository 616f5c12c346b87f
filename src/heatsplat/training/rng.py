"""The only source of randomness: generators that are a pure function of (seed, step, purpose)."""

from __future__ import annotations

import hashlib

import torch


def generator_for(seed: int, step: int, purpose: str) -> torch.Generator:
    """A generator seeded by what it is for, so that a resumed run draws the numbers of an uninterrupted one.

    Args:
        seed: the run's seed.
        step: training step at which it is used.
        purpose: a word that separates users of randomness at the same step, such as "split".
    """
    digest = hashlib.blake2b(f"{seed}/{step}/{purpose}".encode(), digest_size=8).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest, "little") & 0x7FFF_FFFF_FFFF_FFFF)
