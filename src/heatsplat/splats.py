"""Splats: the per-Gaussian tensors of a scene and the activations that turn them into geometry."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from heatsplat.same_bits import sigmoid

GEOMETRY = ("means", "log_scales", "quats", "opacity_logits")
# What a row may be to the thermal model: a Gaussian; an anchor, from which the model makes several for every view; or there
# are no rows, because the model is a field that has no Gaussians at all.
GAUSSIANS, ANCHORS, NOTHING = "gaussians", "anchors", "nothing"


class Splats(nn.Module):
    """N Gaussians as named raw tensors, each with first dimension N.

    Every tensor that belongs to a Gaussian lives here, geometry and heat alike, so that density control can add and
    remove rows in one place. Geometry: ``means`` [N, 3] in world units, ``log_scales`` [N, 3], ``quats`` [N, 4] wxyz
    (need not have unit length), ``opacity_logits`` [N, M], one column per modality. A thermal model adds its own names.

    A tensor that few Gaussians need may become sparse (``density.ops.Cloud.drop``). It then has a row for each Gaussian
    that kept one, in the order of the Gaussians, and ``places`` says which. A row that was dropped counts as zeros, and a
    new Gaussian whose row is zeros gets none. Until something is dropped, there is no such thing.

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
        self._places = nn.Module()  # a buffer [N] for each sparse tensor

    def __len__(self) -> int:
        return self.raw["means"].shape[0]

    def __getitem__(self, name: str) -> Tensor:
        """The raw tensor of that name, [N, ...]; a sparse one has fewer rows. Raises KeyError, with the names that there are."""
        try:
            return self.raw[name]
        except (AttributeError, KeyError) as error:  # torch raises the former
            raise KeyError(
                f"splats have no tensor '{name}', only {', '.join(self.names)}: declare it in per_gaussian"
            ) from error

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
        return sigmoid(self.raw["opacity_logits"]).T

    def remove(self, name: str) -> None:
        """Takes a tensor away."""
        self.raw.pop(name)

    def places(self, name: str) -> Tensor | None:
        """Row of a sparse tensor that belongs to each Gaussian, [N] int64, -1 for none; None where each has its own."""
        return self._places._buffers.get(name)

    def place(self, name: str, kept: Tensor) -> None:
        """Says which Gaussians have a row of a tensor: ``kept`` [N] bool. Its rows must follow."""
        places = torch.where(kept, kept.cumsum(0) - 1, -1)
        self._places.register_buffer(name, places)

    def dense(self, name: str, rows: Tensor, ids: Tensor) -> Tensor:
        """One row for each of the Gaussians ``ids`` out of ``rows``, which are those of a tensor; zeros where it has none."""
        places = self.places(name)
        if places is None:
            return rows[ids]
        found = places[ids]
        result = rows.new_zeros(len(ids), *rows.shape[1:])
        result[found >= 0] = rows[found[found >= 0]]
        return result

    def resize(self, count: int, rows: Mapping[str, tuple[int, ...]] | None = None) -> None:
        """Gives every tensor ``count`` rows of zeros; for loading a checkpoint of another size, whose values follow.

        Args:
            count: of Gaussians.
            rows: shape of a row by name of the tensor, where it is another one, too.
        """
        self._places = nn.Module()
        for name in self.names:
            self._resize(name, count, (rows or {}).get(name))

    def _resize(self, name: str, count: int, row: tuple[int, ...] | None = None) -> None:
        old = self.raw[name]
        row = tuple(old.shape[1:]) if row is None else row
        self.raw[name] = nn.Parameter(torch.zeros(count, *row, dtype=old.dtype, device=old.device))

    def _load_from_state_dict(self, state_dict: Mapping[str, Tensor], prefix: str, *rest) -> None:
        """Makes tensors sparse that are so in the checkpoint; what torch does follows."""
        start = f"{prefix}_places."
        for key in [key for key in state_dict if key.startswith(start)]:
            name = key.removeprefix(start)
            self._places.register_buffer(name, state_dict[key].to(self.means.device, copy=True))
            self._resize(name, state_dict[f"{prefix}raw.{name}"].shape[0])
        super()._load_from_state_dict(state_dict, prefix, *rest)
