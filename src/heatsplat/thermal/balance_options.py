"""Options of the balance of heat of surfaces under the sky: which effects are on, and which of them go together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from heatsplat.contracts import check_option
from heatsplat.physics.sky import LAWS
from heatsplat.physics.walls import CONVECTION

SOLUTIONS = ("auto", "linear", "corrected")
EXCHANGES = ("learned", "iso_6946")
MOST_CONVECTION = 100.0  # W/(m² K) and W s/(m³ K): ten times what outer surfaces have
SURFACES = ("seen", "level")
SKIES = ("auto", *LAWS)


@dataclass(frozen=True)
class BalanceOptions:
    """The options of ``EnergyBalance`` of the same names, which says what they mean; checked.

    Raises:
        ValueError: an option is unknown or out of its range, or options do not go together.
    """

    solution: str
    nodes: int
    sky: str | None
    clouds: bool
    rain: float | None
    transpires: bool
    wind: bool
    sun: bool
    semi_infinite: bool
    inner: bool
    exchange: str | Sequence[float]
    convection_error: float
    indoor_c: float | None
    normals: str
    shadows: bool
    sky_view: bool
    albedo: float | None
    emissivity: float

    def __post_init__(self) -> None:
        check_option("solution", self.solution, SOLUTIONS)
        check_option("normals", self.normals, SURFACES)
        check_option("sky", self.sky, (*SKIES, None))
        check_option("nodes", self.nodes, (1, 2))
        if self.clouds and self.sky is None:
            raise ValueError("clouds are of the sky: give sky=auto or another law, or clouds=false")
        if self.semi_infinite and not self.linear:
            raise ValueError(
                "semi_infinite works only with the linearised balance: give solution=linear or semi_infinite=false"
            )
        if self.rain is not None and not self.rain > 0:
            raise ValueError(f"rain must be above 0 mm, or null for surfaces that stay dry, got {self.rain}")
        if (self.rain is not None or self.transpires) and (self.linear or self.indoor_c is not None):
            raise ValueError(
                "rain and transpires work only with the full balance, and mean losses of walls leave them out: give "
                "solution=corrected and indoor_c=null, or rain=null and transpires=false"
            )
        if self.nodes == 2 and self.semi_infinite:
            raise ValueError("semi_infinite and nodes=2 exclude each other: give nodes=1 or semi_infinite=false")
        if self.convection is not None and (self.sky is None or (self.convection[1] > 0 and not self.wind)):
            raise ValueError(f"exchange={self.exchange} is that with sky and wind: leave it out, or both of them on")
        if self.indoor_c is not None and not self.inner:
            raise ValueError("indoor_c has no effect without heat from within: give inner=true")
        if self.surrounded and (not self.sun or self.normals != "seen"):
            raise ValueError(
                "shadows, sky_view and albedo are of sunlight on surfaces as they lie: give sun=true, normals=seen"
            )
        if self.albedo is not None and not 0 < self.albedo < 1:
            raise ValueError(f"albedo must lie in (0, 1), or be null for none, got {self.albedo}")
        if not 0 <= self.convection_error < 1:
            raise ValueError(f"convection_error must lie in [0, 1), got {self.convection_error}")
        if not 0 < self.emissivity <= 1:
            raise ValueError(f"emissivity must lie in (0, 1], got {self.emissivity}")

    @property
    def linear(self) -> bool:
        """Whether T⁴ and wind are linearised; otherwise the full balance is solved along the record."""
        return self.solution == "linear" or (self.solution == "auto" and self.semi_infinite)

    @cached_property
    def convection(self) -> tuple[float, float] | None:
        """Convection of still air in W/(m² K) and of each m/s of wind in W s/(m³ K); None where it is learned.

        Raises:
            ValueError: ``exchange`` is no name that is known, nor two such numbers.
        """
        if isinstance(self.exchange, str):
            check_option("exchange", self.exchange, EXCHANGES)
            return CONVECTION if self.exchange == "iso_6946" else None
        numbers = tuple(self.exchange) if isinstance(self.exchange, Sequence) else (self.exchange,)
        sound = len(numbers) == 2 and all(
            isinstance(number, (int, float)) and 0 <= number <= MOST_CONVECTION for number in numbers
        )
        if not sound or numbers[0] == 0:
            raise ValueError(
                "exchange must be learned, iso_6946, or convection of still air in W/(m² K), above 0, with what each m/s of "
                f"wind adds in W s/(m³ K), both up to {MOST_CONVECTION:g}, such as [5.0,2.5]; got {self.exchange!r}"
            )
        return float(numbers[0]), float(numbers[1])

    @property
    def windy(self) -> bool:
        """Whether wind moves convection, if recorded: not where convection is given that no wind changes."""
        return self.wind if self.convection is None else self.convection[1] > 0

    @property
    def surrounded(self) -> bool:
        """Whether the scene's own geometry hides sun or sky, or returns light."""
        return self.shadows or self.sky_view or self.albedo is not None
