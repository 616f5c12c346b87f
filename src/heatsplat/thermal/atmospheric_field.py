"""Thermal3D-GS: a network says how the air between a Gaussian and the camera weakens its radiance."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from heatsplat.contracts import SceneData, check_option
from heatsplat.same_bits import softplus
from heatsplat.splats import Splats
from heatsplat.thermal.base import PerGaussian, Query, Seeds, ThermalModel
from heatsplat.thermal.coordinates import Box, Clock, check_frames_per_cycle, octaves, slow_octaves
from heatsplat.thermal.layers import draw_uniform
from heatsplat.thermal.wrapper import Wrapper

TIMES = ("auto", "seconds", "index", "none")
EXPONENTS = ("positive", "printed")
POSITIONS = ("box", "world")
START = -1.0  # of absorption, scattering and distance before softplus: an exponent of 0.2, not yet saturated


class AtmosphericField(Wrapper):
    """Emission times e^{-(μ_a + μ_s) d}, where a network gives the three from place and time (Thermal3D-GS, section 3.2).

    The emission is another thermal model, such as ``Static``. The network sees positions without passing gradients to
    them and is evaluated for the Gaussians in view alone; the part that depends on time only, once per view. Its last
    layer starts at zero and the exponent counts from there, so that the factor is exactly 1 at first.

    Where it departs from the published code, which multiplies by e^{+(μ_a + μ_s) d} without a bound: the sign of physics,
    a bound on the exponent, and the encoding of ``octaves``, which has a factor π and no plain coordinate beside it.

    **Convention:** the factor has no unit. Absorption μ_a, scattering μ_s (1 per unit of distance) and distance d only
    act as (μ_a + μ_s) d: none of the three is a measurement.

    Args:
        emission: what splats emit before anything weakens it.
        width, depth: hidden layers of the network.
        skip: hidden layer that sees the encoded position again (Mildenhall et al. 2020), or None.
        position_frequencies, time_frequencies: octaves of the encodings sin(2^k π p), cos(2^k π p).
        frames_per_cycle: training images to a cycle of an octave of time, at least: the network does not see faster ones,
            which mean nothing between images. None shows it all.
        positions: "box" fits the central 98 % of the scene's points into a cube of edge 1 first, so that the code is
            one-to-one; "world" encodes world units as they are.
        time: "seconds" of the views over the recorded span, "index" of the frame over the number of frames, "none", or
            "auto": seconds where the scene has times, else index.
        exponent: "positive" keeps μ_a, μ_s, d positive by softplus; "printed" takes them from the network as they come,
            so that the factor may exceed 1, too.
        exponent_max: bound of |(μ_a + μ_s) d|, approached smoothly; None leaves it unbounded, as published.
        lr, lr_end: learning rate of the network and the factor on it at the end of the run.
        lr_held: share of a short run in which that rate stays before it falls (``Rate.held``).

    Raises:
        ValueError: an option is unknown or out of its range, or a size is not positive.
    """

    paced = True
    factor_name = "transmission"  # of the factor among the attributes
    further: tuple[float, ...] = ()  # what the network gives beside the three quantities, before training

    def __init__(
        self,
        emission: ThermalModel,
        width: int = 32,
        depth: int = 2,
        skip: int | None = None,
        position_frequencies: int = 10,
        time_frequencies: int = 10,
        frames_per_cycle: float | None = 4.0,
        positions: str = "box",
        time: str = "auto",
        exponent: str = "printed",
        exponent_max: float | None = 4.0,
        lr: float = 8e-4,
        lr_end: float = 2e-3,
        lr_held: float = 0.7,
    ) -> None:
        super().__init__({"emission": emission}, needs={"time"} if time == "seconds" else ())
        check_option("time", time, TIMES)
        check_option("exponent", exponent, EXPONENTS)
        check_option("positions", positions, POSITIONS)
        if width < 1 or depth < 1 or position_frequencies < 1 or time_frequencies < 1:
            raise ValueError(
                "width, depth, position_frequencies and time_frequencies must be at least 1, got "
                f"{width}, {depth}, {position_frequencies}, {time_frequencies}"
            )
        if skip is not None and not 1 <= skip < depth:
            raise ValueError(f"skip must name a hidden layer from 1 to {depth - 1}, or be null, got {skip}")
        check_frames_per_cycle(frames_per_cycle)
        if exponent_max is not None and not exponent_max > 0:
            raise ValueError(f"exponent_max must be positive or null, got {exponent_max}")
        self.positive, self.exponent_max = exponent == "positive", exponent_max
        self.positions = positions
        self.position_frequencies, self.time_frequencies = position_frequencies, time_frequencies
        self.frames_per_cycle = frames_per_cycle
        if not 0 <= lr_held < 1:
            raise ValueError(f"lr_held is a share of a run and must lie in [0, 1), got {lr_held}")
        self.time, self.lr, self.lr_end, self.held = time, lr, lr_end, lr_held
        codes = 6 * position_frequencies
        inputs = [codes if i == 0 else width + codes if i == skip else width for i in range(depth)]
        self.layers = nn.ModuleList(nn.Linear(count, width) for count in inputs)
        timed = 2 * time_frequencies if time != "none" else 0
        self.moment_layers = nn.ModuleDict(
            {str(i): nn.Linear(timed, width, bias=False) for i in (0, skip) if timed and i is not None}
        )
        start = [START, START, START] if self.positive else [0.0, 0.0, 1.0]  # with d = 0 as well nothing would learn
        self.head = nn.Linear(width, 3 + len(self.further))
        nn.init.zeros_(self.head.weight)
        with torch.no_grad():
            self.head.bias.copy_(torch.tensor([*start, *self.further]))
        self.register_buffer("start", self.head.bias.detach().clone())
        self.box, self.clock = Box(), Clock()  # where there are no times, the clock counts frames
        self.register_buffer("by_index", torch.tensor(time == "index"))
        self.register_buffer("slow_octaves", torch.tensor(time_frequencies))  # those of time that the network sees

    # What the contract asks -----------------------------------------------------------------------------

    def prepare(self, scene: SceneData) -> None:
        super().prepare(scene)
        self.box.prepare(scene)
        if self.time == "auto":
            self.by_index.fill_("time" not in scene.metadata)
        if self.by_index:
            ids = [frame.frame_id for frame in scene.frames]
            self.clock.record.copy_(torch.tensor([0.0, max(*ids, 1)]))
        elif self.time != "none":
            self.clock.prepare(scene)
        moments = {frame.frame_id if self.by_index else frame.time_s for frame in scene.train.frames}
        self.slow_octaves.fill_(slow_octaves(self.time_frequencies, len(moments), self.frames_per_cycle, 0.5))

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        draw_uniform((*self.layers, *self.moment_layers.values()), seeds.generator)
        return super().per_gaussian(seeds)

    def changed(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        return self._weakened(values, self.factor(query.rows(splats.means), query)[:, None].to(values))

    def attributes(self, splats: Splats, query: Query) -> dict[str, Tensor]:
        """The emission's, and the factor by which the field weakens what is emitted."""
        with torch.no_grad():
            factor = self.factor(query.rows(splats.means), query)
        return super().attributes(splats, query) | {self.factor_name: factor}

    def effects(self) -> dict[str, dict]:
        network = f"{self.head.in_features} x {len(self.layers)}"
        return super().effects() | {"attenuation": {"network": network, "time": self._time_source}}

    @property
    def cost(self) -> int:
        products = sum(layer.weight.numel() for layer in (*self.layers, self.head))
        return super().cost + products + 6 * self.position_frequencies + 20  # the code, and the formula itself

    @property
    def own_beyond_record(self) -> str:
        timed = self.time != "none" and not self.by_index
        return "the field stays as at the nearest moment of the record" if timed else ""

    # The field ------------------------------------------------------------------------------------------

    def factor(self, means: Tensor, query: Query) -> Tensor:
        """What emission is multiplied by at ``means`` [n, 3] at the time of ``query``, [n]; without a gradient to means."""
        return self._factor_of(self._network(self._code_of(means.detach()), self._moment_of(query)))

    def _factor_of(self, raw: Tensor) -> Tensor:
        """The factor [n] that raw network outputs [n, 3 + further] mean."""
        return torch.exp(self._exponent(self.start[None]) - self._exponent(raw))

    def _weakened(self, emitted: Tensor, factor: Tensor) -> Tensor:
        """What is left of an emission [n, C] with factors [n, 1]."""
        return factor * emitted

    def _exponent(self, raw: Tensor) -> Tensor:
        """(μ_a + μ_s) d of raw network outputs [n, 3 + further], within ± exponent_max."""
        absorption, scattering, distance = (softplus(raw[:, :3]) if self.positive else raw[:, :3]).unbind(1)
        exponent = (absorption + scattering) * distance
        if self.exponent_max is None:
            return exponent
        return self.exponent_max * torch.tanh(exponent / self.exponent_max)

    def _network(self, code: Tensor, moment: Tensor | None) -> Tensor:
        hidden = code
        for i, layer in enumerate(self.layers):
            skip = i > 0 and layer.in_features > layer.out_features
            hidden = layer(torch.cat((hidden, code), 1) if skip else hidden)
            if moment is not None and str(i) in self.moment_layers:
                hidden = hidden + self.moment_layers[str(i)](moment)
            hidden = hidden.relu()
        return self.head(hidden)

    def _code_of(self, means: Tensor) -> Tensor:
        means = self.box.places(means) if self.positions == "box" else means
        return octaves(means, self.position_frequencies).to(self.head.weight)

    def _moment_of(self, query: Query) -> Tensor | None:
        """The encoded time of a query, [2 F], or None without time."""
        if self.time == "none":
            return None
        moment = query.frame_id if self.by_index else query.time_s
        if self.by_index and (moment is None or not 0 <= moment <= self.clock.span_s):
            fraction = 0.5  # a view that no one took has no index: it is shown as at the middle of the record
        else:
            fraction = self.clock.within(moment)
        when = torch.tensor([[fraction]], dtype=torch.float64, device=self.start.device)
        return octaves(when, self.time_frequencies, self.slow_octaves)[0].to(self.head.weight)

    @property
    def _time_source(self) -> str:
        return "none" if self.time == "none" else "index" if self.by_index else "seconds"
