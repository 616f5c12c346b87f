"""The heat balance as it stands, with T⁴ and gusts of wind, marched along the record for many moments at once.

``Climate`` in heatsplat.physics.energy_balance says what the symbols mean; the kernel is in heatsplat.kernels.marching. A
march passes the whole record whatever is asked of it, so that it is worth keeping. Who learns keeps temperatures and their
derivatives at the moments of all training frames (``Kept``): as long as parameters stay near those that were marched,
a temperature is a sum of few products. Who looks keeps the state at samples of the record (``Course``): the next frame goes
on from the sample before it.

**Error:** 0.2 mK against a stiff solver at the parameters that were marched, from sheet metal to wet ground under weather
every ten minutes; 2 mK where a gust of 10 m/s ends a calm between two samples, and up to 30 mK of bodies that follow air within
a minute and hardly radiate, under gusts three hours apart. Under rain it is 3 to 80 mK in the mean of a day, and up to 5 K for
the minutes in which a film of water breaks up on sheet metal in the sun. In float32 as in float64, with samples a second apart,
too. Between marches it is of second order in the change of parameters, 1.7 mK (root mean square) at 2 % of all of them and 10 mK
at 5 %, under rain 16 and 56 mK, as derivatives take water for given; ``Kept`` marches anew what has moved by more than CHANGE.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from heatsplat.kernels import marching as kernels
from heatsplat.kernels.heat_balance import Balance
from heatsplat.physics.energy_balance import Climate
from heatsplat.physics.responses import driver_means
from heatsplat.physics.surfaces import Surface
from heatsplat.physics.units import DAY_S

CHANGE = 0.05  # of a parameter, in its unit below, at which a surface is marched anew
UNITS = {
    "start": 40.0, "log_rate": 1.0, "share": 0.5, "sun": 40.0, "wind": 0.5, "inner": 40.0,  # K, 1, 1, K m²/kW, 1, K
    "core_start": 40.0, "core_log_rate": 1.0, "log_coupling": 1.0, "transpires": 0.5,  # K, 1, 1, 1
}  # fmt: skip
KEPT_BYTES = 4 << 30  # of tables of moments, the latest; earlier ones, which need more, are marched for every view
FORGOTTEN = 40.0  # time constants after which nothing is left of a start: 4e-18 of it, in twice as long as the mean balance says
STEEPEST = 0.5  # of radiation's slope at the reference, at 60 K below
COURSE_BYTES = 256 << 20  # of states at samples; what needs more keeps only some of the samples


def parameters(surface: Surface) -> dict[str, Tensor]:
    """What the kernel knows derivatives by, [n] each, of ``UNITS`` and in their order; without those of effects that are off."""
    found = {name: getattr(surface, name, None) for name in UNITS}
    if surface.core is not None:
        start, log_rate, coupling = surface.core
        found |= {"core_start": start, "core_log_rate": log_rate, "log_coupling": coupling.log()}
    return {name: value for name, value in found.items() if value is not None}


def with_parameters(surface: Surface, values: dict[str, Tensor]) -> Surface:
    """The surface with other ``parameters``, all of them."""
    own = {name: value for name, value in values.items() if name in surface._fields}
    if surface.core is not None:
        core = values["core_start"], values["core_log_rate"], values["log_coupling"].exp()
        own["core"] = surface.core._make(core)
    return surface._replace(**own)


def learned(surface: Surface) -> Tensor:
    """``parameters`` as columns, [n, Q]."""
    return torch.stack(list(parameters(surface).values()), dim=1)


def constants(surface: Surface, climate: Climate) -> list[Tensor]:
    """What else it knows of surfaces, [n, ...] each: water on them where it rains, and normals with their share of the sky."""
    found = []
    if climate.drivers.rain is not None:
        found.append((torch.zeros_like(surface.start) if surface.film is None else surface.film)[:, None])
    if surface.normals is not None:
        found += [surface.normals, climate.share_of_sky(surface)[:, None]]
    return [column.detach() for column in found]


def march(
    climate: Climate,
    surface: Surface,
    moments: Tensor,
    sensitive: bool = True,
    first: int = 0,
    into: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """Temperatures x of n surfaces at moments [F] of the record, with their derivatives by ``parameters`` behind: [F, n, 1 + Q].

    Args:
        moments: [F] float64, strictly increasing.
        sensitive: with derivatives; otherwise [F, n, 1], of bodies with a core with y behind, and where it rains with the mm of
            water on them behind that.
        first: sample of the record at which surfaces and cores have their ``start``, and surfaces their ``film``.
        into: a table [F, N, ...] and the rows [n] of it that are filled in place of a new one.
    """
    given, rest = learned(surface).detach(), constants(surface, climate)
    order = given[:, kernels.LOG_RATE].argsort()  # neighbours take as many substeps
    columns = torch.cat((given, *(column.to(given) for column in rest)), dim=1)
    rained = climate.drivers.rain is not None
    width = 1 + given.shape[1] if sensitive else 1 + (surface.core is not None) + rained
    table, rows = into if into is not None else (given.new_empty(len(moments), len(given), width), None)
    own = rows[order] if rows is not None else order
    here = table if table.device.type == "cpu" else table.new_empty(len(moments), len(given), width, device="cpu")
    numbered = own if here is table else torch.arange(len(own))
    if len(own):
        has = [value is not None for value in (surface.share, surface.sun, surface.wind, surface.normals)]
        has += [surface.exposure.sun is not None, climate.drivers.ground is not None]
        has += [surface.inner is not None, surface.core is not None, rained, surface.transpires is not None]
        seen = given.new_empty(len(given), 0) if surface.exposure.sun is None else surface.exposure.sun.to(given)
        kernels.march(
            Balance(*has, sensitive),
            first,
            columns[order].cpu().contiguous().numpy(),
            seen[order].detach().cpu().contiguous().numpy(),
            climate.slots.numpy(),
            numbered.cpu().numpy(),
            climate.drivers.times_s.numpy(),
            climate.rows.numpy(),
            climate.drivers.reference_k,
            0.0 if climate.drivers.room is None else 1.0 / climate.drivers.room,
            climate.drivers.holds_mm,
            moments.contiguous().numpy(),  # a kernel is compiled for each layout
            here.numpy(),
        )
    if here is not table:
        table[:, own] = here.to(table.device)
    return table


def remembered_from(climate: Climate, surface: Surface, moment_s: Tensor) -> Tensor:
    """From which sample of the record on surfaces [n] have to be marched for a moment: what came before they have forgotten, and
    any start will do. One of few samples (1, 2, 4, ... days before), so that many surfaces share one."""
    times, wind = climate.drivers.times_s, climate.drivers.wind_anomaly
    rate = surface.log_rate.detach().double().exp()
    found = torch.zeros(len(rate), dtype=torch.int64, device=rate.device)
    days = 1.0
    while (since := float(moment_s) - days * DAY_S) > float(times[0]):
        sample = int(torch.searchsorted(times, since, right=True)) - 1
        last = int(torch.searchsorted(times, moment_s, right=True)) - 1
        if last <= sample:
            break
        exchange = torch.ones_like(rate)
        if surface.wind is not None and wind is not None:
            mean = float(driver_means(times[sample : last + 1], wind[sample : last + 1]))
            exchange = exchange + surface.wind.detach().double() * mean
        if surface.share is not None:
            share = surface.share.detach().double()
            exchange = (1.0 - share) * exchange + STEEPEST * share
        if surface.core is not None:  # the slower of two decays is no slower than this
            following = (surface.core.log_rate.detach().double().exp() / rate).clamp_min(1e-300)
            coupling = surface.core.coupling.detach().double()
            exchange = exchange * following / (exchange + coupling + following)
        passed = float(times[last] - times[sample])
        found = torch.where((found == 0) & (rate * exchange * passed > FORGOTTEN), sample, found)
        days *= 2.0
    return found


def stepped_temperature(climate: Climate, surface: Surface, time_s: float) -> Tensor:
    """Temperature x at a moment of the record by the full balance, marched from its beginning, [n].

    It is differentiable but by normals, which images decide.

    Raises:
        ValueError: the bodies have no end, which only ``Climate.linear_temperature`` knows.
    """
    if climate.semi_infinite:
        raise ValueError("bodies without an end are solved about a mean only: use linear_temperature")
    found = march(climate, surface, torch.tensor([time_s], dtype=torch.float64))[0]
    return _first_order(found, learned(surface), learned(surface).detach())


def _first_order(found: Tensor, now: Tensor, then: Tensor) -> Tensor:
    """Temperatures [n] at parameters ``now`` from those marched at ``then``, both [n, Q], found [n, 1 + Q]."""
    return found[:, 0] + (found[:, 1:] * (now - then)).sum(1)


def rows_of(surface: Surface, ids: Tensor) -> Surface:
    """Some of n surfaces."""
    own = {name: value[ids] for name, value in surface._asdict().items() if isinstance(value, Tensor)}
    exposure = surface.exposure._make(None if value is None else value[ids] for value in surface.exposure)
    core = surface.core if surface.core is None else surface.core._make(value[ids] for value in surface.core)
    return surface._replace(**own, exposure=exposure, core=core)


def unchanged(before: Sequence[tuple[Tensor, int]], now: Sequence[Tensor]) -> bool:
    """Whether these are the tensors of ``before``, each with the version that it had, and nobody wrote to them since."""
    return len(before) == len(now) and all(
        tensor.data_ptr() == was.data_ptr() and tensor.shape == was.shape and tensor._version == version
        for (was, version), tensor in zip(before, now, strict=True)
    )


class Kept:
    """Temperatures of all N surfaces at the moments that training asks for, with their derivatives.

    Where memory does not hold all moments, it holds the latest: to march to one of the others takes as long as it is from the
    start. How many depends on nothing but KEPT_BYTES, or a run that goes on elsewhere would not find the same bits.

    A surface is marched when it is first asked for and whenever a parameter has moved since by more than CHANGE. At which
    parameters is told by ``marched_at``, which belongs to the Gaussians: a run that goes on from a checkpoint marches at the same
    parameters and finds the same bits, and what a split makes of one inherits them.
    """

    def __init__(self, climate: Climate, moments_s: Tensor) -> None:
        self.climate, self.moments_s = climate, moments_s
        self._places = {time: number for number, time in enumerate(moments_s.tolist())}
        self._marched_at: Tensor | None = None
        self._given: list[tuple[Tensor, int]] = []
        self._known: Tensor | None = None
        self._table: Tensor | None = None

    def has(self, time_s: float, marched_at: Tensor) -> bool:
        """Whether a moment is one of those kept, for surfaces [N, Q] that were marched last at these parameters."""
        return self._places.get(time_s, -1) >= self._first(marched_at)

    def _first(self, marched_at: Tensor) -> int:
        """Number of the first moment that is kept: that and all after it fit in memory."""
        size = len(marched_at) * (1 + marched_at.shape[1]) * marched_at.element_size()
        return max(0, len(self.moments_s) - KEPT_BYTES // max(size, 1))

    @torch.no_grad()
    def _refresh(self, surface: Surface, now: Tensor, ids: Tensor, given: Sequence[Tensor], marched_at: Tensor) -> None:
        """Marches those of ``ids`` that have moved, or that came, were turned or shaded since."""
        same = self._marched_at is not None and torch.equal(self._marched_at, marched_at)
        moments_s = self.moments_s[self._first(marched_at) :]
        if not same or not unchanged(self._given, given):
            if self._table is None or self._table.shape[1] != len(marched_at):
                self._table = None  # two of them may not fit
                self._table = now.new_empty(len(moments_s), len(marched_at), 1 + now.shape[1])
            self._known = torch.zeros(len(marched_at), dtype=torch.bool, device=now.device)
            self._marched_at = marched_at.detach().clone()
            self._given = [(tensor, tensor._version) for tensor in given]
        names = list(parameters(surface))
        unit = now.new_tensor([UNITS[name] for name in names])
        moved = ((now - self._marched_at[ids]).abs() > CHANGE * unit).any(1)
        for place in (marched_at, self._marched_at):
            place[ids[moved]] = now[moved]
        stale = (moved | ~self._known[ids]).nonzero()[:, 0]
        if len(stale):
            rows = ids[stale]
            columns = dict(zip(names, self._marched_at[rows].unbind(1), strict=True))
            there = with_parameters(rows_of(surface, stale), columns)
            first = remembered_from(self.climate, there, self.moments_s[0])
            for sample in first.unique().tolist():
                alike = (first == sample).nonzero()[:, 0]
                march(self.climate, rows_of(there, alike), moments_s, first=sample, into=(self._table, rows[alike]))
            self._known[rows] = True

    def temperature(
        self, surface: Surface, time_s: float, ids: Tensor, given: Sequence[Tensor], marched_at: Tensor
    ) -> Tensor:
        """Temperature x [n] of the surfaces ``ids`` [n] of N at one of the moments; differentiable but by normals.

        Args:
            surface: of those ids.
            given: what else decides of all N and is not learned, such as normals and shadows.
            marched_at: [N, Q] parameters at which each was marched last, which this keeps up to date.
        """
        now = learned(surface)
        self._refresh(surface, now.detach(), ids, given, marched_at)
        place = self._places[time_s] - self._first(marched_at)
        found = self._table[place].index_select(0, ids)
        return _first_order(found, now, self._marched_at.index_select(0, ids))


class Course:
    """The course of N surfaces at fixed parameters, marched as far as it was asked for.

    Args:
        climate: the record.
        surface: of all N, whose tensors nobody changes.
    """

    def __init__(self, climate: Climate, surface: Surface) -> None:
        self.climate, self.surface = climate, surface
        state = [surface.start] if surface.core is None else [surface.start, surface.core.start]
        if climate.drivers.rain is not None:
            state.append(torch.zeros_like(surface.start) if surface.film is None else surface.film)
        self._states = [torch.stack(state, dim=1)]
        self._every = math.ceil(len(climate.drivers.times_s) * self._states[0].nbytes / COURSE_BYTES)

    def _from(self, number: int) -> Surface:
        """The surfaces as they are at one of the states that are kept."""
        start, *behind = self._states[number].unbind(1)
        core = None if self.surface.core is None else self.surface.core._replace(start=behind.pop(0))
        return self.surface._replace(start=start, core=core, film=behind[0] if behind else None)

    def temperatures(self, times_s: Sequence[float], ids: Tensor | None = None) -> Tensor:
        """Temperatures x [T, n] at increasing moments of the record, of all or of the surfaces ``ids``."""
        record = self.climate.drivers.times_s
        moments = torch.tensor(times_s, dtype=torch.float64)
        samples = torch.searchsorted(record, moments, right=True).clamp(1, len(record) - 1) - 1
        wanted = samples // self._every
        self._keep(int(wanted[-1]))
        # A march passes all between its moments; where that is more than one state, it begins anew.
        apart = (wanted.diff() > 1).nonzero()[:, 0] + 1
        found = []
        for some, states in zip(moments.tensor_split(apart), wanted.tensor_split(apart), strict=True):
            state = int(states[0])
            now = self._from(state) if ids is None else rows_of(self._from(state), ids)
            found.append(march(self.climate, now, some, False, state * self._every)[:, :, 0])
        return torch.cat(found)

    def _keep(self, number: int) -> None:
        """Marches as far as that state."""
        last, times = len(self._states) - 1, self.climate.drivers.times_s
        if number > last:
            moments = times[last * self._every :: self._every][1 : number - last + 1]
            self._states += list(march(self.climate, self._from(last), moments, False, last * self._every))
