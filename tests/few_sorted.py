"""Quantiles of few values alone, as of large images without their size."""

import pytest
import torch

from heatsplat import contracts


def with_few_sorted(monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    """Quantiles of more values than ``most`` are refused, as torch refuses those of more than 2^24."""
    quantile = torch.quantile

    def limited(values, shares, dim=None, **options):
        if (values.numel() if dim is None else values.shape[dim]) > most:
            raise RuntimeError("quantile() input tensor is too large")
        return quantile(values, shares, dim=dim, **options)

    monkeypatch.setattr(torch, "quantile", limited)
    monkeypatch.setattr(torch.Tensor, "quantile", limited)
    monkeypatch.setattr(contracts, "SORTED", most)
