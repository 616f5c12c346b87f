"""The balance of heat of surfaces at a moment: what drives them, how fast they change, and derivatives by their parameters.

heatsplat.kernels.marching integrates it along a record of weather; its ``march`` has the equation, and
heatsplat.physics.energy_balance says what the symbols mean. All is of LANES surfaces at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from heatsplat.kernels.compilation import inline
from heatsplat.kernels.compile_time import compile_time, constant
from heatsplat.kernels.simd import bits, exp, load_vector, maximum, minimum, select

COVERS_MM = 0.1  # a film of water thinner than this covers part of a surface
LATENT_J_KG, AIR_J_M3_K, VAPOUR_J_KG_K = 2.45e6, 1.2e3, 461.5  # Λ of water, ρ c of air, gas constant of vapour
# Magnus' formula, 610.94 Pa exp(17.625 c / (c + 243.04)) at c °C, as L ρ_sat.
ZERO_C, MAGNUS, MAGNUS_C = 273.15, 17.625, 243.04
SATURATED = 610.94 / VAPOUR_J_KG_K * LATENT_J_KG / AIR_J_M3_K

# Rows of the drivers of a record; those of effects that are off are not read.
AIR, SKY, AROUND, LIGHT, WIND_ANOMALY, BEAM_X, BEAM_Y, BEAM_Z, GROUND, VAPOUR, RAIN, DRIES = range(12)


@compile_time
@dataclass(frozen=True)
class Balance:
    """Which effects a heat balance has beside the air; ``march`` is compiled for each, without a trace of the others.

    Args:
        radiates: with the share p of exchange that is radiation.
        sunny: with absorptance g.
        windy: with sensitivity v to wind.
        oriented: with normals; without them surfaces lie level.
        shaded: with the share of the beam that reaches them.
        grounded: with light that the ground reflects.
        heated: with heat f from within, constant or from a room.
        cored: with a core behind the surface.
        rained: with water of rain on it until it has evaporated.
        transpiring: with the share q of a wet surface's evaporation that it has where it is dry.
        sensitive: derivatives come with values.
    """

    radiates: bool
    sunny: bool
    windy: bool
    oriented: bool
    shaded: bool
    grounded: bool
    heated: bool
    cored: bool
    rained: bool
    transpiring: bool
    sensitive: bool

    @property
    def changing(self) -> bool:
        """Whether the exchange with the air goes with time."""
        return self.windy or self.moist

    @property
    def moist(self) -> bool:
        """Whether water evaporates."""
        return self.rained or self.transpiring

    @property
    def share_column(self) -> int:
        """Column of p among the parameters; columns of effects that are off do not exist."""
        return 2

    @property
    def sun_column(self) -> int:
        """Column of g."""
        return self.share_column + self.radiates

    @property
    def wind_column(self) -> int:
        """Column of v."""
        return self.sun_column + self.sunny

    @property
    def inner_column(self) -> int:
        """Column of f."""
        return self.wind_column + self.windy

    @property
    def core_column(self) -> int:
        """First of the three columns of the core: y at the start, log μ and log κ."""
        return self.inner_column + self.heated

    @property
    def transpiring_column(self) -> int:
        """Column of q."""
        return self.core_column + 3 * self.cored

    @property
    def film_column(self) -> int:
        """Column of the water on the surface at the first sample."""
        return self.transpiring_column + self.transpiring

    @property
    def normal_column(self) -> int:
        """First of the three columns of the unit normal, behind which comes the share of sky in what a surface sees."""
        return self.film_column + self.rained


radiates, sunny = constant("radiates"), constant("sunny")
windy, oriented, sensitive = constant("windy"), constant("oriented"), constant("sensitive")
shaded, grounded = constant("shaded"), constant("grounded")
heated, cored = constant("heated"), constant("cored")
rained, transpiring = constant("rained"), constant("transpiring")
moist, changing = constant("moist"), constant("changing")
share_column, sun_column = constant("share_column"), constant("sun_column")
wind_column, inner_column = constant("wind_column"), constant("inner_column")
core_column, transpiring_column = constant("core_column"), constant("transpiring_column")
film_column, normal_column = constant("film_column"), constant("normal_column")


class Surfaces(NamedTuple):
    """LANES of them: their parameters, and what follows from them; lanes of zeros for effects that are off. Numbers alike for
    all of them are those of the room behind, of the reference, its inverse, and how much water stays on them."""

    rate: Any
    share: Any
    absorptance: Any
    wind: Any
    inner: Any
    leak: Any
    slower: Any
    coupling: Any
    sky: Any
    nx: Any
    ny: Any
    nz: Any
    transpires: Any
    indoors: Any
    reference: Any
    inverse: Any
    holds: Any


class Drivers(NamedTuple):
    """What drives surfaces at a moment, or what changes of it; ``wet`` is the share of a surface that water covers."""

    air: Any
    wind: Any
    wet: Any
    vapour: Any
    sky: Any
    sun: Any


# What drives surfaces ------------------------------------------------------------------------------------------------


@inline
def drivers_at(balance, surfaces, drivers, lit, slots, k):
    """Drivers at a sample."""
    f = surfaces.sky
    wind, vapour, sky, sun = 0.0, 0.0, f, f
    if windy(balance):
        wind = drivers[WIND_ANOMALY, k]
    if moist(balance):
        vapour = drivers[VAPOUR, k]
    if radiates(balance):
        sky = drivers[AROUND, k] + f * (drivers[SKY, k] - drivers[AROUND, k])
    if sunny(balance):
        sun = f * drivers[LIGHT, k]
        if grounded(balance):
            sun = sun + (1.0 - f) * drivers[GROUND, k]
        if oriented(balance):
            x, y, z = drivers[BEAM_X, k], drivers[BEAM_Y, k], drivers[BEAM_Z, k]
            beam = maximum(surfaces.nx * x + surfaces.ny * y + surfaces.nz * z, 0.0)
            if shaded(balance):
                beam = beam * load_vector(lit, slots[k])
            sun = sun + beam
    return Drivers(drivers[AIR, k], wind, f * 0.0, vapour, sky, sun)


@inline
def wetted(drivers, film):
    """Drivers of surfaces with that much water on them."""
    wet = minimum(film * (1.0 / COVERS_MM), 1.0)
    return Drivers(drivers.air, drivers.wind, wet, drivers.vapour, drivers.sky, drivers.sun)


@inline
def changes_of(begin, end, share):
    """What drivers change in that share of an interval, in which they are linear."""
    return Drivers(
        share * (end.air - begin.air),
        share * (end.wind - begin.wind),
        share * (end.wet - begin.wet),
        share * (end.vapour - begin.vapour),
        share * (end.sky - begin.sky),
        share * (end.sun - begin.sun),
    )


@inline
def drivers_after(begin, changes, passed):
    """Drivers when that share of their changes has passed."""
    return Drivers(
        begin.air + passed * changes.air,
        begin.wind + passed * changes.wind,
        begin.wet + passed * changes.wet,
        begin.vapour + passed * changes.vapour,
        begin.sky + passed * changes.sky,
        begin.sun + passed * changes.sun,
    )


# Evaporation ---------------------------------------------------------------------------------------------------------


@inline
def saturated(surfaces, x):
    """L ρ_sat of R + x in kelvin (Magnus' formula: Alduchov and Eskridge 1996, Eq. 21), and its derivative.

    Colder than -100 °C, where nothing of it is left, and hotter than 150 °C it stays what it is there.
    """
    kelvin = minimum(maximum(surfaces.reference + x, ZERO_C - 100.0), ZERO_C + 150.0)
    inverse = 1.0 / (kelvin - (ZERO_C - MAGNUS_C))
    vapour = SATURATED * exp(MAGNUS * (1.0 - MAGNUS_C * inverse)) / kelvin
    return vapour, vapour * (MAGNUS * MAGNUS_C * inverse * inverse - 1.0 / kelvin)


@inline
def vapour_on(balance, surfaces, x, water):
    """``saturated``, where it matters: on surfaces that transpire, and while there is ``water`` on any of them; else zeros."""
    vapour, steam = x * 0.0, x * 0.0
    if transpiring(balance) or (rained(balance) and bits(water > 0.0) != 0):
        vapour, steam = saturated(surfaces, x)
    return vapour, steam


class Found(NamedTuple):
    """What drives surfaces as they find it that evaporate water.

    Args:
        air: T_eq, which they follow by the tangent of evaporation at their temperature.
        wind, sky, sun: as they are.
        times: as fast as dry ones they follow it.
        moist: share of a wet surface's evaporation that they have.
    """

    air: Any
    wind: Any
    times: Any
    moist: Any
    sky: Any
    sun: Any


@inline
def found_at(balance, surfaces, drivers, x, vapour, steep):
    """Drivers as surfaces find them at x, of saturated vapour there and its derivative."""
    air, times, share = drivers.air, 1.0, 0.0
    if moist(balance):
        share = drivers.wet
        lacks = vapour - drivers.vapour
        if transpiring(balance):
            share = share + select(lacks > 0.0, (1.0 - share) * surfaces.transpires, 0.0)
        times = 1.0 + share * steep
        air = drivers.air - share * (lacks + steep * (drivers.air - x)) / times
    return Found(air, drivers.wind, times, share, drivers.sky, drivers.sun)


# How fast surfaces change --------------------------------------------------------------------------------------------


@inline
def power(x, inverse):
    """(T⁴ - R⁴) / (4 R³) of T = R + x, and its derivative (T / R)³; of 1 / R."""
    z = x * inverse
    return x * (1.0 + z * (1.5 + z * (1.0 + 0.25 * z))), (1.0 + z) * (1.0 + z) * (1.0 + z)


@inline
def _hastened(balance, surfaces, wind, times, exchange):
    """An exchange with the air, by wind and water."""
    if windy(balance):
        exchange = exchange * (1.0 + surfaces.wind * wind)
    if moist(balance):
        exchange = exchange * times
    return exchange


@inline
def exchange_of(balance, surfaces, wind, times):
    """c, with the air."""
    exchange = _hastened(balance, surfaces, wind, times, surfaces.share * 0.0 + 1.0)
    if radiates(balance):
        exchange = (1.0 - surfaces.share) * exchange
    return exchange


@inline
def stiffness_of(balance, surfaces, exchange, steep):
    """By how much dx/dt / r falls with x, of bodies of one node, at an exchange with the air."""
    if radiates(balance):
        exchange = exchange + surfaces.share * steep
    if heated(balance):
        exchange = exchange + surfaces.leak
    return exchange


class Side(NamedTuple):
    """The balance at one end of a substep."""

    drivers: Any
    x: Any
    y: Any
    w: Any
    force: Any


@inline
def side_of(balance, surfaces, drivers, x, y, w):
    """The balance of surfaces at x, of cores at y, with w of x."""
    force = exchange_of(balance, surfaces, drivers.wind, drivers.times) * (drivers.air - x)
    if sunny(balance):
        force = force + surfaces.absorptance * drivers.sun
    if radiates(balance):
        force = force + surfaces.share * (drivers.sky - w)
    if heated(balance):
        force = force + surfaces.inner - surfaces.leak * x
    if cored(balance):
        force = force - surfaces.coupling * (x - y)
    return Side(drivers, x, y, w, force)


@inline
def by_share(balance, surfaces, side):
    """Derivative of the balance by p."""
    drivers = side.drivers
    return drivers.sky - side.w - _hastened(balance, surfaces, drivers.wind, drivers.times, drivers.air - side.x)


@inline
def by_wind(balance, surfaces, side):
    """Derivative of the balance by v."""
    drivers = side.drivers
    gust = drivers.wind * (drivers.air - side.x)
    if radiates(balance):
        gust = (1.0 - surfaces.share) * gust
    if moist(balance):
        gust = gust * drivers.times
    return gust


@inline
def by_transpiring(balance, surfaces, drivers, vapour):
    """Derivative of the balance by q, of saturated vapour on the surface."""
    exchange = exchange_of(balance, surfaces, drivers.wind, 1.0)
    return (drivers.wet - 1.0) * exchange * maximum(vapour - drivers.vapour, 0.0)


@inline
def by_inner(surfaces, side):
    """Derivative of the balance by f, which lets heat out where it has the sign of i."""
    one = side.x * 0.0 + 1.0
    return select(surfaces.inner * surfaces.indoors >= 0.0, one - surfaces.indoors * side.x, one)
