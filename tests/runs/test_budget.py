"""Budget in, recipe out: what is understood, planned, kept while training, measured and written."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import pytorch_lightning as pl
import running
import torch

from heatsplat.callbacks.budget import BudgetClock
from heatsplat.callbacks.timing import CostMeter
from heatsplat.composition import compose
from heatsplat.contracts import SceneData, SceneError
from heatsplat.density.budget import Budget
from heatsplat.io.results import RunResults
from heatsplat.runs.budget import CALIBRATION_SHARE, Pace, Plan, _denser, open_points, plan, seconds_of
from heatsplat.runs.curves import (
    CURVES_FILE,
    Choice,
    Curve,
    Outlook,
    Point,
    curves_of,
    merged,
    read_points,
    write_points,
)
from heatsplat.runs.lock import OccupiedError
from heatsplat.runs.resume import resumed
from heatsplat.runs.run import begin
from heatsplat.training.module import SplatTraining
from heatsplat.training.schedule import Schedule

FREE = math.inf
# With many Gaussians a run is better in the end and worse at first, and each of its steps costs more.
POINTS = [
    Point("etgs", "heated", steps, growth, mean_growth, psnr)
    for growth, mean_growth, scores in ((1.0, 1.0, (20, 24, 26)), (FREE, 4.0, (18, 26, 32)))
    for steps, psnr in zip((250, 1000, 4000), scores, strict=True)
]
HEATED = curves_of(POINTS)["etgs", "heated"]
PACE = Pace(base_s=0.004, per_gaussian_s=1e-6, points=4000, spent_s=1.0)  # 8 ms with the points of the start


# Asking ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "seconds"), [(120, 120), ("120s", 120), ("2min", 120), ("1.5 h", 5400), (".5m", 30), ("90 sec", 90)]
)
def test_a_budget_is_read_as_people_write_it(text, seconds):
    assert seconds_of(text) == seconds


@pytest.mark.parametrize("text", ["soon", "0s", "-5s", "12 parsecs", "s", "1:30", "nan"])
def test_what_is_no_time_is_refused_with_the_remedy(text):
    with pytest.raises(SceneError, match=r"is no time; write seconds, or a number with s, min or h"):
        seconds_of(text)


# Curves ----------------------------------------------------------------------------------------------------------------


def test_a_curve_passes_through_its_points_and_gains_less_and_less_beyond_them():
    curve = Curve(tuple(point for point in POINTS if point.growth == FREE))
    assert [curve.psnr(steps) for steps in (250, 1000, 4000)] == [18, 26, 32]
    assert curve.psnr(500) == pytest.approx(22)  # log steps
    gains = [curve.psnr(4000 * 2 ** (i + 1)) - curve.psnr(4000 * 2**i) for i in range(8)]
    assert all(0 < later < earlier for earlier, later in zip(gains, gains[1:], strict=False))
    slope = 3.0  # dB per doubling between the last two
    assert gains[0] < slope and sum(gains) < slope / math.log(2)
    assert (curve.psnr(4001) - 32) / math.log2(4001 / 4000) == pytest.approx(slope, rel=1e-3)


# Half of the price from 1000 steps on, and better in the end.
COARSE = ("density=budget", "schedule=coarse_to_fine")
CHEAP = [
    replace(point, settings=COARSE, cost=cost, psnr=point.psnr + 1)
    for point, cost in zip(POINTS[3:], (0.75, 0.5, 0.5), strict=True)
]


def test_points_survive_their_file_and_a_bad_one_is_named(tmp_path):
    points = [*reversed(POINTS), *CHEAP, replace(POINTS[0], settings=("thermal.frequencies=8",), cost=0.9)]
    write_points(points, tmp_path / "curves.csv")
    assert sorted(read_points(tmp_path / "curves.csv"), key=str) == sorted(points, key=str)
    head = (tmp_path / "curves.csv").read_text().partition("\n")[0]
    assert head.endswith(",decay,cost,density,schedule,thermal.frequencies")


@pytest.mark.parametrize(
    "text",
    [
        None,
        "",
        "method,steps\netgs,ten\n",
        "{header}",
        "{header}etgs,heated,0,inf,1,20,1,1,1\n",
        "{header}etgs,heated,9,inf,1,20,1,1,0\n",
        "{header}" + 2 * "etgs,heated,9,inf,1,20,1,1,1\n",  # between which nothing is straight
        b"\0\xff".decode("latin-1"),
    ],
)
def test_a_file_without_curves_is_named_with_the_remedy(tmp_path, text):
    if text is not None:
        header = "method,scene,steps,growth,mean_growth,psnr,seeds,decay,cost\n"
        (tmp_path / "bad.csv").write_text(text.replace("{header}", header))
    with pytest.raises(
        SceneError, match=r"bad.csv holds no curves.*study=budget.*study.curves=FILE.*budget_curves=FILE"
    ):
        read_points(tmp_path / "bad.csv")


def test_points_measured_anew_take_the_place_of_their_like_and_of_no_others(tmp_path):
    kept = [replace(POINTS[0], growth=2.0 / 3.0), *POINTS]
    write_points(kept, tmp_path / "curves.csv")
    anew = [replace(POINTS[0], growth=2.0 / 3.0, psnr=30.0, seeds=3), replace(POINTS[1], decay=0.25)]
    points = merged(read_points(tmp_path / "curves.csv"), anew)
    assert len(points) == len(kept) + 1
    assert [point.psnr for point in points if point.growth < 1.0] == [30.0]  # rounded in the file, and the same


def test_the_curves_of_the_repository_rise_with_the_steps():
    points = read_points(CURVES_FILE)
    assert {"etgs", "3dgs"} <= {point.method for point in points}
    for method in ("etgs", "3dgs"):
        own = curves_of(point for point in points if point.method == method)
        for curve in [curve for choices in own.values() for curve in choices.values()]:
            scores = [point.psnr for point in curve.points]
            assert scores == sorted(scores) and all(point.mean_growth >= 0.5 for point in curve.points)


# Planning --------------------------------------------------------------------------------------------------------------


def seconds_for(found: Plan) -> float:
    """What a plan's steps take at PACE by its curve."""
    curve = HEATED[Choice(found.growth or FREE, 1.0)]
    return found.steps * PACE.step_s(PACE.points * curve.mean_growth(found.steps))


@pytest.mark.parametrize("asked", [5.0, 10.0, 30.0, 120.0, 1000.0])
def test_the_steps_of_a_plan_take_the_time(asked):
    found = plan(POINTS, "etgs", PACE, asked, cap_max=100_000)
    assert found.train_s == asked - 1.0
    assert seconds_for(found) == pytest.approx(found.train_s, rel=0.01)


def test_the_plan_is_the_best_of_all_choices_in_the_time():
    for asked in (5.0, 10.0, 20.0, 60.0):
        found = plan(POINTS, "etgs", PACE, asked, cap_max=100_000)
        rivals = [
            curve.psnr(steps)
            for curve in HEATED.values()
            for steps in range(100, 20_000, 50)
            if steps * PACE.step_s(4000 * curve.mean_growth(steps)) <= found.train_s
        ]
        assert found.expected_psnr == pytest.approx(max(rivals), abs=0.05)


def test_little_time_takes_few_gaussians_and_much_time_many():
    short, long = (plan(POINTS, "etgs", PACE, asked, cap_max=100_000) for asked in (5.0, 120.0))
    assert (short.cap, short.growth) == (4000, 1.0)
    assert (long.cap, long.growth) == (100_000, None) and long.steps > short.steps
    assert plan(POINTS, "etgs", PACE, 120.0, cap_max=9000).cap == 9000  # what the configuration allows


def test_short_runs_keep_their_learning_rates_and_long_ones_let_them_fall():
    slow = [replace(point, decay=0.25, psnr=point.psnr + 3 - 1.5 * i) for i, point in enumerate(POINTS[:3])]
    points = POINTS[:3] + slow  # 3 dB better after 250 steps, none after 4000
    short, long = (plan(points, "etgs", PACE, asked, cap_max=100_000) for asked in (4.0, 300.0))
    assert (short.decay, long.decay) == (0.25, 1.0)
    assert "25% of the decay of learning rates" in short.lines()[0]
    kept = plan(points, "etgs", PACE, 4.0, cap_max=100_000, free_decay=False)
    assert kept.decay is None and kept.expected_psnr < short.expected_psnr
    assert "decay" not in kept.lines()[0]


EASY = [replace(point, method="3dgs", scene="static", psnr=point.psnr + 6, mean_growth=1.0) for point in POINTS]
KEPT = [replace(point, decay=0.25, psnr=point.psnr + 3 - 1.5 * (i % 3)) for i, point in enumerate(POINTS)]


def test_a_choice_counts_by_what_it_gains_and_not_by_the_scene_that_measured_it():
    outlook = Outlook([*EASY, *POINTS, *KEPT])
    assert set(outlook.choices) == {Choice(growth, decay) for growth in (1.0, FREE) for decay in (0.25, 1.0)}
    assert outlook.usual == Choice(FREE, 1.0)
    for steps, gain in ((250, 3.0), (1000, 1.5), (4000, 0.0)):  # of heated, the harder scene
        for growth in (1.0, FREE):
            usual = outlook.psnr(Choice(growth, 1.0), steps)
            assert usual == pytest.approx(HEATED[Choice(growth, 1.0)].psnr(steps) + 3)
            assert outlook.psnr(Choice(growth, 0.25), steps) == pytest.approx(usual + gain)
            counts = [outlook.mean_growth(Choice(growth, decay), steps) for decay in (0.25, 1.0)]
            assert counts == pytest.approx(2 * [2.5 if growth == FREE else 1.0])  # heated has 4, static 1
    assert outlook.missing(Choice(1.0, 0.25)) == ["3dgs/static"] and outlook.missing(Choice(1.0, 1.0)) == []
    assert Outlook(reversed([*EASY, *POINTS, *KEPT])).psnr(Choice(1.0, 0.25), 700) == outlook.psnr(
        Choice(1.0, 0.25), 700
    )


def test_gaussians_that_no_scene_measured_stay_within_their_cap():
    capped = [replace(point, growth=2.0, mean_growth=1.8) for point in EASY[3:]]  # where 1 is the mean of the free ones
    outlook = Outlook([*EASY, *POINTS, *capped])
    assert outlook.mean_growth(Choice(2.0, 1.0), 1000) == pytest.approx((1.8 + 2.0) / 2)


def test_a_single_length_says_nothing_of_others():
    lucky = replace(POINTS[5], growth=6.0, psnr=40.0)
    assert Choice(6.0, 1.0) not in Outlook([*POINTS, lucky]).choices
    assert Outlook([lucky]).psnr(Choice(6.0, 1.0), 300) == 40.0  # better than nothing


def test_methods_without_curves_choose_among_all_that_was_measured():
    points = [*EASY, *POINTS, *KEPT]
    short, long = (plan(points, "ravigs", PACE, asked, cap_max=100_000) for asked in (4.0, 300.0))
    assert (short.decay, long.decay) == (0.25, 1.0)
    assert any("not measured on 3dgs/static; what it gains elsewhere stands in" in reason for reason in short.reasons)
    assert not any("not measured on" in reason for reason in long.reasons)
    least = [replace(point, growth=0.5) for point in EASY[:3]]  # at decay 1 only: it would tell nothing of the decay
    fixed = plan([*points, *least], "ravigs", PACE, 4.0, cap_max=None)
    assert (fixed.cap, fixed.decay) == (None, 0.25)


@pytest.mark.parametrize("method", ["ravigs", "ti3dgs"])
def test_every_choice_of_the_repository_is_open_to_methods_without_curves(method):
    points = [point for point in read_points(CURVES_FILE) if point.method != method]
    usual = {(point.method, point.scene) for point in points if point.choice == Choice(3.0, 1.0)}
    compared = {point.choice for point in points if (point.method, point.scene) in usual}  # haze starts from 500 points
    assert set(Outlook(points).choices) == compared
    for asked in (10.0, 30.0):  # to stay with the Gaussians of the start would cost 3 to 5 dB
        assert plan(points, method, PACE, asked, cap_max=100_000).growth > 1.0


def test_settings_are_chosen_where_they_are_worth_their_price():
    found = plan([*POINTS, *CHEAP], "etgs", PACE, 60.0, cap_max=100_000)
    assert found.settings == COARSE and ", density=budget, schedule=coarse_to_fine for 60 s" in found.lines()[0]
    curve = curves_of(CHEAP)["etgs", "heated"][Choice(FREE, 1.0, COARSE)]
    seconds = found.steps * PACE.step_s(4000 * curve.mean_growth(found.steps)) * curve.cost(found.steps)
    assert seconds == pytest.approx(59.0, rel=0.01)
    dear = [replace(point, cost=4.0) for point in CHEAP]
    assert plan([*POINTS, *dear], "etgs", PACE, 60.0, cap_max=100_000).settings == ()
    assert [curve.cost(steps) for steps in (10, 250, 500, 1000, 10**6)] == pytest.approx([0.75, 0.75, 0.625, 0.5, 0.5])
    assert Outlook([*CHEAP, *POINTS[3:]]).usual == Choice(FREE, 1.0)  # of as many scenes, that with nothing set
    assert Plan.from_dict(json.loads(json.dumps(found.as_dict()))) == found


def test_settings_are_open_to_runs_that_leave_them_open():
    """What the command line gives stays, and so does what a method has of its own."""
    model = [replace(point, settings=("thermal.frequencies=8",)) for point in POINTS]
    points = [*POINTS, *CHEAP, *model]

    def settings(method: str, *overrides: str) -> set[tuple[str, ...]]:
        return {point.settings for point in open_points(points, method, [f"method={method}", *overrides])}

    assert settings("etgs") == {(), COARSE, model[0].settings}
    assert settings("etgs", "density.views=5") == settings("etgs", "schedule=off") == {(), model[0].settings}
    assert settings("etgs", "thermal.frequencies=24") == {(), COARSE}
    assert settings("3dgs") == {(), COARSE}  # knows no frequencies
    assert settings("ravigs") == {()}  # a density of its own
    own = [replace(point, method="ravigs") for point in CHEAP]
    assert len(open_points(own, "ravigs", ["method=ravigs"])) == 3  # measured with the method itself


def test_twice_the_time_is_what_a_plan_for_it_would_choose():
    found = plan(POINTS, "etgs", replace(PACE, spent_s=0.0), 20.0, cap_max=100_000)
    twice = plan(POINTS, "etgs", replace(PACE, spent_s=0.0), 40.0, cap_max=100_000)
    assert found.twice_steps == twice.steps
    assert (
        found.twice_gain_db == pytest.approx(twice.expected_psnr - found.expected_psnr, abs=0.011)
        and found.twice_gain_db > 0
    )
    assert f"{found.twice_gain_db:+.2f} dB" in found.twice() and "40 s" in found.twice()


@pytest.mark.parametrize("spent_s", [0.05, 0.6])
@pytest.mark.parametrize("slower", [1.0, 1.2])
def test_too_little_time_is_refused_with_what_is_accepted(spent_s, slower):
    """The next start measures anew: its calibration takes its share or its fewest steps, and all may be slower then."""
    told = r"budget=0.5s is too short here: 100 steps .* take (\S+) s .* Give budget=(\S+)s, which"
    with pytest.raises(SceneError, match=told) as caught:
        plan(POINTS, "etgs", replace(PACE, spent_s=spent_s), 0.5, cap_max=100_000)
    least, enough = map(float, re.search(told, str(caught.value)).groups())
    again = Pace(slower * PACE.base_s, slower * PACE.per_gaussian_s, PACE.points)
    again = replace(again, spent_s=max(CALIBRATION_SHARE * enough, slower * spent_s))
    assert plan(POINTS, "etgs", again, enough, cap_max=100_000).steps >= 100
    assert least < enough < 1.3 * least + 0.1


def test_the_least_time_is_not_planned_for_what_takes_more():
    """What scores best in fewer steps than a run has at least takes more time for these."""
    cheap = replace(CHEAP[0], growth=1.0, mean_growth=1.0, psnr=20.0, settings=(), cost=1.0)
    dear = replace(cheap, growth=8.0, mean_growth=8.0, psnr=30.0)
    points = [replace(one, steps=one.steps * k, psnr=one.psnr + k) for one in (cheap, dear) for k in (1, 2)]
    pace = Pace(0.001, 1e-5, 1000, 0.0)
    least = 100 * pace.step_s(1000)
    found, later = (plan(points, "etgs", pace, asked, cap_max=10**6) for asked in (least, 8 * least))
    assert (found.growth, found.steps, later.growth) == (1.0, 100, 8.0)


def test_what_was_not_measured_is_said():
    other = plan(POINTS, "ravigs", PACE, 30.0, cap_max=100_000)
    assert other.expected_psnr is None and "ravigs has no measured curves; those of etgs stand in" in other.reasons[0]
    assert other.steps == plan(POINTS, "etgs", PACE, 30.0, cap_max=100_000).steps
    fixed = plan(POINTS, "etgs", PACE, 30.0, cap_max=None)
    assert fixed.cap is None and fixed.steps == round(29.0 / PACE.step_s(4000))
    assert any("no Gaussians" in reason for reason in fixed.reasons)
    assert any("were not measured" in reason for reason in plan(POINTS, "etgs", PACE, 3000.0, cap_max=10**6).reasons)
    with pytest.raises(SceneError, match="no measured curves to plan from; run python src/study.py study=budget"):
        plan([], "etgs", PACE, 30.0, cap_max=None)


def test_a_plan_survives_a_checkpoint():
    found = plan(POINTS, "ravigs", PACE, 30.0, cap_max=100_000)
    assert Plan.from_dict(json.loads(json.dumps(found.as_dict()))) == found


# Keeping it ------------------------------------------------------------------------------------------------------------


class Clock(CostMeter):
    """A cost meter whose seconds the test sets."""

    now = 0.0

    @property
    def train_seconds(self):
        return self.now


def a_module(steps: int = 1000):
    """What the clock asks of a training module."""
    density = Budget(start=20, stop=480, every=50, cap_max=9000, multiple=None, remove_at=[480])
    return SimpleNamespace(schedule=Schedule(steps), density=density, splats=range(4000), results=RunResults())


def simulate(clock: BudgetClock, step_s, meter: Clock | None = None, module=None, first: int = 0, until: int = 10**6):
    """Runs a trainer's loop without training; ``step_s(step)`` is what a step takes. Returns (trainer, module)."""
    meter = meter or Clock()
    module = module or a_module()
    trainer = SimpleNamespace(callbacks=[meter, clock], global_step=first, rates=[])
    clock.on_train_start(trainer, module)
    while trainer.global_step < min(module.schedule.end, until):
        meter.now += step_s(trainer.global_step)
        trainer.global_step += 1
        trainer.rates.append(0.01 ** module.schedule.progress(trainer.global_step))
        clock.on_train_batch_end(trainer, module)
    clock.on_train_end(trainer, module)
    return trainer, module


def a_clock(seconds: float = 9.0, steps: int = 1000, **changed: float) -> BudgetClock:
    found = plan(POINTS, "etgs", replace(PACE, spent_s=0.5), seconds + 0.5, cap_max=100_000)
    return BudgetClock(replace(found, **{"steps": steps, "gaussians": 4000.0} | changed).as_dict(), found.twice())


@pytest.mark.parametrize("factor", [0.2, 0.7, 1.0, 1.3, 1.8])
def test_a_misjudged_pace_still_ends_in_time_with_its_schedule_done(factor):
    clock = a_clock()
    trainer, module = simulate(clock, lambda step: factor * 9.0 / 1000)
    found = module.results.run["budget"]
    assert abs(found["off_percent"]) < 2 and found["schedule_done"] > 0.99
    assert found["steps"] == pytest.approx(1000 / factor, rel=0.02)
    assert trainer.rates[-1] == pytest.approx(0.01, rel=0.1)
    assert all(later <= earlier for earlier, later in zip(trainer.rates, trainer.rates[1:], strict=False))
    falls = [earlier / later for earlier, later in zip(trainer.rates, trainer.rates[1:], strict=False)]
    assert max(falls) < 1.05  # no jump


def test_a_machine_that_becomes_ten_times_slower_late_is_noticed_at_once():
    _, module = simulate(a_clock(), lambda step: (0.9 if step < 750 else 9.0) * 9.0 / 1000)
    found = module.results.run["budget"]
    assert abs(found["off_percent"]) < 2 and found["schedule_done"] > 0.97 and 750 < found["steps"] < 800


def test_a_well_judged_pace_changes_nothing():
    trainer, _ = simulate(a_clock(), lambda step: 9.0 / 1000)
    assert trainer.global_step == 1000
    assert trainer.rates == pytest.approx([0.01 ** (step / 1000) for step in range(1, 1001)], rel=1e-3)


# Evenly to 9,000 in half of the run.
GROWING = {"step_ms": 5.0, "gaussian_us": 1.25, "points": 4000, "gaussians": 7800.0}


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.6, 3.0])
def test_a_slower_machine_makes_fewer_steps_with_as_many_gaussians(factor):
    module = a_module()

    def step_s(step: int) -> float:
        density, count = module.density, len(module.splats)
        if density._growth_in(step) == 0:
            module.splats = range(count + round(density._share(step) * (density.cap_max - count)))
        return factor * (9.0 / 1000) * (5.0 + 1.25e-3 * (count - 4000)) / 9.75

    trainer, module = simulate(a_clock(**GROWING), step_s, module=module)
    found = module.results.run["budget"]
    assert abs(found["off_percent"]) < 2 and found["schedule_done"] > 0.98
    assert found["steps"] == pytest.approx(1000 / factor, rel=0.2)  # the first tenth, as planned, has few Gaussians
    assert len(module.splats) == 9000 and module.density.stop == pytest.approx(0.48 * trainer.global_step, rel=0.2)
    assert (found["moved_at_step"] is None) == (factor == 1.0)


@pytest.mark.parametrize(
    ("counts", "dearer"),
    [((4000, 4000), 9.75 / 5.0), ((5000, 7000), 10.6875 / 7.5), ((10_000, 10_000), 1.0)],
)
def test_gaussians_that_are_still_to_come_are_counted_before_they_come(counts, dearer):
    clock = a_clock(**GROWING)
    clock._seen.extend((10 * k, 0.1 * k, count) for k, count in enumerate((4000, *counts)))
    assert clock._dearer(0.0) == pytest.approx(dearer)


@pytest.mark.parametrize("factor", [0.6, 1.0, 1.5])
def test_rounds_begin_at_their_own_steps_and_the_last_is_spread_with_its_growth(factor):
    module = a_module()
    module.schedule = Schedule(1000, restarts=[400])
    trainer, module = simulate(a_clock(), lambda step: factor * 9.0 / 1000, module=module)
    found, share = module.results.run["budget"], (trainer.global_step - 400) / 600
    assert abs(found["off_percent"]) < 2 and found["schedule_done"] > 0.99
    assert found["notes"] == a_clock().plan["reasons"]
    assert trainer.rates[:399] == pytest.approx([0.01 ** (step / 1000) for step in range(1, 400)])
    assert module.density.stop == pytest.approx(480 * share, rel=0.1)  # counted in the round


@pytest.mark.parametrize("factor", [2.0, 2.5, 4.0])
def test_the_last_round_is_trained_even_where_the_first_took_all_the_time(factor, caplog):
    module = a_module()
    module.schedule = Schedule(1000, restarts=[500])
    trainer, module = simulate(a_clock(), lambda step: factor * 9.0 / 1000, module=module)
    found = module.results.run["budget"]
    assert trainer.global_step == 667 and found["schedule_done"] > 0.999
    assert module.density.stop == pytest.approx(160, abs=2)
    assert found["off_percent"] == pytest.approx(100 * (0.667 * factor - 1), rel=0.1)
    told = "the machine was too slow for the 500 steps of earlier rounds, so the last one has 167 of 500 planned steps"
    assert told in found["notes"][-1] and f"budget: {told}" in caplog.text


def test_a_moved_plan_goes_on_as_it_was_after_a_stop():
    clock, meter = a_clock(), Clock()
    _, module = simulate(clock, lambda step: 1.5 * 9.0 / 1000, meter, until=250)
    assert module.density.stop < 480
    second, again = a_clock(), a_module()
    second.load_state_dict(json.loads(json.dumps(clock.state_dict())))
    again.schedule.load_state_dict(json.loads(json.dumps(module.schedule.state_dict())))
    again.density.load_times(json.loads(json.dumps(module.density.times())))
    assert vars(again.density) == vars(module.density)
    _, again = simulate(second, lambda step: 1.5 * 9.0 / 1000, meter, again, first=250)
    found = again.results.run["budget"]
    assert found["schedule_done"] > 0.99 and found["moved_at_step"] < 250


def test_a_pace_that_leaves_no_time_stops_the_run_and_says_so(caplog):
    clock = a_clock()
    _, module = simulate(clock, lambda step: 9.0 / 1000 if step < 100 else 20.0)
    assert module.results.run["budget"]["schedule_done"] < 0.2 and "of its schedule was done" in caplog.text


def test_a_resumed_run_keeps_its_schedule():
    whole, _ = simulate(a_clock(), lambda step: 6.0 / 1000)
    first, meter = a_clock(), Clock()
    stopped, module = simulate(first, lambda step: 6.0 / 1000, meter, until=700)
    assert "budget" not in module.results.run  # it is not over
    second, again = a_clock(), a_module()
    second.load_state_dict(json.loads(json.dumps(first.state_dict())))
    again.schedule.load_state_dict(json.loads(json.dumps(module.schedule.state_dict())))
    resumed, module = simulate(second, lambda step: 6.0 / 1000, meter, again, first=700)
    assert resumed.global_step == pytest.approx(whole.global_step, rel=0.01)
    assert abs(module.results.run["budget"]["off_percent"]) < 2
    assert resumed.rates[0] == pytest.approx(stopped.rates[-1], rel=0.02)


def test_a_budget_needs_the_clock_of_the_costs():
    trainer = SimpleNamespace(callbacks=[])
    with pytest.raises(SceneError, match="budget needs callbacks.costs"):
        a_clock().on_train_start(trainer, None)


def leave(folder: Path, config: dict, step: int, end: float) -> None:
    """Puts a checkpoint into a folder, of a run whose schedule ends at ``end``."""
    (folder / "checkpoints").mkdir(parents=True)
    stored = {"config": config, "schedule": {"end": end}}
    torch.save({"global_step": step, "heatsplat": stored}, folder / "checkpoints" / "last.ckpt")


def left_by(folder: Path, config: dict, step: int, end: float) -> dict:
    """The configuration of a run that goes on in a folder with one checkpoint (``leave``)."""
    leave(folder, config, step, end)
    return resumed(config, folder)


def test_a_run_that_was_stretched_or_shrunk_goes_on_until_its_schedule_ends(tmp_path):
    plain = compose(["method=3dgs", *running.TINY, "max_steps=1000"])
    cases = ((1500, 2000.0, True), (2000, 2000.3, False), (600, 600.2, False), (600, 1000.0, True))
    for i, (step, end, goes_on) in enumerate(cases):
        assert (left_by(tmp_path / str(i), plain, step, end)["ckpt"] is not None) == goes_on, (step, end)


def test_a_denser_scene_has_new_points_between_neighbours():
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(0))
    scene = SceneData("cloud", None, None, None, points, point_colors=points.clone())
    denser = _denser(scene, 4)
    assert len(denser.points) == len(denser.point_colors) == 1200 and torch.equal(denser.points[:300], points)
    spacing = torch.cdist(points, points).sort().values[:, 3].mean()
    assert 0 < torch.cdist(denser.points[300:], points).amin(1).mean() < spacing
    assert torch.equal(denser.point_colors[300:600], points)  # a new point has what its neighbour has


# Runs ------------------------------------------------------------------------------------------------------------------


def budget_run(folder: Path, *overrides: str):
    """(module, config) of a whole run."""
    module, _ = running.run(folder, "method=etgs", *running.TINY, "callbacks.metrics.lpips_net=null", *overrides)
    return module, module.config


class Died(Exception):
    """The machine went down."""


class Hours:
    """Seconds that pass in training steps only, and steps without pictures, so that runs are timed alike on any machine.

    Trainer, checkpoints, calibration and clocks are the real ones.

    Args:
        slower: how much slower the steps of the run are than those of the calibration, which take ``STEP_S``.
    """

    STEP_S, WAITING = 0.02, 3  # others have the processor for two thirds of the time

    def __init__(self, monkeypatch, slower: float) -> None:
        self.now, self.slower, self.dies_at = 0.0, slower, None
        for module in ("training.clocks", "callbacks.timing"):
            monkeypatch.setattr(f"heatsplat.{module}.time", self)
        monkeypatch.setattr(SplatTraining, "training_step", lambda module, *_: self.step(module))
        monkeypatch.setattr(SplatTraining, "on_after_backward", lambda _: None)

    def perf_counter(self) -> float:
        return self.now

    def process_time(self) -> float:
        return self.now / self.WAITING

    def step(self, module: SplatTraining) -> dict:
        calibrates = not isinstance(module.trainer, pl.Trainer)
        if module.global_step == self.dies_at and not calibrates:
            raise Died
        self.now += self.STEP_S * (1.0 if calibrates else self.slower)
        return {"loss": module.splats.means.square().mean(), "terms": {}}


SIGHTED = ("method=etgs", *running.TINY, "logger=none", "budget=3s", "trainer.limit_val_batches=0", "test=false")
BLIND = (*SIGHTED, "density=adaptive")  # density control that does without images, which these runs never make


def prepared(folder: Path, *overrides: str, settings: tuple[str, ...] = BLIND) -> dict:
    """The configuration of a run that is ready to train in a folder."""
    return begin(compose([*settings, *overrides]), folder).config


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("slower", [0.4, 1.0, 2.5])
def test_whole_runs_end_within_a_tenth_of_their_time_whatever_the_calibration_saw(tmp_path, monkeypatch, slower):
    Hours(monkeypatch, slower)
    module, _ = running.run(tmp_path, *BLIND)
    told, cost = module.results.run["budget"], module.results.cost
    assert cost["train_seconds"] + told["calibration_s"] == pytest.approx(3.0, rel=0.03)
    assert abs(told["off_percent"]) < 3 and told["schedule_done"] > 0.95
    assert told["steps"] == module.trainer.global_step
    assert told["steps"] / told["planned_steps"] == pytest.approx(1.0 / slower, rel=0.1)


@pytest.mark.filterwarnings("ignore")
def test_seconds_of_a_busy_machine_may_be_those_of_the_processor(tmp_path, monkeypatch):
    Hours(monkeypatch, 1.0)
    module, _ = running.run(tmp_path / "busy", *BLIND, "budget_clock=cpu_seconds")
    told, cost = module.results.run["budget"], module.results.cost
    assert told["clock"] == "cpu_seconds" and cost["cpu_seconds"] + told["calibration_s"] == pytest.approx(
        3.0, rel=0.03
    )
    assert cost["train_seconds"] == pytest.approx(Hours.WAITING * cost["cpu_seconds"])
    planned = prepared(tmp_path / "wall")
    assert planned["budget"]["clock"] == "train_seconds"
    assert told["planned_steps"] / planned["budget"]["steps"] == pytest.approx(Hours.WAITING, rel=0.1)
    leave(tmp_path / "stopped", planned, 50, 100.0)
    with pytest.raises(OccupiedError, match=r"other settings \(budget_clock\)"):
        prepared(tmp_path / "stopped", "budget_clock=cpu_seconds")


def test_a_clock_without_a_budget_or_of_no_use_is_refused(tmp_path, monkeypatch):
    for overrides, message in (
        (("budget_clock=cpu_seconds", "budget=null"), "there is none: give budget=, or leave it out"),
        (("budget_clock=wall",), "budget_clock must be one of train_seconds, cpu_seconds, got 'wall'"),
    ):
        with pytest.raises(SceneError, match=message):
            prepared(tmp_path, *overrides)
    monkeypatch.setattr("heatsplat.runs.checks.device_of", lambda *_: "cuda")
    with pytest.raises(
        SceneError, match="budget_clock=cpu_seconds counts processor time, and this run trains on a GPU"
    ):
        prepared(tmp_path, "budget_clock=cpu_seconds")


@pytest.mark.filterwarnings("ignore")
def test_a_stretched_run_that_died_goes_on_from_its_newest_checkpoint(tmp_path, monkeypatch):
    hours = Hours(monkeypatch, 0.5)
    planned = prepared(tmp_path)["max_steps"]
    hours.dies_at = round(1.4 * planned)
    with pytest.raises(Died):
        running.run(tmp_path, *BLIND)
    before = hours.now
    plain = prepared(tmp_path)
    stopped = torch.load(plain["ckpt"], weights_only=True)
    assert planned < stopped["global_step"] < hours.dies_at < stopped["heatsplat"]["schedule"]["end"]
    assert plain["budget"]["steps"] == plain["max_steps"] and hours.now == before  # not planned anew
    hours.dies_at = None
    again, _ = running.run(tmp_path, *BLIND, f"ckpt={plain['ckpt']}")
    told = again.results.run["budget"]
    assert told["train_s"] + told["calibration_s"] == pytest.approx(3.0, rel=0.03)
    assert again.trainer.global_step == pytest.approx(planned / 0.5, rel=0.1)
    before_end = prepared(tmp_path)
    assert Path(before_end["ckpt"]).name.startswith("step_")  # last.ckpt is of the end
    assert before_end["budget"] == plain["budget"]


@pytest.mark.filterwarnings("ignore")
def test_a_budget_is_planned_from_the_curves_that_it_is_pointed_at(tmp_path, monkeypatch):
    Hours(monkeypatch, 1.0)
    write_points([replace(point, decay=0.4) for point in POINTS], tmp_path / "curves.csv")
    monkeypatch.chdir(tmp_path)

    def planned(*overrides):
        return prepared(tmp_path, *overrides)

    own, other = planned(), planned("budget_curves=curves.csv")
    assert own["budget_curves"] is None and own["budget"]["decay"] in {
        point.decay for point in read_points(CURVES_FILE)
    }
    assert other["budget"]["decay"] == other["module"]["optim"]["decay"] == 0.4
    assert other["budget_curves"] == str(tmp_path / "curves.csv")
    with pytest.raises(SceneError, match="none.csv holds no curves: FileNotFoundError.*budget_curves=FILE"):
        planned("budget_curves=none.csv")
    leave(tmp_path, other, 50, 100.0)  # its plan is kept by a run that is planned from the same curves only
    assert planned("budget_curves=curves.csv")["budget"] == other["budget"]
    with pytest.raises(OccupiedError, match=r"other settings \(budget_curves\)"):
        planned()


@pytest.mark.filterwarnings("ignore")
def test_a_plan_that_leaves_nothing_after_the_first_stage_is_refused(tmp_path, monkeypatch):
    Hours(monkeypatch, 1.0)
    with pytest.raises(SceneError, match=r"first_steps=20000 leaves no step of max_steps=\d+ .* \(a longer budget\)"):
        prepared(tmp_path, "method=thermalgs", "first_steps=20000")


@pytest.mark.filterwarnings("ignore")
def test_a_run_has_the_settings_of_its_plan(tmp_path, monkeypatch):
    """And nothing of the density control that it had before; a resumed run keeps them."""
    Hours(monkeypatch, 1.0)
    write_points([*POINTS, *(replace(point, psnr=point.psnr + 9) for point in CHEAP)], tmp_path / "curves.csv")
    config = prepared(tmp_path, f"budget_curves={tmp_path}/curves.csv", settings=SIGHTED)
    assert config["budget"]["settings"] == list(COARSE)
    for density in (config["density"], config["module"]["density"]):
        assert density["_target_"].endswith("Budget") and not {"grad_threshold", "reset_every"} & density.keys()
        assert density["stop"] == round(0.48 * config["max_steps"]) and density["cap_max"] == 100_000
    assert config["module"]["resolution"]["_target_"].endswith("CoarseToFine")
    leave(tmp_path, config, 50, 100.0)
    again = prepared(tmp_path, f"budget_curves={tmp_path}/curves.csv", settings=SIGHTED)
    assert again["density"] == config["density"] and again["budget"] == config["budget"]
    clock = BudgetClock(config["budget"], "")
    _, module = simulate(clock, lambda step: 3.0 / config["max_steps"], module=a_module(config["max_steps"]))
    assert module.results.run["budget"]["settings"] == list(COARSE)


@pytest.mark.slow
def test_a_run_ends_in_its_time_and_says_what_twice_would_buy(tmp_path):
    module, plain = budget_run(tmp_path, "budget=6s", "threads=1", "callbacks.costs.fps_repeats=1")
    found = json.loads((tmp_path / "metrics.json").read_text())
    told = found["run"]["budget"]
    assert found["cost"]["train_seconds"] + told["calibration_s"] == pytest.approx(6.0, rel=0.1)
    assert told["calibration_s"] < 1.0 and told["steps"] == module.trainer.global_step
    assert plain["density"]["stop"] == round(0.48 * plain["max_steps"])  # the schedule is that of the planned steps
    report = (tmp_path / "report.md").read_text()
    assert "twice the time (12 s) would buy" in report and told["twice_gain_db"] >= 0
    assert (tmp_path / "checkpoints" / "last.ckpt").exists()


@pytest.mark.slow
def test_a_resumed_run_keeps_its_plan(tmp_path):
    often = "callbacks.checkpoint.every_n_train_steps=100"  # however many steps there are in the end
    first, plain = budget_run(tmp_path, "budget=6s", "threads=1", "test=false", often)
    middle = min((tmp_path / "checkpoints").glob("step_*.ckpt"))
    again, resumed = budget_run(tmp_path / "again", "budget=6s", "threads=1", "test=false", f"ckpt={middle}")
    assert resumed["budget"] == plain["budget"] and resumed["max_steps"] == plain["max_steps"]
    told = again.results.run["budget"]
    assert told["train_s"] + told["calibration_s"] == pytest.approx(6.0, rel=0.1)
    assert again.trainer.global_step > int(middle.stem.removeprefix("step_"))
    with pytest.raises(SceneError, match="was planned for budget=6s and keeps its plan"):
        budget_run(tmp_path / "other", "budget=8s", "threads=1", f"ckpt={middle}")


def test_a_budget_and_a_number_of_steps_contradict_each_other(tmp_path):
    with pytest.raises(SceneError, match="budget chooses the number of steps, and max_steps gives it"):
        begin(compose(["method=etgs", *running.TINY, "budget=30s", "max_steps=100"]), tmp_path)
