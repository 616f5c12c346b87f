"""The runs of the time to an accuracy: what is compared with what, and what the standard schedule does in the same time."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from heatsplat.io.command_lines import as_dict, key_of
from heatsplat.metrics.definitions import DEFINITIONS
from heatsplat.studies.finished import PLACES, ran_on, settings_of
from heatsplat.studies.frontier.runs import panel_titles, seconds_to
from heatsplat.studies.options import listed

log = logging.getLogger("heatsplat")


@dataclass(frozen=True)
class Outcome:
    """A finished run.

    Args:
        recipe: its name; None for the standard schedule of any length.
        seed: of the run.
        steps: its length.
        seconds: of training, by the study's clock.
        scores: psnr (dB) and mae_c (°C) of the test views.
        gaussians: at its end.
        course: score -> (seconds, value) of the validations in order.
        on: machine and threads, where they are told.
    """

    recipe: str | None
    seed: str
    steps: int
    seconds: float
    scores: dict[str, float]
    gaussians: float
    course: dict[str, list[tuple[float, float]]]
    on: str = ""

    @property
    def kind(self) -> tuple[str | None, int | None]:
        """What runs that differ in the seed only have in common. A recipe may leave its length to each run, as budget does."""
        return self.recipe, self.steps if self.recipe is None else None


@dataclass
class Panel:
    """The runs of one method on one scene, with a reference for every seed among them.

    Args:
        title: method, scene, and what was measured where that differs.
        margins: score -> by how much a run may be worse than the reference and count as its equal.
        references: seed -> the standard run of full length.
        outcomes: all runs, references among them.
    """

    title: str
    margins: dict[str, float]
    references: dict[str, Outcome] = field(default_factory=dict)
    outcomes: list[Outcome] = field(default_factory=list)

    def groups(self) -> list[list[Outcome]]:
        """Runs that differ in the seed only: the reference, shorter standard runs, then recipes by their time."""
        groups: dict[tuple[str | None, int | None], list[Outcome]] = {}
        for one in self.outcomes:
            groups.setdefault(one.kind, []).append(one)

        def order(own: list[Outcome]) -> tuple[bool, float]:
            return own[0].recipe is not None, -own[0].steps if own[0].recipe is None else own[0].seconds

        return sorted(groups.values(), key=order)

    def level(self, score: str, last: float) -> float:
        """The worst value that is as good as ``last`` of the reference."""
        return last - DEFINITIONS[score].sign * self.margins[score]

    def standard(self, seed: str) -> list[Outcome]:
        """The standard runs of a seed in order of their seconds."""
        return sorted((o for o in self.outcomes if o.recipe is None and o.seed == seed), key=lambda one: one.seconds)

    def measures(self, one: Outcome) -> dict[str, float | None]:
        """What a run is beside the reference of its seed; ``way_*``: by courses, ``end_*``: by ends, None where not reached.

        ``*_of_own`` are parts of the time in which the standard schedule gets as far: on the reference's course, or by
        the ends of standard runs of any length, on the line of ``standard_in``; ``*_of_all`` are parts of the reference's
        whole time.
        """
        reference = self.references[one.seed]
        found: dict[str, float | None] = {
            "seconds": one.seconds, "gaussians": one.gaussians, **one.scores,
            "time_ratio": one.seconds / reference.seconds,
            "gaussians_ratio": _ratio(one.gaussians, reference.gaussians or None),  # fields have none
        }  # fmt: skip
        for score, value in one.scores.items():
            higher, course = DEFINITIONS[score].higher, reference.course[score]
            found[f"{score}_off"] = value - reference.scores[score]
            level = self.level(score, course[-1][1]) if course else None
            way = own = None
            if level is not None:
                way, own = seconds_to(one.course[score], level, higher), seconds_to(course, level, higher)
            ends = [(math.log(each.seconds), each.scores[score]) for each in self.standard(one.seed)]
            level = self.level(score, reference.scores[score])
            end = one.seconds if (value >= level if higher else value <= level) else None
            reached = seconds_to(ends, level, higher)
            shortest = None if reached is None else math.exp(reached)
            for name, seconds, usual in (("way", way, own), ("end", end, shortest)):
                found[f"{name}_{score}"] = seconds
                found[f"{name}_{score}_of_own"] = _ratio(seconds, usual)
                found[f"{name}_{score}_of_all"] = _ratio(seconds, reference.seconds)
        return found

    def standard_in(self, one: Outcome) -> Outcome | None:
        """What the standard schedule reaches in the same seconds; None outside the times of its runs of that seed."""
        runs = self.standard(one.seed)
        for before, after in itertools.pairwise(runs):
            if before.seconds <= one.seconds <= after.seconds and before.seconds < after.seconds:
                share = math.log(one.seconds / before.seconds) / math.log(after.seconds / before.seconds)
                return Outcome(
                    recipe=None,
                    seed=one.seed,
                    steps=round(_between(before.steps, after.steps, share)),
                    seconds=one.seconds,
                    scores={name: _between(before.scores[name], after.scores[name], share) for name in one.scores},
                    gaussians=_between(before.gaussians, after.gaussians, share),
                    course={name: [] for name in one.scores},
                )
        return None


def _ratio(value: float | None, of: float | None) -> float | None:
    return None if value is None or of is None else value / of


def _between(low: float, high: float, share: float) -> float:
    return low + share * (high - low)


def without_length(overrides: Iterable[str]) -> list[str]:
    """Overrides but for max_steps."""
    return [text for text in overrides if not text.startswith("max_steps=")]


def further_of(overrides: Mapping[str, str], cases: Iterable[Sequence[str]]) -> list[str]:
    """What the case of a run says beside method and scene: of the cases that say nothing but what the run has, the longest."""
    own = {f"{key}={value}" for key, value in overrides.items()}
    case = max((case for case in cases if own.issuperset(case)), key=len, default=())
    return [text for text in case if key_of(text) not in {"method", *PLACES}]


def _told(overrides: Mapping[str, str]) -> list[str]:
    """Settings that make a recipe, and the experiment, which sets what no override tells."""
    experiment = overrides.get("experiment")
    return [*settings_of(overrides), *([] if experiment is None else [f"experiment={experiment}"])]


def panels_of(
    runs: pd.DataFrame,
    clock: str,
    reference: Sequence[str],
    recipes: Mapping[str, Sequence[str]],
    margins: dict[str, float],
    common: Iterable[str] = (),
    cases: Iterable[str | Sequence[str]] = (),
) -> list[Panel]:
    """Finished runs by panel; runs without a reference of their seed, or without the numbers, are left out with a warning.

    Args:
        runs: of ``find_runs``.
        clock, reference, recipes: as in ``run``.
        margins: score -> margin.
        common: settings that make no other recipe.
        cases: overrides that choose a method and a scene. What else one says makes no other recipe of its runs, and a panel of
            its own.
    """
    if runs.empty:
        return []
    length = int(as_dict(reference)["max_steps"])
    usual = frozenset(settings_of(as_dict(without_length(reference))))
    names = {frozenset(settings_of(as_dict(texts))): name for name, texts in recipes.items()}
    cases = [listed(case) for case in cases]
    runs = runs.assign(further=[further_of(overrides, cases) for overrides in runs["overrides"]])
    scenes = [", ".join([f"{one.method} on {one.scene}", *one.further]) for one in runs.itertuples()]

    def recipe_of(told: frozenset[str]) -> str | None:
        if frozenset(without_length(told)) == usual and told not in names:
            return None
        return names.get(told, " ".join(sorted(told)) or "defaults")

    panels: list[Panel] = []
    of_title = runs.assign(title=panel_titles(runs.assign(scene=scenes))).groupby("title", sort=False)
    for title, own in of_title:
        settings = [{*_told(one.overrides)} - {*common, *one.further} for one in own.itertuples()]
        shared = {text for text in set.intersection(*settings) if text.startswith("data.")}
        told = [recipe_of(frozenset(texts - shared)) for texts in settings]
        panel = Panel(title, margins, outcomes=_last_of_each(own, told, clock))
        panel.references |= {one.seed: one for one in panel.outcomes if one.recipe is None and one.steps == length}
        for lone in [one for one in panel.outcomes if one.seed not in panel.references]:
            log.warning(
                "%s, %s, seed %s is left out: there is no reference with this seed",
                title, lone.recipe or f"standard, {lone.steps} steps", lone.seed,
            )  # fmt: skip
            panel.outcomes.remove(lone)
        if panel.outcomes:
            panels.append(panel)
    return panels


def _last_of_each(runs: pd.DataFrame, recipes: Sequence[str | None], clock: str) -> list[Outcome]:
    """The last run of each recipe and seed; those without the numbers are left out."""
    kept: dict[tuple, tuple[Outcome, Path]] = {}
    for one, recipe in zip(runs.itertuples(), recipes, strict=True):
        outcome = _outcome(one, recipe, clock)
        if outcome is None:
            log.warning("%s is left out: it does not tell its %s, PSNR and Gaussians", one.folder, clock)
            continue
        if (key := (*outcome.kind, outcome.seed)) in kept:
            log.warning("%s is left out: a later run of its recipe and seed counts, %s", kept[key][1], one.folder)
        kept[key] = outcome, one.folder
    return [outcome for outcome, _ in kept.values()]


def _outcome(one: Any, name: str | None, clock: str) -> Outcome | None:
    """A row of ``find_runs``; None where numbers are missing. Scenes without temperatures have no MAE."""
    results = one.results
    seconds, psnr, count = results.cost.get(clock), results.test.get("psnr"), results.cost.get("gaussians")
    if None in (seconds, psnr, count):
        return None
    mae = results.test.get("mae_c")
    scores = {"psnr": psnr} if mae is None else {"psnr": psnr, "mae_c": mae}
    seed = str(results.run.get("seed", one.overrides.get("seed", "0")))
    return Outcome(name, seed, int(results.run["steps"]), seconds, scores, count, one.course, ran_on(results))
