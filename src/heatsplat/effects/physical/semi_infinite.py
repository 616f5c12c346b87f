"""Massive walls and ground that the record does not heat through."""

from __future__ import annotations

from heatsplat.effects import weather_record
from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.weathered import CHANCE, MIN_DB, NO_BALANCE, NOTHING_DB, SIGMAS

# Such bodies are solved about their mean, have no core and stay dry: what the evidence on radiation would choose beside them.
SOLVED = {"solution": "linear", "nodes": 1, "rain": None, "transpires": False}
# Standard errors by which a core, which has more numbers, has to do worse: what heat reaches the end of has one, and where that
# shows no difference a core says as much. Of thick stone 1.6 to 3.1, of layered walls -0.1 to 0.4.
WORSE = 1.0


def evidence(inspected: Inspection) -> Evidence:
    """Whether bodies without an end explain images better, that they were not fitted to, than bodies of one rate do, with as
    many numbers; and bodies with a core, which have more, worse.

    Where T⁴ is bent over the span of temperatures nothing is asked: solving that as it stands is worth more (docs/results.md).
    """
    weathered = inspected.weathered
    if weathered is None:
        return Evidence(None, inspected.obs.why or NO_BALANCE, SOLVED, told=False)
    if weather_record.bent(inspected.obs):
        return Evidence(
            0.0, "T⁴ is bent over the span of temperatures, and such bodies are solved about their mean", SOLVED
        )
    gain, of_a_core = weathered.endless
    found = f"they gain {gain.db:.2f} dB over bodies of one rate where left out, {gain.sigmas:.1f} standard errors"
    if of_a_core.exceeds(MIN_DB, SIGMAS):
        return Evidence(0.0, f"{found}, and bodies with a core {of_a_core.db:.2f} dB over them", SOLVED)
    if gain.exceeds(MIN_DB, SIGMAS):
        if of_a_core.sigmas < -WORSE and of_a_core.db < -MIN_DB:
            return Evidence(gain.sigmas, found, SOLVED, gain_db=gain.db)
        found = f"{found}, but bodies with a core do as well ({of_a_core.db:+.2f} dB)"
        return Evidence(SIGMAS, found, SOLVED, told=False, gain_db=gain.db)
    nothing = gain.sigmas < CHANCE or gain.db < NOTHING_DB
    found = found if nothing else f"{found}: too few to tell"
    return Evidence(min(max(gain.sigmas, 0.0), SIGMAS), found, SOLVED, told=nothing, gain_db=gain.db)


EFFECT = Effect(
    name="semi_infinite",
    stage="state",
    place=2,
    summary="massive walls and ground, whose surface responds with the square root of time",
    source="Carslaw and Jaeger, Conduction of Heat in Solids, 2.7",
    needs=frozenset({"time", "thermal_range", "weather"}),
    null="surfaces follow the weather with one time constant, or with a second one for a core",
    threshold=SIGMAS,
    adds="no parameter: effusivity over exchange replaces the rate; a mean over rates in the tables",
    evidence=evidence,
    part=Part("state", "energy_balance", off={"semi_infinite": False}),
    stands_on="relaxation",
    displaces=weather_record.INSTEAD,
)
