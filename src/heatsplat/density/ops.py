"""The only code that adds or removes Gaussians, or touches their optimiser moments."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from heatsplat.contracts import SceneError
from heatsplat.geometry.rotations import quats_to_matrices
from heatsplat.same_bits import sigmoid
from heatsplat.splats import Splats

# Opacities of which a logit is finite in float32: those of 1, and those that no digits are left of, have none.
NO_LIMIT = (1e-37, 1 - 2.0**-24)
THINNER = 0.99  # largest shortest semi-axis of a child, of that along which its parent was split


@dataclass(frozen=True)
class LongAxisSplit:
    """Two Gaussians in the place of one, side by side along its longest semi-axis; heat and all else is inherited.

    The defaults keep centre, covariance and mass: offset² + along² = 1 and 2 fade along = 1 but for what overlaps. Of all
    splits at this offset they change the image least: by 15 % of an isolated Gaussian of opacity 0.5, where a clone
    changes it by 68 % and two Gaussians drawn from it by 85 %. The split of Improved-GS (2025, rho = 0.45) is offset
    1.35, along 0.55, across 0.893, fade 0.6; it leaves a gap at the centre and changes the image by 77 %.

    The shortest semi-axis stays the shortest, at the price of children of nearly round Gaussians that are a little flatter:
    it is the normal of the surface for models that need one.

    Args:
        offset: of the centres from that of the parent, either way, in units of its longest semi-axis.
        along: factor on the longest semi-axis.
        across: factor on the other two.
        fade: factor on opacities.

    Raises:
        ValueError: offset is negative, along or across is not positive, fade is not in (0, 1], or one is not finite.
    """

    offset: float = 0.7
    along: float = 0.72
    across: float = 1.0
    fade: float = 0.74

    def __post_init__(self) -> None:
        if not (
            0 <= self.offset < math.inf
            and 0 < self.along < math.inf
            and 0 < self.across < math.inf
            and 0 < self.fade <= 1
        ):
            raise ValueError(
                "density.split: offset must not be negative, along and across must be positive, all finite, and fade must lie in "
                f"(0, 1], got {self.offset}, {self.along}, {self.across} and {self.fade}"
            )


@dataclass
class Cloud:
    """Gaussians with everything that has a row per Gaussian: parameters, Adam moments, density statistics.

    Args:
        splats: the parameters.
        optimizer: the optimiser, whose groups carry "name"; groups named like a tensor of ``splats`` hold just that
            tensor. None when nothing is being trained.
        state: density statistics, each [N, ...].
        kept_opacity: function of centres and semi-axes [N, 3] to the share of its opacity [N] with which a Gaussian is
            rendered, where a filter makes Gaussians fainter; or to None, as without it: all of it.
    """

    splats: Splats
    optimizer: torch.optim.Optimizer | None = None
    state: dict[str, Tensor] = field(default_factory=dict)
    kept_opacity: Callable[[Tensor, Tensor], Tensor | None] | None = None

    def __len__(self) -> int:
        return len(self.splats)

    def is_held(self, name: str) -> bool:
        """Whether a tensor stays as it is in this step, as a stage froze it: it has no gradient then."""
        return self.splats[name].grad is None

    @torch.no_grad()
    def lower_opacities(self, ceiling: float) -> None:
        """Lowers opacities until none is rendered with more than ``ceiling``, and forgets their moments."""
        logits = self.splats["opacity_logits"]
        kept = self.kept_opacity(self.splats.means, self.splats.scales) if self.kept_opacity else None
        if kept is None:
            lowered = logits.clamp(max=torch.logit(torch.tensor(ceiling)).item())
        else:  # lowered as far as the others, those that a filter makes fainter would never be seen again
            lowered = logits.minimum(torch.logit((ceiling / kept).clamp(max=1))[:, None])
        self.overwrite("opacity_logits", lowered)

    @torch.no_grad()
    def drop(self, name: str, gone: Tensor, instead: Mapping[str, Tensor]) -> None:
        """Removes the rows of one tensor that belong to some Gaussians, with their moments.

        Args:
            name: of the tensor, which is sparse from now on.
            gone: [N] bool; Gaussians that have no row are passed over.
            instead: name -> values [N, ...] that those which lose their row take. Moments there stay: they are of the size
                of the gradients to come, and without them the next steps would be the largest.
        """
        places = self.splats.places(name)
        before = torch.arange(len(self), device=gone.device) if places is None else places
        kept, lost = ~gone & (before >= 0), gone & (before >= 0)
        for other, values in instead.items():
            self.splats[other][lost] = values[lost].to(self.splats[other])
        rows = before[kept]
        self._replace(name, lambda tensor: tensor[rows], lambda moment: moment[rows])
        self.splats.place(name, kept)

    def keep(self, mask: Tensor) -> None:
        """Removes the Gaussians where ``mask`` [N] bool is False, with their moments and statistics.

        Raises:
            ValueError: the mask is something else, such as ids.
        """
        if mask.dtype != torch.bool or tuple(mask.shape) != (len(self),):
            raise ValueError(
                f"cloud.keep takes a mask [{len(self)}] bool of the Gaussians that stay, got {mask.dtype} {list(mask.shape)}"
            )
        ids = mask.nonzero().squeeze(1)
        for name in self.splats.names:
            places, rows = self.splats.places(name), ids
            if places is not None:
                rows = places[ids]
                self.splats.place(name, rows >= 0)
                rows = rows[rows >= 0]
            self._replace(name, lambda tensor, rows=rows: tensor[rows], lambda moment, rows=rows: moment[rows])
        for name, tensor in self.state.items():
            self.state[name] = tensor[ids]

    def prune(self, mask: Tensor, refusal: str) -> int:
        """How many Gaussians were removed: those where ``mask`` [N] bool is False (``keep``).

        Raises:
            SceneError: none would be left; with the message ``refusal``.
        """
        removed = int((~mask).sum())
        if removed == len(self):
            raise SceneError(refusal)
        if removed:
            self.keep(mask)
        return removed

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Adds Gaussians: name -> [n, ...] for every tensor of the splats. Their moments and statistics start at zero.

        A sparse tensor takes no row that is all zeros.

        Raises:
            ValueError: a tensor of the splats is missing in ``rows``, has other rows than the splats, or is not finite.
        """
        self._check_rows(rows)
        count = rows["means"].shape[0]
        for name in self.splats.names:
            new, places = rows[name], self.splats.places(name)
            if places is not None:
                wanted = new.flatten(1).any(1)
                self.splats.place(name, torch.cat([places >= 0, wanted]))
                new = new[wanted]
            self._replace(
                name,
                lambda tensor, new=new: torch.cat([tensor, new.to(tensor)]),
                lambda moment, new=new: torch.cat([moment, moment.new_zeros(len(new), *moment.shape[1:])]),
            )
        for name, tensor in self.state.items():
            self.state[name] = torch.cat([tensor, tensor.new_zeros(count, *tensor.shape[1:])])

    def _check_rows(self, rows: Mapping[str, Tensor]) -> None:
        if missing := [name for name in self.splats.names if name not in rows]:
            raise ValueError(
                f"density control adds Gaussians without {', '.join(missing)}: begin with cloud.rows(ids), which has all tensors"
            )
        for name in self.splats.names:
            shape = (len(rows["means"]), *self.splats[name].shape[1:])
            if tuple(rows[name].shape) != shape:
                raise ValueError(f"density control adds '{name}' {list(rows[name].shape)}, {list(shape)} is needed")
            if not bool(rows[name].isfinite().all()):
                raise ValueError(f"density control adds Gaussians whose '{name}' is NaN or infinite")

    @torch.no_grad()
    def split(self, ids: Tensor, how: LongAxisSplit) -> None:
        """Splits Gaussians along their longest semi-axis: one child takes the row of its parent, the other is appended.

        The moments and statistics of both start at zero.
        """
        if len(ids) == 0:
            return
        rows = self.rows(ids)
        scales = rows["log_scales"]
        longest, shortest = scales.argmax(dim=1, keepdim=True), scales.argmin(dim=1, keepdim=True)
        axes = quats_to_matrices(rows["quats"]).gather(2, longest[:, None].expand(-1, 3, 1)).squeeze(2)
        aside = how.offset * scales.gather(1, longest).exp() * axes
        scales += torch.full_like(scales, math.log(how.across)).scatter_(1, longest, math.log(how.along))
        own, limit = scales.gather(1, shortest), scales.gather(1, longest) + math.log(THINNER)
        scales.scatter_(1, shortest, torch.where(shortest == longest, own, own.minimum(limit)))
        rows["opacity_logits"] = torch.logit((how.fade * sigmoid(rows["opacity_logits"])).clamp(*NO_LIMIT))
        for name in ("log_scales", "opacity_logits"):
            self.splats[name][ids] = rows[name]
        self.splats["means"][ids] = rows["means"] + aside
        self._forget(ids)
        self.append(rows | {"means": rows["means"] - aside})

    def _forget(self, ids: Tensor) -> None:
        """Moments and statistics of some Gaussians become zero."""
        for name, parameter in self.splats.raw.items():
            places = self.splats.places(name)
            rows = ids if places is None else places[ids][places[ids] >= 0]
            for moment in self._moments(parameter).values():
                moment[rows] = 0
            if hasattr(parameter, "unwritten"):
                parameter.unwritten.change_rows(lambda numbers, rows=rows: numbers.index_fill(0, rows, 0))
        for statistic in self.state.values():
            statistic[ids] = 0

    def _moments(self, parameter: Tensor) -> dict[str, Tensor]:
        """What the optimiser keeps of a parameter, element by element, and a gradient that waits for those of more views."""
        moments = {} if self.optimizer is None else self.optimizer.state.get(parameter, {})
        waiting = {} if parameter.grad is None else {"gradient": parameter.grad}
        return {key: value for key, value in {**moments, **waiting}.items() if value.shape == parameter.shape}

    def overwrite(self, name: str, values: Tensor) -> None:
        """Gives one tensor new values [N, ...] and forgets its moments; a sparse one takes the rows that it has."""
        places = self.splats.places(name)
        if places is not None:
            values = values[places >= 0]
        self._replace(name, lambda tensor: values.to(tensor), torch.zeros_like)

    def rows(self, ids: Tensor) -> dict[str, Tensor]:
        """Copies of the raw tensors of some Gaussians, to be changed and appended: name -> [n, ...]."""
        splats = self.splats
        return {name: splats.dense(name, splats[name].detach(), ids).clone() for name in splats.names}

    @torch.no_grad()
    def _replace(
        self, name: str, change: Callable[[Tensor], Tensor], change_moment: Callable[[Tensor], Tensor]
    ) -> None:
        """Puts ``change(parameter)`` in the parameter's place, everywhere it is known; its moments and gradient likewise."""
        old = self.splats.raw[name]
        new = nn.Parameter(change(old.detach()).contiguous(), requires_grad=old.requires_grad)
        if old.grad is not None:
            new.grad = change_moment(old.grad).contiguous()
        if hasattr(old, "unwritten"):
            old.unwritten.change_rows(change_moment)
            new.unwritten = old.unwritten
        self.splats.raw[name] = new
        if self.optimizer is None:
            return
        for group in self.optimizer.param_groups:
            if group.get("name") != name:
                continue
            group["params"] = [new]
            moments = self.optimizer.state.pop(old, None)
            if moments is not None:
                self.optimizer.state[new] = {
                    key: change_moment(value).contiguous() if value.shape == old.shape else value
                    for key, value in moments.items()
                }
