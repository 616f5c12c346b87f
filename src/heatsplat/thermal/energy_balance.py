"""Every Gaussian is a piece of surface under the sky, heated and cooled by the recorded weather in closed form."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import Any

import torch
from torch import Tensor

from heatsplat.contracts import SceneData, SceneError, Weather, check_option
from heatsplat.physics.energy_balance import Climate
from heatsplat.physics.marching import Course, Kept, stepped_temperature
from heatsplat.physics.responses import driver_means, interval_of
from heatsplat.physics.surfaces import Core, Exposure, Surface, power_excess
from heatsplat.physics.units import STEFAN_BOLTZMANN, celsius, kelvin
from heatsplat.physics.walls import u_value
from heatsplat.same_bits import sigmoid
from heatsplat.splats import Splats
from heatsplat.thermal.balance_options import BalanceOptions
from heatsplat.thermal.base import (
    KELVIN_RANGE,
    NORMALS,
    SKY_SEEN,
    SUN_SEEN,
    PerGaussian,
    Query,
    Seeds,
    ThermalModel,
    surface_normals,
)
from heatsplat.thermal.clipping import CLIPS, clipped
from heatsplat.thermal.coordinates import ImageRange
from heatsplat.thermal.materials import Materials
from heatsplat.thermal.surface_drivers import drivers_of

SUN_LIMIT = 200.0  # K m²/kW: a black surface at 8 °C that loses heat by its own radiation alone
SHARE_LIMITS = (0.02, 0.98)  # of radiation in the exchange: where attributes divide by it or by the rest
WIND_LIMITS = (0.0, 0.95)  # of wind in convection: in a calm something is left
START_SHARE, START_WIND = 0.4, 0.4  # e = 0.9 beside 8 W/(m² K), of which a light breeze makes 40 %
START_TIME_CONSTANT_S = 3600.0
START_TRANSPIRES = 0.05  # of a wet surface's evaporation: next to none, of what images do not tell
START_CORE_S = 6 * 3600.0  # time constant of a core, and its coupling beside the surface's exchange: soil, walls
START_COUPLING = 0.5
COUPLINGS = (math.log(0.02), math.log(50.0))
START_SUN = (5.0, 80.0)  # K m²/kW, limits of what the images' mean temperature is taken to say
START_ABSORPTIVITY = 0.5  # at most, where the exchange is given: of what images by night do not tell, it stays so
LOG_RATES = (math.log(1e-7), math.log(0.1))  # 1/s: time constants from 10 seconds to 4 months
GIVEN = (NORMALS, SUN_SEEN, SKY_SEEN)
LEARNED = ("initial_state", "log_rate", "raw_sun", "raw_share", "raw_wind", "inner_rise")
LEARNED += ("initial_core", "log_core_rate", "log_coupling", "raw_transpires")
# All of order one.
OF_MATERIALS = ("log_rate", "raw_sun", "raw_share", "raw_wind", "log_core_rate", "log_coupling", "raw_transpires")
MARCHED_AT = "marched_at"  # the tensor of parameters at which a Gaussian was marched along the record
LINEAR_COST, MARCHED_COST = 400, 3000


class EnergyBalance(ThermalModel):
    """Emission of C dT/dt = α G(t) + h(t) (T_air - T) + e σ (T_sky⁴ - T⁴) per unit area (ThermoGS, Eq. 2-5, with a sky).

    Only ratios reach the image (heatsplat.physics.energy_balance): α, h, e and the capacity C times any number give the
    same temperatures. Learned are the ratios themselves, in units in which an optimiser's steps are of order one; absolute
    attributes follow with ``emissivity`` given, and are maps for people, not measurements. Effects that the scene does not
    call for are absent: without a sky there is no share of radiation, without wind in the record no share of wind, without
    the sun's direction no normal, without any irradiance no sunlight. What the scene's own geometry does to them (shadows,
    sky that is hidden, light from the ground) is there where it is asked for.

    Bodies without an end (``semi_infinite``) are massive walls and ground that the record does not heat through: one number
    in the place of the rate, a = (H/b)², tells their effusivity b. ``inner`` adds a constant heat from within, q/H for each
    Gaussian. With ``indoor_c`` it comes of a room of this temperature, as much as the wall between lets through: then q/H is
    that of a surface as warm as the mean air, and tells a U-value.

    Identifiable: α/C and h/C, and e/C by night, with the state at the start of the record where it is still remembered
    when images begin; the share of wind in h where the wind changes while surface and air differ. Not identifiable: the
    common factor of α, h, e and C; α from C/h of surfaces that the sun never meets; the rate of surfaces that settle between
    any two samples of the weather. The heat from within is told from that of the sky by nights of different skies only, and
    counts from the air: an air temperature that is 1 K off is 1 K of it.

    Bodies of two nodes have a core behind the surface, which follows it at a rate of its own: ground and walls that are warm
    after dusk. Both rates are looked up in the same tables; it costs twice as much.

    **Convention:** the record's first sample is the start. In another weather (a scene whose record is another) surfaces
    start from the state that they had at the start of the trained record, whenever the other one starts.

    Tensors, [N] each: "initial_state" in image units; "log_rate", log of 1/s; "raw_sun", logit of α/H by 200 K m²/kW, or of α
    where the exchange is given; "raw_share", logit of e's share of H; "raw_wind", logit of wind's share of convection; with two
    nodes "initial_core" in image units, "log_core_rate", log of 1/s, and "log_coupling", of the conductance to the core over H;
    with heat from within "inner_rise", q/H in image units; with transpiration "raw_transpires", logit of its share of a wet
    surface's evaporation. With solution "corrected" a constant, "marched_at" [N, Q], the parameters at which a Gaussian was
    last marched.

    Args:
        solution: "corrected" solves the full balance along the record, for all training frames at once and anew where
            parameters have moved (heatsplat.physics.marching); "linear" has T⁴ and wind linearised about the surface's own mean
            temperature and costs the same for any record. "auto" is linear for bodies without an end, else corrected.
        nodes: 1, or 2 for bodies with a core.
        sky: law of the sky's temperature ("brutsaert", "berdahl_martin", "brunt", "swinbank"; "auto" is the first with
            humidity and the last without), or None: nothing radiates.
        clouds: whether the clouds of the record warm the sky (``Weather.clouds``); laws are of clear skies.
        rain: millimetres of the record's rain that stay on surfaces until they have evaporated (heatsplat.physics.wetness),
            with the full balance; None: rain leaves surfaces dry, as does a weather without rain_mm_h.
        transpires: whether surfaces that are dry evaporate a share of what wet ones do, as plants and moist soil, each its own;
            with the full balance, and the humidity of the record.
        wind: whether wind, if recorded, moves convection.
        sun: whether sunlight, if recorded, heats.
        semi_infinite: bodies have no end (with one node and solution "linear").
        inner: whether there is heat from within.
        exchange: "learned" has each Gaussian find radiation's and wind's share of its exchange. Otherwise they follow from the
            emissivity and convection that is given, which leaves images to tell heat from within: two numbers, that of still
            air in W/(m² K) and what each m/s of the recorded wind adds in W s/(m³ K), as measured on site; or "iso_6946",
            the convention of building physics, 4 and 4.
        convection_error: relative standard deviation of convection that is given, for intervals of what is learned; 0 takes it
            for exact.
        indoor_c: temperature of the rooms behind walls in °C: heat from within comes of them by a constant conductance, which
            tells a U-value in ``attributes``. None: heat from within is constant, and there is no U-value.
        normals: "seen" has every Gaussian meet the sun as the surface lies that it shows (``Query.normals``); "level" has
            all surfaces lie level, under the global irradiance.
        shadows: whether what stands in the way of the sun casts shadows (heatsplat.training.exposure).
        sky_view: whether it hides sky as well.
        albedo: of the ground, for sunlight that comes back from what is not sky; None: nothing comes back.
        emissivity: assumed for ``attributes``, in (0, 1].
        materials: number of materials that the scene is taken to be made of (``Materials``), or None: every Gaussian is on
            its own. They hold what images leave open: the logarithm of rates, and sun, shares and coupling before their
            sigmoids. Better in other weather where the record and the balance are right, and worse where they are not.
        material_weight: of the squared distance from them in the loss.
        materials_from: step from which they do; what Gaussians have learned by then tells them.
        clip: how values outside the range are shown; see ``NewtonHarmonic``.
        lr_initial, lr_rate, lr_sun, lr_share, lr_wind, lr_inner: learning rates.
        lr_end: factor on them at the last step, log-linear in between.

    Raises:
        ValueError: an option is unknown or out of its range.
    """

    needs = frozenset({"time", "weather", "thermal_range"})
    narrowest_range_k = KELVIN_RANGE
    optional = frozenset({"raw_wind"})
    # On days that no image shows, small errors of all parameters add up, so the mean is over more updates than elsewhere; and
    # attributes of Gaussians that start opaque scatter more (docs/defaults.md).
    averaged = 0.5
    start_opacity = 0.1
    beyond_record = "the recorded weather drives the balance of heat on, and without weather there is no answer"

    def __init__(
        self,
        solution: str = "auto",
        nodes: int = 1,
        sky: str | None = "auto",
        clouds: bool = False,
        rain: float | None = None,
        transpires: bool = False,
        wind: bool = True,
        sun: bool = True,
        semi_infinite: bool = False,
        inner: bool = False,
        exchange: str | Sequence[float] = "learned",
        convection_error: float = 0.2,
        indoor_c: float | None = None,
        normals: str = "seen",
        shadows: bool = False,
        sky_view: bool = False,
        albedo: float | None = None,
        emissivity: float = 0.95,
        materials: int | None = None,
        material_weight: float = 0.003,
        materials_from: int = 0,
        clip: str = "straight_through",
        lr_initial: float = 2.5e-3,
        lr_rate: float = 2e-2,
        lr_sun: float = 2e-2,
        lr_share: float = 1e-2,
        lr_wind: float = 1e-2,
        lr_inner: float = 2.5e-3,
        lr_end: float = 0.1,
    ) -> None:
        super().__init__()
        check_option("clip", clip, CLIPS)
        if not material_weight > 0:
            raise ValueError(f"material_weight must be above zero, got {material_weight}; materials=null is without")
        self.options = BalanceOptions(
            solution=solution,
            nodes=nodes,
            sky=sky,
            clouds=clouds,
            rain=rain,
            transpires=transpires,
            wind=wind,
            sun=sun,
            semi_infinite=semi_infinite,
            inner=inner,
            exchange=exchange,
            convection_error=convection_error,
            indoor_c=indoor_c,
            normals=normals,
            shadows=shadows,
            sky_view=sky_view,
            albedo=albedo,
            emissivity=emissivity,
        )
        self.materials = None if materials is None else Materials(materials, len(OF_MATERIALS))
        self.material_weight, self.materials_from, self.clip = material_weight, materials_from, clip
        self._step = 0
        self.lr_initial, self.lr_rate, self.lr_sun = lr_initial, lr_rate, lr_sun
        self.lr_share, self.lr_wind, self.lr_inner, self.lr_end = lr_share, lr_wind, lr_inner, lr_end
        self._convection_factor = 1.0  # other than 1 while ``doubts`` asks what convection that is given matters
        self.climate: Climate | None = None
        self.simulated: dict[str, dict] = {}
        # What trained parameters count from; another weather leaves it as it is.
        self.range = ImageRange()
        self.register_buffer("reference_k", torch.zeros((), dtype=torch.float64))
        if self.options.windy:
            self.register_buffer("mean_wind", torch.zeros((), dtype=torch.float64))
        if self._exchange_given:
            self.register_buffer("sun_limit", torch.zeros((), dtype=torch.float64))
        if self.options.shadows:
            self.register_buffer("sun_ways", torch.zeros(0, 3, dtype=torch.float64))  # those of SUN_SEEN's columns
        self._weather: Weather | None = None
        self._moments: Tensor | None = None  # of training frames
        self._felt: list[float | None] = []  # moments of all frames
        self._kept: Kept | None = None
        self._course: tuple[dict[str, Tensor], Course] | None = None
        self.register_load_state_dict_post_hook(_live_on)

    # What the contract asks -----------------------------------------------------------------------------

    def prepare(self, scene: SceneData) -> None:
        weather = scene.weather
        if weather.air_c is None:
            raise SceneError(f"the weather of scene '{scene.name}' has no air_c, the temperature of the air; add it")
        if self.reference_k == 0:  # otherwise this is another weather for what was trained
            self.range.prepare(scene)
            self.reference_k.fill_(kelvin(driver_means(weather.times_s, weather.air_c)))
            if self.options.windy and weather.wind_m_s is not None:
                self.mean_wind.copy_(driver_means(weather.times_s, weather.wind_m_s))
            if self._exchange_given:
                self.sun_limit.fill_(1000.0 * self._shares()[0] / self._radiation())
        self._felt = [frame.time_s for frame in scene.frames]
        self._moments = torch.tensor(sorted(set(scene.train.times_s) - {None}), dtype=torch.float64)
        self.under(weather)
        for frame in scene.frames:
            if frame.time_s is not None:
                weather.at(frame.time_s)  # refuses a frame outside the record before anything is trained

    def under(self, weather: Weather) -> None:
        """Lives in another weather from here on; what was learned stays.

        Raises:
            SceneError: the record lacks a series that the model was trained with.
        """
        mean_wind = self.mean_wind.item() if self.options.windy else 0.0
        ways = self.sun_ways.cpu() if self.options.shadows and len(self.sun_ways) else None
        drivers, self.simulated = drivers_of(
            weather, self.options, self.reference_k.item(), mean_wind, ways, self._felt
        )
        if self.options.shadows and ways is None:
            self.sun_ways = drivers.ways.to(self.reference_k.device)
        self._weather, self.climate = weather, Climate(drivers, self.options.semi_infinite)
        self._kept, self._course = Kept(self.climate, self._moments), None

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        grey = seeds.values.mean(1)
        tensor = partial(PerGaussian, lr_end=self.lr_end)
        tensors = {
            "initial_state": tensor(grey, self.lr_initial),
            "log_rate": tensor(torch.full_like(grey, -math.log(START_TIME_CONSTANT_S)), self.lr_rate),
        }
        if self.options.nodes == 2:
            tensors["initial_core"] = tensor(grey.clone(), self.lr_initial)
            tensors["log_core_rate"] = tensor(torch.full_like(grey, -math.log(START_CORE_S)), self.lr_rate)
            tensors["log_coupling"] = tensor(torch.full_like(grey, math.log(START_COUPLING)), self.lr_rate)
        if self.options.transpires:
            start = torch.full_like(grey, START_TRANSPIRES).logit()
            tensors["raw_transpires"] = tensor(start, self.lr_share)
        if self.options.inner:
            tensors["inner_rise"] = tensor(torch.zeros_like(grey), self.lr_inner)
        drivers = self.climate.drivers
        # Few images tell the shares apart, and at a short run's pace they would follow single ones: nothing that the trained
        # weather shows, and degrees in another. What is linearised needs that freedom to make up for what it leaves out.
        share = partial(tensor, paced=self.options.linear)
        if self._sunlit:
            tensors["raw_sun"] = tensor(torch.logit(self._first_sun(grey) / self._sun_limit), self.lr_sun)
        if drivers.sky is not None and not self._exchange_given:
            start = (START_SHARE - SHARE_LIMITS[0]) / (SHARE_LIMITS[1] - SHARE_LIMITS[0])
            tensors["raw_share"] = share(torch.full_like(grey, start).logit(), self.lr_share)
        if drivers.wind_anomaly is not None and not self._exchange_given:
            tensors["raw_wind"] = share(torch.full_like(grey, START_WIND / WIND_LIMITS[1]).logit(), self.lr_wind)
        if not self.options.linear:
            shares_given = 1 + self.options.windy if self._exchange_given else 0
            numbers = len(tensors) + shares_given
            tensors[MARCHED_AT] = PerGaussian(grey.new_zeros(len(grey), numbers), 0.0)  # at none that there is
        if drivers.up is None:
            return tensors
        if self.options.shadows:
            tensors[SUN_SEEN] = PerGaussian(grey.new_ones(len(grey), len(drivers.ways)), 0.0)
        if self.options.sky_view:
            tensors[SKY_SEEN] = PerGaussian(torch.ones_like(grey), 0.0)
        return tensors | surface_normals(seeds)

    def features(self, splats: Splats, query: Query) -> Tensor:
        if query.time_s is None:
            raise ValueError("a scene that changes needs the time at which it is seen: give time_s")
        celsius_above = self._temperature(splats, query) + celsius(self.reference_k).item()
        unit = self.range.bounds.to_unit(celsius_above)
        return clipped(unit, self.clip)[:, None]

    def temperature(self, splats: Splats, time_s: float, ids: Tensor | None = None) -> Tensor | None:
        return self._temperature(splats, Query(ids, time_s=time_s)) + self.reference_k.item()

    def temperatures(self, splats: Splats, times_s: Sequence[float], ids: Tensor | None = None) -> Tensor:
        if torch.is_grad_enabled():
            return super().temperatures(splats, times_s, ids)
        for time_s in (times_s[0], times_s[-1]):
            self._check_time(time_s)
        if self.options.linear:
            at = self.climate.linear_course(self._surface(splats, Query(ids)))
            found = torch.stack([at(time_s) for time_s in times_s])
        else:
            found = self._course_of(splats).temperatures(times_s, ids)
        return found + self.reference_k.item()

    def on_step(self, step: int) -> None:
        self._step = step

    def regularisers(self, splats: Splats) -> dict[str, Tensor]:
        if self.materials is None or self._step < self.materials_from or len(splats) == 0:
            return {}
        told = [splats[name] for name in OF_MATERIALS if name in splats]
        return {"materials": self.material_weight * self.materials(told)}

    def attributes(self, splats: Splats, query: Query) -> dict[str, Tensor]:
        """Time constant and, as far as they are simulated, heating by the sun, share of radiation and the wind's, how much of
        the sky is open and of the sun's beam arrives; and with the assumed emissivity absorptivity, convection at mean wind,
        heat capacity per area (of bodies without an end their effusivity), and the heat that a wall loses with its U-value,
        which are estimates (``physics.walls``)."""
        surface = self._surface(splats, query)
        if self.options.semi_infinite:
            # In which a step is followed by 1 - erfc(1) e = 0.57; of a rate it would be 0.63.
            values = {"settling_time_h": torch.exp(-surface.log_rate) / 3600.0}
        else:
            values = {"time_constant_h": torch.exp(-surface.log_rate) / 3600.0}
        if surface.core is not None:
            values["core_time_constant_h"] = torch.exp(-surface.core.log_rate) / 3600.0
            values["core_coupling"] = surface.core.coupling
        if self._sunlit:
            values["sun_k_per_kw_m2"] = surface.sun
        if surface.wind is not None:
            values["wind_share"] = surface.wind
        if surface.inner is not None:
            values["inner_rise_k"] = surface.inner
        if surface.transpires is not None:
            values["transpiration"] = surface.transpires
        if surface.exposure.sky is not None:
            values["sky_open"] = surface.exposure.sky
        if surface.exposure.sun is not None and query.time_s is not None:
            sample, _ = interval_of(self.climate.drivers.times_s, query.time_s)
            lit = surface.exposure.sun[:, self.climate.slots[sample]]
            shines = bool(
                (self.climate.drivers.beams[sample : sample + 2] != 0).any()
            )  # by night no direction is asked
            values["sunlit"] = lit if shines else torch.zeros_like(lit)
        if surface.share is not None:
            exchange = self._radiation() / surface.share
            values["radiation_share"] = surface.share
            values["convection_w_m2_k"] = exchange * (1 - surface.share)
            if self.options.semi_infinite:
                values["effusivity_j_m2_k_s05"] = exchange * torch.exp(-0.5 * surface.log_rate)
            else:
                values["areal_heat_capacity_kj_m2_k"] = exchange * torch.exp(-surface.log_rate) / 1000.0
            if self._sunlit:
                values["absorptivity"] = exchange * surface.sun / 1000.0
            if surface.inner is not None:
                values["heat_loss_w_m2"] = exchange * self.climate.mean_heat_from_within(surface)
                if self.options.indoor_c is not None:
                    values["mean_surface_c"] = self.climate.mean_temperature(surface) + celsius(self.reference_k).item()
        return values | self.quotients(values)

    def quotients(self, told: Mapping[str, Tensor]) -> dict[str, Tensor]:
        if "mean_surface_c" not in told:
            return {}
        return {"u_value_w_m2_k": u_value(told["heat_loss_w_m2"], self.options.indoor_c, told["mean_surface_c"])}

    def doubts(self) -> dict[str, Callable[[], AbstractContextManager[None]]]:
        """Convection that is given, which is known to ``convection_error``."""
        given = self._exchange_given and self.options.convection_error > 0
        return {"convection": self._more_convection} if given else {}

    @contextmanager
    def _more_convection(self) -> Iterator[None]:
        self._convection_factor = 1.0 + self.options.convection_error
        try:
            yield
        finally:
            self._convection_factor = 1.0

    def effects(self) -> dict[str, dict]:
        return dict(self.simulated)

    @property
    def cost(self) -> int:
        # Counted from the kernels: linear is 100 steps of the sun's sum and 4 cubics; corrected 190 steps of some 100 for each
        # Gaussian that is marched anew, one of six (300 steps on outdoor), and a sum of five products for all.
        return (LINEAR_COST if self.options.linear else MARCHED_COST) * self.options.nodes

    # The balance ----------------------------------------------------------------------------------------

    @property
    def _sunlit(self) -> bool:
        return self.climate.drivers.light is not None

    def _temperature(self, splats: Splats, query: Query) -> Tensor:
        """Temperature of the Gaussians in ``query.ids`` in kelvin above the reference, [n]."""
        self._check_time(query.time_s)
        if not self.options.linear and not torch.is_grad_enabled():
            return self._course_of(splats).temperatures([query.time_s], query.ids)[0]
        surface = self._surface(splats, query)
        if self.options.linear:
            return self.climate.linear_temperature(surface, query.time_s)
        if not self._kept.has(query.time_s, splats[MARCHED_AT]):
            return stepped_temperature(self.climate, surface, query.time_s)
        ids = torch.arange(len(splats), device=splats.means.device) if query.ids is None else query.ids
        given = [splats[name].detach() for name in GIVEN if name in splats]
        return self._kept.temperature(surface, query.time_s, ids, given, splats[MARCHED_AT].detach())

    def _check_time(self, time_s: float) -> None:
        """Raises SceneError where the record does not hold a moment."""
        times = self.climate.drivers.times_s
        first, last = float(times[0]), float(times[-1])
        if not first <= time_s <= last:
            raise SceneError(
                f"there is no weather for second {time_s:.6g}: the record runs from {first:.6g} to {last:.6g} s "
                "after the first training frame. Give a record that covers every moment that is asked for."
            )

    def _course_of(self, splats: Splats) -> Course:
        """The course of all Gaussians as they are now: that of the last view, unless something has changed since."""
        now = {name: splats[name].detach() for name in (*LEARNED, *GIVEN) if name in splats}
        now["convects"] = torch.tensor(self._convection_factor)
        if self._course is None or not all(torch.equal(now[name], was) for name, was in self._course[0].items()):
            course = Course(self.climate, self._surface(splats, Query()))
            self._course = {name: tensor.clone() for name, tensor in now.items()}, course
        return self._course[1]

    def _surface(self, splats: Splats, query: Query) -> Surface:
        def bounded(name: str, low: float, high: float) -> Tensor:
            return low + (high - low) * sigmoid(query.rows(splats[name]))

        def state(name: str) -> Tensor:
            return self.range.bounds.to_celsius(query.rows(splats[name])) - celsius(self.reference_k).item()

        def core() -> Core:
            coupling = query.rows(splats["log_coupling"]).clamp(*COUPLINGS).exp()
            return Core(state("initial_core"), query.rows(splats["log_core_rate"]).clamp(*LOG_RATES), coupling)

        drivers = self.climate.drivers
        for needed, name, what in ((self._sunlit, "raw_sun", "light"), (drivers.up is not None, NORMALS, "direction")):
            if needed and name not in splats:
                raise SceneError(
                    f"this weather tells the sun's {what}, of which there was none in training: leave its columns of sunlight "
                    "out, or train with it"
                )
        log_rate = query.rows(splats["log_rate"]).clamp(*LOG_RATES)
        if not self._exchange_given:
            share = bounded("raw_share", *SHARE_LIMITS) if drivers.sky is not None else None
            wind = bounded("raw_wind", *WIND_LIMITS) if drivers.wind_anomaly is not None else None
        else:
            share, wind = (torch.full_like(log_rate, value) for value in self._shares())
            wind = wind if self.options.windy else None
        return Surface(
            start=state("initial_state"),
            log_rate=log_rate,
            sun=bounded("raw_sun", 0.0, self._sun_limit) if self._sunlit else None,
            share=share,
            wind=wind,
            normals=query.normals(splats) if drivers.up is not None else None,
            exposure=Exposure(*(query.rows(splats[n].detach()) if n in splats else None for n in (SUN_SEEN, SKY_SEEN))),
            core=core() if self.options.nodes == 2 else None,
            inner=query.rows(splats["inner_rise"]) * self.range.bounds.span_k if self.options.inner else None,
            transpires=bounded("raw_transpires", 0.0, 1.0) if self.options.transpires else None,
        )

    def _shares(self) -> tuple[float, float]:
        """Radiation's share of the exchange at mean wind, and the wind's of convection, where convection is given."""
        still, per_wind = self.options.convection
        windy = per_wind * self.mean_wind.item() if self.options.windy else 0.0
        convection = (still + windy) * self._convection_factor
        radiation = self._radiation()
        return radiation / (radiation + convection), windy / (still + windy)

    def _radiation(self) -> float:
        """What a surface loses by radiation for each kelvin that it is warmer, in W/(m² K)."""
        return 4 * self.options.emissivity * STEFAN_BOLTZMANN * self.reference_k.item() ** 3

    @property
    def _exchange_given(self) -> bool:
        return self.options.convection is not None

    @property
    def _sun_limit(self) -> float:
        """Heating by the sun in K m²/kW of which surfaces have a share: where their exchange is given, that of a black one."""
        return self.sun_limit.item() if self._exchange_given else SUN_LIMIT

    def _first_sun(self, grey: Tensor) -> Tensor:
        """Heating by the sun, [N] in K m²/kW, at which level surfaces have the mean temperatures that images show."""
        drivers, share = self.climate.drivers, START_SHARE if self.climate.drivers.sky is not None else 0.0
        mean = partial(driver_means, drivers.times_s)
        light = drivers.light if drivers.beams is None else drivers.light + (drivers.beams @ drivers.up).clamp(min=0.0)
        excess = (self.range.bounds.to_celsius(grey) - celsius(self.reference_k).item()).double()
        loss = (1 - share) * (excess - mean(drivers.air))
        if share:
            loss = loss + share * (power_excess(excess, drivers.reference_k) - mean(drivers.sky))
        low, high = START_SUN
        if self._exchange_given:  # what heat from within does is not in this balance, and would count for the sun
            high = min(high, START_ABSORPTIVITY * self._sun_limit)
        return (loss / mean(light).clamp(min=1e-6)).clamp(low, high).to(grey)


def _live_on(model: EnergyBalance, _: Any) -> None:
    """Builds the tables anew after a checkpoint has brought the constants of its own weather."""
    if model._weather is not None:
        model.under(model._weather)
