"""Options of the network of ThermoGS: what it sees, what it is held to, and which of them go together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from heatsplat.contracts import check_numbers, check_option
from heatsplat.thermal.coordinates import check_frames_per_cycle
from heatsplat.thermal.ellipsoid_balance import EllipsoidBalance
from heatsplat.thermal.land_cover import CLASSES
from heatsplat.thermal.surface_balance import SurfaceBalance

TIMES = ("scene", "record", "day", "none")
FEATURES = ("learned", "given", "labels", "none")
MATERIALS = ("inferred", "constant", "table")
COLLOCATIONS = ("view", "record")
BODIES = ("ellipsoid", "surface")
TERMS = ("smooth", "physical", "ode", "pinn")
BALANCED = ("ode", "pinn")  # the terms that need the balance of heat


@dataclass(frozen=True)
class NetworkOptions:
    """The options of ``EnergyNetwork`` of the same names, which says what they mean; checked.

    Raises:
        ValueError: an option is unknown or out of its range.
    """

    width: int
    blocks: int
    position_frequencies: int
    time_frequencies: int
    time: str
    frames_per_cycle: float | None
    features: str
    feature_size: int
    attributes: str
    weights: Mapping[str, float] | None
    first_steps: int
    ramp_steps: int
    interval_s: Sequence[float]
    collocation: str
    past_h: Sequence[float]
    body: str
    depth_m: float
    sampled: int
    projected_area: str
    surface_area: str
    sky: str
    smallest_axis_m: float
    margin: float

    def __post_init__(self) -> None:
        check_option("time", self.time, TIMES)
        check_option("features", self.features, FEATURES)
        check_option("attributes", self.attributes, MATERIALS)
        check_option("collocation", self.collocation, COLLOCATIONS)
        check_option("body", self.body, BODIES)
        check_numbers("past_h", self.past_h, len(self.past_h))
        check_numbers("interval_s", self.interval_s, 2)
        check_frames_per_cycle(self.frames_per_cycle)
        if min((self.depth_m, self.smallest_axis_m, *self.past_h)) <= 0:
            raise ValueError(
                f"depth_m, smallest_axis_m and past_h must be above 0, got {self.depth_m}, {self.smallest_axis_m} and "
                f"{list(self.past_h)}"
            )
        positive = (self.width, self.blocks, self.time_frequencies, self.sampled)
        counts = (self.position_frequencies, self.first_steps, self.ramp_steps)
        if min(positive) < 1 or min(counts) < 0:
            raise ValueError(
                "width, blocks, time_frequencies and sampled must be at least 1, position_frequencies, first_steps and "
                f"ramp_steps at least 0, got {', '.join(map(str, positive))}, {', '.join(map(str, counts))}"
            )
        if self.features in ("learned", "given") and self.feature_size < 1:
            raise ValueError(
                f"feature_size must be at least 1 where features are {self.features}, got {self.feature_size}; without: "
                "features=none"
            )
        shortest, longest = self.interval_s
        if not 0 < shortest <= longest or self.margin < 0:
            raise ValueError(
                f"interval_s must be two rising positive numbers and margin not negative, got {self.interval_s}"
            )
        if set(self.weights or {}) - set(TERMS):
            raise ValueError(f"weights are those of {', '.join(TERMS)}, got {', '.join(self.weights)}")
        if self.own_inputs < 1:
            raise ValueError("without place and features all Gaussians are alike: set position_frequencies or features")

    @property
    def inferred(self) -> bool:
        """Whether the network tells materials; otherwise the table does."""
        return self.attributes != "table"

    @cached_property
    def penalties(self) -> dict[str, float]:
        """Weight of each penalty that is on; what is not predicted is not compared with the table."""
        on = {name: weight for name, weight in (self.weights or {}).items() if weight > 0}
        return on if self.inferred else {name: weight for name, weight in on.items() if name != "physical"}

    @property
    def balanced(self) -> bool:
        """Whether a penalty needs the balance of heat."""
        return any(name in self.penalties for name in BALANCED)

    @property
    def labelled(self) -> bool:
        """Whether classes of the points are used."""
        return not self.inferred or self.features == "labels" or "physical" in self.penalties

    @property
    def features_each(self) -> int:
        """Features of a Gaussian."""
        sizes = {"learned": self.feature_size, "given": self.feature_size, "labels": len(CLASSES), "none": 0}
        return sizes[self.features]

    @property
    def own_inputs(self) -> int:
        """Inputs of the network that belong to a Gaussian: its encoded place and its features."""
        return 6 * self.position_frequencies + self.features_each

    def balance(self) -> EllipsoidBalance | SurfaceBalance:
        """The balance of heat that penalties ask for."""
        if self.body == "surface":
            return SurfaceBalance(self.sky, self.depth_m)
        return EllipsoidBalance(self.projected_area, self.surface_area, self.sky, self.smallest_axis_m)
