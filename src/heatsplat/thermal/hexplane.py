"""4DGS: planes of features over place and time say how every Gaussian differs from what it is in the mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from heatsplat.contracts import SceneData
from heatsplat.same_bits import sigmoid
from heatsplat.splats import Splats
from heatsplat.thermal.base import Geometry, PerGaussian, Query, Rate, Seeds, ThermalModel
from heatsplat.thermal.coordinates import FIELD_BOX, Clock, ImageRange
from heatsplat.thermal.layers import Head, draw_uniform
from heatsplat.thermal.wrapper import Wrapper

# Head -> numbers that it gives and the bound of each, which is approached smoothly: a moved mean in half edges of the box,
# natural logarithms of scales, parts of a quaternion as stored, the logit of opacity, image units.
HEADS = {"means": (3, 1.0), "scales": (3, 3.0), "rotations": (4, 1.0), "opacity": (1, 8.0), "radiance": (1, 1.0)}
PAIRS = ((0, 1), (0, 2), (1, 2))  # axes of the planes of space
THINNEST = 1e-3  # half edge of a flat box over its longest
LONGEST = 50  # nodes of a time plane at most
SPATIAL_START = (0.1, 0.5)  # range of the planes of space before training; those of time start at 1


@dataclass(frozen=True)
class Deformed(Geometry):
    """A geometry with the hidden values [N, width] of the field that it came from, which radiance needs, too."""

    hidden: Tensor


class HexPlane(Wrapper):
    """Gaussians with changes Δ_m = head_m(φ(f(x, t))) of their raw tensors and of their radiance (4DGS, CVPR 2024, Eq. 3-8).

    f multiplies bilinear samples of six planes, xy, xz, yz and xt, yt, zt, and puts the products of all scales side by
    side; φ is a linear layer. Last layers of the heads start at zero, so that nothing differs from the static model at
    first. For ``first_steps`` the field is not evaluated at all.

    Where it departs from the published code: radiance has one number instead of 48 harmonics; changes are bounded; a moved
    mean is in half edges of the box and learning rates are not multiplied by the scene's extent, so that no number depends
    on the unit of the world; time lies in [-1, 1], where the code leaves half of every time plane idle.

    **Convention:** place in the box of the central 98 % of the points, 1.2 times as large, is [-1, 1]³ and the training
    record is [-1, 1]; beyond, the border goes on.

    Args:
        emission: what splats emit before Δ; it must not cut values below zero off (``Static``: floor=False).
        heads: those of "means", "scales", "rotations", "opacity" and "radiance" that change; others have no parameter.
        resolution: nodes along each axis of space at the first scale.
        time_resolution: nodes along time; None takes half the number of training frames, 2 to 50.
        scales: factors on ``resolution``, one for each scale.
        channels: of every plane.
        width: of φ and of the heads' one hidden layer.
        leak: slope of the heads' ReLUs below zero. At 0 a hidden layer that no Gaussian drives above zero is dead: it passes
            no gradient, and the heads say the same of all places and times from then on.
        first_steps: steps of the static first stage.
        smooth_space, smooth_time: weights of the mean squared second difference along the first axis of space planes, and
            along time of time planes.
        sparse_time: weight of the mean |1 - P| of time planes.
        lr, lr_planes: learning rates of the networks and of the planes.
        lr_end: factor on both at the end of the run.

    Raises:
        ValueError: a head is unknown, there is none, or a number is out of its range.
    """

    inseparable = "opacities, and sizes if asked for, change in time with the place of each"
    own_beyond_record = "what the planes change stays as at the nearest moment of the record"

    def __init__(
        self,
        emission: ThermalModel,
        heads: Sequence[str] = ("radiance", "opacity"),
        resolution: int = 32,
        time_resolution: int | None = None,
        scales: Sequence[int] = (1, 2),
        channels: int = 16,
        width: int = 64,
        leak: float = 0.01,
        first_steps: int = 0,
        smooth_space: float = 1e-4,
        smooth_time: float = 1e-2,
        sparse_time: float = 1e-4,
        lr: float = 2e-3,
        lr_planes: float = 1e-2,
        lr_end: float = 0.1,
    ) -> None:
        super().__init__({"emission": emission}, needs={"time"})
        unknown = [name for name in heads if name not in HEADS]
        if unknown or not heads:
            raise ValueError(f"heads must name some of {', '.join(HEADS)}, got {list(heads)}")
        nodes = 2 if time_resolution is None else time_resolution
        if min(resolution, nodes) < 2 or min(channels, width, *scales, 1) < 1 or not scales:
            raise ValueError(
                "resolutions must be at least 2, scales, channels and width at least 1, got "
                f"{resolution}, {time_resolution}, {list(scales)}, {channels}, {width}"
            )
        if min(first_steps, smooth_space, smooth_time, sparse_time) < 0:
            raise ValueError(
                "first_steps and the weights smooth_space, smooth_time and sparse_time must not be negative, got "
                f"{first_steps}, {smooth_space}, {smooth_time} and {sparse_time}"
            )
        self.scales, self.time_resolution, self.first_steps = tuple(scales), time_resolution, first_steps
        self.weights = {"smooth_space": smooth_space, "smooth_time": smooth_time, "sparse_time": sparse_time}
        self.lr, self.lr_planes, self.lr_end = lr, lr_planes, lr_end
        sizes = [scale * resolution for scale in scales]
        self.space = nn.ParameterList(torch.zeros(len(PAIRS), channels, size, size) for size in sizes)
        self.time = nn.ParameterList(torch.ones(3, channels, nodes, size) for size in sizes)
        self.trunk = nn.Linear(channels * len(sizes), width)
        self.heads = nn.ModuleDict(
            {
                name: nn.Sequential(
                    nn.LeakyReLU(leak), nn.Linear(width, width), nn.LeakyReLU(leak), Head(width, HEADS[name][0])
                )
                for name in HEADS
                if name in heads
            }
        )
        self.moves = set(self.heads) != {"radiance"}
        with torch.no_grad():
            for head in self.heads.values():
                head[-1].weight.zero_()
                head[-1].bias.zero_()
        self.register_buffer("center", torch.zeros(3))
        self.register_buffer("reach", torch.ones(3))  # half edges of the box, world units
        self.clock, self.range = Clock(), ImageRange()
        self.register_buffer("changes", torch.tensor(first_steps == 0))

    # What the contract asks -----------------------------------------------------------------------------

    def prepare(self, scene: SceneData) -> None:
        super().prepare(scene)
        self.clock.prepare(scene)
        self.range.prepare(scene)
        low, high = scene.box
        half = FIELD_BOX * (high - low) / 2
        self.center.copy_((low + high) / 2)
        self.reach.copy_(half.clamp(min=max(THINNEST * half.max().item(), 1e-12)))
        if self.time_resolution is None:
            nodes = max(2, min(LONGEST, len(scene.train) // 2))
            self.time = nn.ParameterList(torch.ones(3, plane.shape[1], nodes, plane.shape[3]) for plane in self.time)

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        draw_uniform((self.trunk, *(head[1] for head in self.heads.values())), seeds.generator)
        with torch.no_grad():
            for plane in self.space:
                nn.init.uniform_(plane, *SPATIAL_START, generator=seeds.generator)
        return super().per_gaussian(seeds)

    def on_step(self, step: int) -> None:
        super().on_step(step)
        self.changes.fill_(step >= self.first_steps)

    def geometry(self, splats: Splats, query: Query) -> Geometry | None:
        """Changed geometry and opacities; the emission's where none of their heads is there, and in the first stage."""
        if not self.changes or not self.moves:
            return super().geometry(splats, query)
        hidden = self.hidden(splats.means, query.time_s)
        change = {name: self._change(name, hidden) for name in self.heads if name != "radiance"}
        means, quats, log_scales = splats.means, splats.quats, splats["log_scales"]
        logits = splats["opacity_logits"]
        return Deformed(
            means + self.reach * change["means"] if "means" in change else means,
            quats + change["rotations"] if "rotations" in change else quats,
            (log_scales + change["scales"]).exp() if "scales" in change else splats.scales,
            sigmoid(logits + change["opacity"]).T if "opacity" in change else splats.opacities,
            hidden,
        )

    def features(self, splats: Splats, query: Query) -> Tensor:
        return super().features(splats, query).clamp(min=0.0)

    def changed(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        if not self.changes or "radiance" not in self.heads:
            return values
        if isinstance(query.geometry, Deformed):
            hidden = query.rows(query.geometry.hidden)
        else:
            hidden = self.hidden(query.rows(splats.means), query.time_s)
        return values + self._change("radiance", hidden).to(values)

    def regularisers(self, splats: Splats) -> dict[str, Tensor]:
        """The emission's, and those of the planes; none of weight 0 and none while the field is not used."""
        terms = super().regularisers(splats)
        if not self.changes:
            return terms
        found = {
            "smooth_space": lambda: sum(_roughness(plane) for plane in self.space),
            "smooth_time": lambda: sum(_roughness(plane) for plane in self.time),
            "sparse_time": lambda: sum((1 - plane).abs().mean(dim=(1, 2, 3)).sum() for plane in self.time),
        }
        return terms | {
            f"planes/{name}": self.weights[name] * term() for name, term in found.items() if self.weights[name] > 0
        }

    def temperature(self, splats: Splats, time_s: float, ids: Tensor | None = None) -> Tensor | None:
        level = super().temperature(splats, time_s, ids)
        if level is None or not self.changes or "radiance" not in self.heads:
            return level
        with torch.no_grad():
            change = self._change("radiance", self.hidden(Query(ids).rows(splats.means), time_s))[:, 0]
            return level + self.range.bounds.span_k * change

    def rate_of(self, name: str) -> Rate:
        own = super().rate_of(name)
        return own._replace(lr=self.lr_planes) if name.startswith(("space.", "time.")) else own

    @property
    def cost(self) -> int:
        channels = self.space[0].shape[1] * len(self.scales)
        heads = sum(layer.weight.numel() for head in self.heads.values() for layer in (head[1], head[3]))
        samples = channels * (3 * 4 + 3 * 2 + 5)  # planes, lines and their product
        return super().cost + samples + self.trunk.weight.numel() + heads

    # The field ------------------------------------------------------------------------------------------

    def hidden(self, means: Tensor, time_s: float | None) -> Tensor:
        """φ(f(x, t)) at ``means`` [n, 3] at a time, [n, width]; differentiable in the means.

        Raises:
            ValueError: there is no time.
        """
        share = self.clock.within(time_s)
        places = (means - self.center) / self.reach
        flat = torch.stack([places[:, pair] for pair in PAIRS])[:, :, None]  # [3, n, 1, 2]
        along = torch.stack((places.T, torch.zeros_like(places.T)), 2)[:, :, None]
        samples = []
        for space, time in zip(self.space, self.time, strict=True):
            planes, lines = _sampled(space, flat), _sampled(self._at(time, share), along)
            product = planes[0] * planes[1] * planes[2] * lines[0] * lines[1] * lines[2]
            samples.append(product)
        return self.trunk(torch.cat(samples).T)

    def _at(self, planes: Tensor, share: float) -> Tensor:
        """Time planes [3, C, nodes, R] at a share of the record: lines [3, C, 1, R]. All Gaussians share it: it comes first."""
        nodes = planes.shape[2]
        place = share * (nodes - 1)
        before = min(int(place), nodes - 2)
        return torch.lerp(planes[:, :, before], planes[:, :, before + 1], place - before)[:, :, None]

    def _change(self, name: str, hidden: Tensor) -> Tensor:
        """Δ of a head, [n, k] within its bound."""
        bound = HEADS[name][1]
        return bound * torch.tanh(self.heads[name](hidden) / bound)


def _sampled(planes: Tensor, places: Tensor) -> Tensor:
    """Bilinear samples [3, C, n] of planes [3, C, H, W] at places [3, n, 1, 2] in [-1, 1], x before y; border beyond.

    A place that is NaN is taken for the middle: torch would read from anywhere in memory (``FiniteGuard`` names the NaN).
    """
    places = places.nan_to_num(nan=0.0)
    found = functional.grid_sample(planes, places, mode="bilinear", padding_mode="border", align_corners=True)
    return found[..., 0]


def _roughness(planes: Tensor) -> Tensor:
    """Sum over planes [3, C, H, W] of the mean squared second difference along H; 0 of fewer than three nodes."""
    bend = planes.diff(n=2, dim=2)
    return bend.square().sum() / max(bend[0].numel(), 1)
