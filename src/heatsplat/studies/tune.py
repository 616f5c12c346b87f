"""Tuning: searches a method's settings on a scene, then says over several seeds and lengths whether the best beat the default.

Rules: the search sees one seed; what it found is compared with the default on other seeds, each with its own. The sampler is
seeded and runs lie in the study's folder, so that a study that was stopped asks for the same trials, finds those that are
finished, and goes on.
"""

from __future__ import annotations

import logging
import statistics
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from heatsplat.contracts import SceneError, as_written, check_count, check_numbers, check_option, is_number
from heatsplat.io.files import write_atomically
from heatsplat.io.results import RunResults
from heatsplat.io.tables import markdown_table, number, over_seeds, write_csv
from heatsplat.metrics.definitions import DEFINITIONS, described
from heatsplat.studies.child_runs import OtherSettingsError, all_rows, spelled, train_or_read
from heatsplat.studies.finished import reason_of
from heatsplat.studies.options import listed, of_runs, whole_numbers

log = logging.getLogger("heatsplat")

SCORES = ("psnr", "mae_c")  # by which settings may be compared
COLUMNS = ("psnr", "mae_c", "gaussians", "cpu_seconds")
DIGITS = 3  # to which values of a range are rounded, so that they can be read and typed
CASE = {"scene", "knobs"}
SEARCH_SEED = 0


@dataclass(frozen=True)
class Trial:
    """A run with settings that may be unfit to train with.

    Args:
        method: whose.
        name: of its runs' folders: "default" or "trial" and its number.
        settings: knob -> value; empty for the default.
        results: None where the run failed.
        why: it failed.
    """

    method: str
    name: str
    settings: Mapping[str, Any]
    results: RunResults | None
    why: str = ""


@dataclass(frozen=True)
class MethodRuns:
    """Where the runs of a method lie, and what all of them have.

    Args:
        method: whose.
        folder: of the study.
        train: path of train.py; None: the installed heatsplat-train.
        common: overrides of all.
    """

    method: str
    folder: Path
    train: str | None
    common: Sequence[str]

    def result(self, name: str, settings: Mapping[str, Any], steps: int, seed: int) -> RunResults:
        """Of a run, which is trained unless it is there. Raises SceneError where it fails."""
        wanted = [*self.common, f"max_steps={steps}", f"seed={seed}", *_words(settings)]
        return train_or_read(self._place(name, steps, seed), self.train, wanted, self.folder)

    def attempt(self, name: str, settings: Mapping[str, Any], steps: int, seed: int = SEARCH_SEED) -> Trial:
        """A run that may fail: a rate may be too high to train with. Raises OtherSettingsError as ``result`` does."""
        try:
            return Trial(self.method, name, settings, self.result(name, settings, steps, seed))
        except OtherSettingsError:
            raise
        except SceneError as error:
            log.warning("%s, %s failed: %s", self.method, " ".join(_words(settings)), error)
            return Trial(self.method, name, settings, None, reason_of(self._place(name, steps, seed)))

    def _place(self, name: str, steps: int, seed: int) -> Path:
        return self.folder / "runs" / f"{self.method}_{steps}_{name}_{seed}"


@dataclass(frozen=True)
class Check:
    """The default and the best of the search at one length, seed by seed.

    Args:
        method: whose.
        steps: length of the runs.
        default, best: results with each seed; of the best those that there are, where runs failed.
        score: by which they are compared.
        failed: why a run of the best failed or a run has no score; empty where all have one.
    """

    method: str
    steps: int
    default: Sequence[RunResults]
    best: Sequence[RunResults]
    score: str
    failed: str = ""

    @property
    def gains(self) -> list[float]:
        """How much better the best is than the default with each seed; negative where it is worse, none where it failed."""
        if self.failed:
            return []
        sign = DEFINITIONS[self.score].sign
        return [
            sign * (now.test[self.score] - before.test[self.score])
            for before, now in zip(self.default, self.best, strict=True)
        ]

    @property
    def verdict(self) -> str:
        """What all seeds say by more than the default's spread: "better" or "worse"; else "within the spread".

        "failed: " and the reason where a run has no score.
        """
        if self.failed:
            return f"failed: {self.failed}"
        gains, mean = self.gains, statistics.fmean(self.gains)
        scores = [results.test[self.score] for results in self.default]
        spread = statistics.stdev(scores) if len(scores) > 1 else 0.0
        if len(gains) < 2 or abs(mean) <= spread or min(gains) <= 0 <= max(gains):
            return "within the spread"
        return "better" if mean > 0 else "worse"


def run(
    output_dir: Path | str,
    cases: Mapping[str, Mapping[str, Any]],
    methods: Sequence[str] | None = None,
    trials: int = 8,
    seconds: float | None = None,
    search_steps: int = 1500,
    check_steps: Sequence[int] = (1500,),
    seeds: Sequence[int] = (1, 2, 3),
    score: str = "psnr",
    overrides: Sequence[str] = (),
    threads: int | None = None,
    train: str | None = None,
) -> list[Check]:
    """What became of each method; writes tune.md and tune.csv after every search and every comparison.

    Args:
        output_dir: folder of the results and of the runs.
        cases: method -> {"scene": overrides that choose it, "knobs": setting -> [lowest, highest], or {"among": values}}.
            A range of whole numbers gives whole numbers; one above 0 is searched by its logarithm.
        methods: which of the cases; None: all.
        trials: settings that are tried for each method, beside its default; at least 1.
        seconds: of the trials' runs of a method, failed ones too, after which no other begins; None: no limit.
        search_steps: length of the runs of the search, whose seed is 0.
        check_steps: lengths at which the best is compared with the default.
        seeds: of those comparisons; 0 is the search's.
        score: what makes a setting better: "psnr" or "mae_c", of the test views.
        overrides: of all runs.
        threads: CPU threads of all runs; None: all cores.
        train: path of train.py; None: the installed heatsplat-train.

    Raises:
        SceneError: a case or an option is not as it should be, or a run with the default settings failed.
        ImportError: optuna is not installed.
    """
    output_dir, seeds, check_steps = Path(output_dir), listed(seeds), listed(check_steps)
    overrides = of_runs(overrides, threads)
    chosen = _checked(cases, listed(methods), trials, seeds, score)
    for key, steps in (("search_steps", [search_steps]), ("check_steps", check_steps)):
        for count in steps:
            check_count(f"study.{key}", count)
    if seconds is not None:
        check_numbers("study.seconds", seconds, error=SceneError)
    done: list[Trial] = []
    checks: list[Check] = []

    def write() -> None:
        write_csv(output_dir / "tune.csv", _records(done, checks, search_steps))
        page = markdown(chosen, done, checks, search_steps, score, seeds, overrides)
        write_atomically(output_dir / "tune.md", page)

    for method, case in chosen.items():
        runs = MethodRuns(method, output_dir, train, [*overrides, f"method={method}", *case["scene"]])
        default = Trial(method, "default", {}, runs.result("default", {}, search_steps, SEARCH_SEED))
        tried = [default, *_search(runs, case["knobs"], trials, seconds, search_steps, score)]
        done += tried
        best = _best(tried, score)
        write()
        for steps in check_steps if best is not default else ():
            checks.append(_check(runs, best, steps, seeds, score))
            log.info("%s at %d steps: %s", method, steps, checks[-1].verdict)
            write()
    log.info("%s", (output_dir / "tune.md").read_text(encoding="utf-8"))
    return checks


def _check(runs: MethodRuns, best: Trial, steps: int, seeds: Sequence[int], score: str) -> Check:
    """The best beside the default, which must not fail."""
    default = [runs.result("default", {}, steps, seed) for seed in seeds]
    tried = [runs.attempt(best.name, best.settings, steps, seed) for seed in seeds]
    best_of_all = [one.results for one in tried if one.results]
    failed = next((one.why for one in tried if one.results is None), "")
    if not failed and any(results.test.get(score) is None for results in (*default, *best_of_all)):
        failed = f"a run has no {score}"
    return Check(runs.method, steps, default, best_of_all, score, failed)


def _checked(
    cases: Mapping[str, Mapping[str, Any]], methods: Sequence[str], trials: int, seeds: Sequence[int], score: str
) -> dict[str, Mapping[str, Any]]:
    """The cases asked for."""
    check_option("study.score", score, SCORES, SceneError)
    check_count("study.trials", trials)
    whole_numbers("study.seeds", seeds, least=0)
    if SEARCH_SEED in seeds or len({*seeds}) < len(seeds):
        raise SceneError(
            f"study.seeds={seeds}: give every seed once, and not {SEARCH_SEED}, with which the settings were found"
        )
    if unknown := [name for name in methods if name not in cases]:
        raise SceneError(
            f"study.methods: {', '.join(unknown)} has no case; there are {', '.join(cases)}. Give one: "
            f"\"+study.cases={{{unknown[0]}:{{scene:['data.scene=cooling'],knobs:{{thermal.lr:[1e-4,1e-2]}}}}}}\""
        )
    chosen = {name: cases[name] for name in methods or cases}
    for name, case in chosen.items():
        good = isinstance(case, Mapping) and set(case) == CASE and isinstance(case["knobs"], Mapping)
        if not good or not case["knobs"]:
            raise SceneError(f"study.cases.{name} has the keys scene and knobs, both filled, got {as_written(case)}")
        for key, values in case["knobs"].items():
            _distribution(name, key, values)
    return {name: {"scene": listed(case["scene"]), "knobs": case["knobs"]} for name, case in chosen.items()}


def _distribution(method: str, key: str, values: Any) -> Any:
    """What optuna draws a knob from."""
    distributions = _optuna().distributions
    if isinstance(values, Mapping) and list(values) == ["among"] and listed(values["among"]):
        return distributions.CategoricalDistribution(listed(values["among"]))
    if isinstance(values, list | tuple) and len(values) == 2 and all(is_number(value) for value in values):
        low, high = values
        if low < high:
            whole = isinstance(low, int) and isinstance(high, int)
            kind = distributions.IntDistribution if whole else distributions.FloatDistribution
            return kind(low, high, log=low > 0)
    raise SceneError(
        f"study.cases.{method}.knobs.{key}={as_written(values)}: give [lowest, highest], or {{among: [values]}}, such as "
        "[1e-4, 1e-2]"
    )


def _optuna() -> Any:
    try:
        import optuna
    except ImportError as error:
        raise ImportError("study=tune needs optuna: pip install 'heatsplat[tune]'") from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def _search(
    runs: MethodRuns, knobs: Mapping[str, Any], trials: int, seconds: float | None, steps: int, score: str
) -> Iterator[Trial]:
    """The trials of a method, each as soon as it has ended."""
    optuna = _optuna()
    space = {key: _distribution(runs.method, key, values) for key, values in knobs.items()}
    direction = "maximize" if DEFINITIONS[score].higher else "minimize"
    study = optuna.create_study(direction=direction, sampler=optuna.samplers.TPESampler(seed=0))
    spent = 0.0
    for count in range(trials):
        if seconds is not None and spent >= seconds:
            log.info("%s: %d of %d trials, %.0f s", runs.method, count, trials, spent)
            return
        asked = study.ask(space)
        began = time.perf_counter()
        trial = runs.attempt(f"trial{count}", {key: _rounded(value) for key, value in asked.params.items()}, steps)
        value = None if trial.results is None else trial.results.test[score]
        if value is None:
            study.tell(asked, state=optuna.trial.TrialState.FAIL)
        else:
            study.tell(asked, value)
        # What failed has left no cost; what was there already has one, though it took no time now.
        spent += time.perf_counter() - began if trial.results is None else trial.results.cost["wall_seconds"] or 0.0
        log.info(
            "%s, %s: %s %s", runs.method, " ".join(_words(trial.settings)), DEFINITIONS[score].heading, number(value, 3)
        )
        yield trial


def _rounded(value: Any) -> Any:
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def _words(settings: Mapping[str, Any]) -> list[str]:
    return [f"{key}={spelled(value)}" for key, value in settings.items()]


def _best(tried: Sequence[Trial], score: str) -> Trial:
    """The trial with the best score, the default where none is better."""
    sign = DEFINITIONS[score].sign
    measured = [trial for trial in tried if trial.results is not None and trial.results.test[score] is not None]
    if not measured:
        raise SceneError(f"no run of method={tried[0].method} has the score {score}: choose another with study.score")
    return max(measured, key=lambda trial: sign * trial.results.test[score])


# What is written -----------------------------------------------------------------------------------------------------


def _records(tried: Sequence[Trial], checks: Sequence[Check], steps: int) -> Iterator[dict[str, Any]]:
    """A row for each run: what it was for, its settings, scores and costs."""
    for trial in tried:
        words = " ".join(_words(trial.settings)) or "default"
        yield {"method": trial.method, "part": "search", "steps": steps, "settings": words} | _values(trial.results)
    for check in checks:
        for name, several in (("default", check.default), ("best", check.best)):
            for results in several:
                yield {"method": check.method, "part": "check", "steps": check.steps, "settings": name} | _values(
                    results
                )


def _values(results: RunResults | None) -> dict[str, Any]:
    if results is None:
        return {}
    test, cost = results.test, results.cost
    return {
        "seed": results.run["seed"], "psnr": test["psnr"], "ssim": test["ssim"], "mae_c": test["mae_c"],
        "gaussians": cost["gaussians"], "cpu_seconds": cost["cpu_seconds"],
    }  # fmt: skip


def markdown(
    cases: Mapping[str, Mapping[str, Any]],
    tried: Sequence[Trial],
    checks: Sequence[Check],
    steps: int,
    score: str,
    seeds: Sequence[int],
    overrides: Sequence[str],
) -> str:
    """The report: what all runs have, the comparisons of all methods with their seeds, then every method's search."""
    searches = {trial.method: [one for one in tried if one.method == trial.method] for trial in tried}
    runs = [trial.results for trial in tried if trial.results] + [one for each in checks for one in each.default]
    about = all_rows(overrides, threads=[one.run.get("threads") for one in runs])
    which = f"{'seed' if len(seeds) == 1 else 'seeds'} {', '.join(map(str, seeds))}"
    lines = ["# Tuning", "", about, "", f"## The best settings of each search beside the default, {which}", ""]
    columns = [described(name).heading for name in COLUMNS]
    head = ["method", "steps", "settings", "seeds", *columns, f"gain in {DEFINITIONS[score].heading}", "verdict"]
    rows = []
    for check in checks:
        best = _best(searches[check.method], score)
        gain = over_seeds(check.gains, 3) if check.gains else ""
        rows.append([check.method, check.steps, "default", *_cells(check.default), "", ""])
        rows.append(["", "", ", ".join(_words(best.settings)), *_cells(check.best), gain, check.verdict])
    lines += markdown_table(head, rows, "lrlrrrrrrl")
    for method, own in searches.items():
        if _best(own, score).settings == {}:
            lines += ["", f"{method}: no trial was better than the default, so there is nothing to compare."]
    for method, own in searches.items():
        knobs = list(cases[method]["knobs"])
        lines += ["", f"## {method}: {' '.join(cases[method]['scene'])}, {steps} steps, seed 0", ""]
        lines += markdown_table(
            [*knobs, *columns],
            [[*(spelled(trial.settings.get(key, "default")) for key in knobs), *_scores(trial)] for trial in own],
            "r" * (len(knobs) + len(columns)),
        )
    return "\n".join(lines) + "\n"


def _scores(trial: Trial) -> list[str]:
    if trial.results is None:
        return [f"failed: {trial.why}", "", "", ""]
    return _cells([trial.results])[1:]


def _cells(several: Sequence[RunResults]) -> list[str]:
    """Number of runs, then means and spreads of their scores and costs."""

    def cell(name: str) -> str:
        values = [(results.test | results.cost)[name] for results in several]
        known = [value for value in values if value is not None]
        return over_seeds(known, described(name).digits)

    return [str(len(several)), *(cell(name) for name in COLUMNS)]
