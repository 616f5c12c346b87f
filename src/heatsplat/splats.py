"""Splats: the per-Gaussian tensors of a scene and the activations that turn them into geometry."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

GEOMETRY = ("means", "log_scales", "quats", "opacity_logits")


class Splats(nn.Module):
    """N Gaussians as named raw tensors, each with first dimension N.

    Every tensor that belongs to a Gaussian lives here, geometry and heat alike, so that density control can add and
    remove rows in one place. Geometry: ``means`` [N, 3] in world units, ``log_scales`` [N, 3], ``quats`` [N, 4] wxyz
    (need not have unit length), ``opacity_logits`` [N, M], one column per modality. A thermal model adds its own names.

    Args:
        tensors: name -> [N, ...] float tensor; must hold the four geometry names.

    Raises:
        ValueError: a geometry name is missing or first dimensions differ.
    """

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        super().__init__()
        missing = [name for name in GEOMETRY if name not in tensors]
        if missing:
            raise ValueError(f"splats need {', '.join(GEOMETRY)}; missing: {', '.join(missing)}")
        counts = {name: tensor.shape[0] for name, tensor in tensors.items()}
        if len(set(counts.values())) > 1:
            raise ValueError(f"splats need one row per Gaussian in every tensor, got {counts}")
        self.raw = nn.ParameterDict({name: nn.Parameter(tensor.detach().clone()) for name, tensor in tensors.items()})

    def __len__(self) -> int:
        return self.raw["means"].shape[0]

    def __getitem__(self, name: str) -> Tensor:
        """The raw tensor of that name, [N, ...]."""
        return self.raw[name]

    def __contains__(self, name: str) -> bool:
        return name in self.raw

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.raw.keys())

    @property
    def means(self) -> Tensor:
        """Centres in world units, [N, 3]."""
        return self.raw["means"]

    @property
    def quats(self) -> Tensor:
        """Rotations wxyz as stored, [N, 4]; renderers normalise them and cull a zero quaternion."""
        return self.raw["quats"]

    @property
    def scales(self) -> Tensor:
        """Semi-axes in world units, [N, 3]."""
        return self.raw["log_scales"].exp()

    @property
    def opacities(self) -> Tensor:
        """Opacity in (0, 1), [M, N]."""
        return self.raw["opacity_logits"].sigmoid().T

    def resize(self, count: int) -> None:
        """Gives every tensor ``count`` rows of zeros; for loading a checkpoint of another size, whose values follow."""
        for name, parameter in self.raw.items():
            self.raw[name] = nn.Parameter(
                torch.zeros(count, *parameter.shape[1:], dtype=parameter.dtype, device=parameter.device)
            )
