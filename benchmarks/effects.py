"""What choosing effects is worth: auto against none, all and the truth, and each chosen effect left out in turn."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from matplotlib.figure import Figure

from heatsplat.contracts import SceneError, check_option
from heatsplat.effects import assembly
from heatsplat.io.files import write_atomically
from heatsplat.io.pictures import figure_picture, write_png
from heatsplat.io.results import RunResults
from heatsplat.io.tables import markdown_table, number, over_seeds
from heatsplat.studies.child_runs import all_rows, train_or_read
from heatsplat.studies.options import non_empty, of_runs, subset_of, whole_numbers

TABLE_FILE, PICTURE_FILE = "effects.md", "effects.png"
SELECTIONS = ("auto", "none", "all", "oracle")
MOST_NAMED = 5  # effects that a cell of the table names
CLOCKS = {
    "train_seconds": "Milliseconds are those of whole training steps: compare them on a machine that does nothing else.",
    "cpu_seconds": "Milliseconds are CPU time of whole training steps.",
}
NOTE = (
    "Held-out images as the camera records them, mean ± standard deviation over the seeds; clean is the image before the camera, "
    "against the truth without its flaws, which matters where frames have numbers of their own that nobody knows of held-out "
    "ones. Parameters are those at the end, after Gaussians were added and removed."
)


@dataclass(frozen=True)
class Job:
    """One run of the study: a selection of effects on a preset; ``left_out`` names an effect that auto must do without."""

    preset: str
    selection: str
    seed: int
    left_out: str | None = None

    @property
    def folder(self) -> str:
        return "_".join([self.preset, self.selection, *([f"without_{self.left_out}"] if self.left_out else [])])

    def overrides(self, truth: Sequence[str]) -> list[str]:
        """What the command line of the run says of it."""
        if self.selection == "oracle":
            effects = ["effects=none", *(f"effects.{name}=on" for name in truth)]
        else:
            effects = [f"effects={self.selection}"]
        if self.left_out:
            effects.append(f"effects.{self.left_out}=off")
        scene = ["data=synthetic", f"data.scene={self.preset}", f"data.scene_seed={self.seed}", f"seed={self.seed}"]
        return ["method=auto", *scene, *effects]


@dataclass(frozen=True)
class Row:
    """A job's results: by seed, PSNR in dB of the recorded and of the clean image (empty where none is known) and MAE in °C
    (empty without temperatures); means of the numbers that are learned and of milliseconds per step."""

    job: Job
    effects: tuple[str, ...]
    psnr: tuple[float, ...]
    clean_psnr: tuple[float, ...]
    mae_c: tuple[float, ...]
    parameters: float
    ms_per_step: float

    @property
    def shown(self) -> str:
        """The effects that were on, by name, or how many where a cell cannot hold them."""
        return ", ".join(self.effects) or "none" if len(self.effects) <= MOST_NAMED else f"{len(self.effects)} effects"


def run(
    output_dir: Path | str,
    train: str | None,
    presets: Mapping[str, Sequence[str]],
    selections: Sequence[str],
    leave_one_out: bool,
    seeds: Sequence[int],
    overrides: Sequence[str],
    threads: int | None = None,
    clock: str = "train_seconds",
    only: Sequence[str] | None = None,
) -> None:
    """Trains every selection on every preset, then without each effect that auto chose; writes effects.md and .png.

    One choice of effects is one recipe, whoever chose it: it is trained once.

    Args:
        output_dir: of the study; runs that have results there are not run again.
        train: path of train.py; None: the installed heatsplat-train.
        presets: synthetic scene -> the effects that are truly there.
        selections: some of SELECTIONS.
        leave_one_out: whether chosen effects are left out in turn.
        seeds: of every row.
        overrides: of every run.
        threads: CPU threads of every run; None takes all cores.
        clock: the cost that counts as time, of CLOCKS.
        only: names of presets; None for all.

    Raises:
        SceneError: a run failed, its folder holds a run of other settings, there is no such clock, preset or selection, or
            there is none of what makes a run.
    """
    check_option("study.clock", clock, CLOCKS, SceneError)
    chosen = non_empty("study.presets", list(presets)) if only is None else subset_of("study.only", only, presets)
    selections = subset_of("study.selections", selections, SELECTIONS)
    seeds = whole_numbers("study.seeds", seeds, least=0)
    folder = Path(output_dir).resolve()
    common = of_runs(overrides, threads)
    known: dict[tuple[str, int, frozenset[str]], RunResults] = {}  # by preset, seed and effects that are on

    def of(job: Job, expected: frozenset[str] | None) -> RunResults:
        """The results of a run; ``expected`` are the effects that will be on, None where only the run can tell."""
        if expected is not None and (job.preset, job.seed, expected) in known:
            return known[job.preset, job.seed, expected]
        place = folder / "runs" / job.folder / str(job.seed)
        results = train_or_read(place, train, [*common, *job.overrides(presets[job.preset])], folder)
        return known.setdefault((job.preset, job.seed, _on(results)), results)

    rows = []
    for preset in chosen:
        for selection in selections:
            job = Job(preset, selection, 0)
            expected = {"none": frozenset(), "oracle": frozenset(presets[preset])}.get(selection)
            whole = [of(replace(job, seed=seed), expected) for seed in seeds]
            rows.append(_row(job, whole, clock))
            if selection == "auto" and leave_one_out:
                for name in rows[-1].effects:
                    left = replace(job, left_out=name)
                    less = [
                        of(replace(left, seed=seed), _on(results) - assembly.dependents(name))
                        for seed, results in zip(seeds, whole, strict=True)
                    ]
                    rows.append(_row(left, less, clock))
        found = {key: [results.run.get(key) for results in known.values()] for key in ("threads", "steps")}
        about = all_rows(common, seed=seeds, threads=found["threads"], max_steps=found["steps"])
        write_atomically(folder / TABLE_FILE, tables(rows, clock, about))  # what is known so far
    figure = picture(rows)
    if figure is not None:
        write_png(folder / PICTURE_FILE, figure_picture(figure))


def _on(results: RunResults) -> frozenset[str]:
    """Names of the effects that were on in a run."""
    return frozenset(name for name, effect in results.effects.items() if effect["on"])


def _row(job: Job, results: Sequence[RunResults], clock: str) -> Row:
    """The row of a job's runs, one for each seed; effects are those that were on in any of them."""
    effects = {name: None for result in results for name, effect in result.effects.items() if effect["on"]}

    def known(name: str) -> tuple[float, ...]:
        return tuple(result.test[name] for result in results if result.test.get(name) is not None)

    return Row(
        job,
        tuple(effects),
        known("psnr"),
        known("clean_psnr"),
        known("mae_c"),
        statistics.fmean(result.run["parameters"] for result in results),
        statistics.fmean(1000.0 * result.cost[clock] / result.run["steps"] for result in results),
    )


def tables(rows: Sequence[Row], clock: str, about: str) -> str:
    """Markdown: what all runs have, selections side by side, then what leaving each effect out costs."""
    chosen = [
        (
            row.job.preset, row.job.selection, row.shown,
            over_seeds(row.psnr, 2), over_seeds(row.clean_psnr, 2), over_seeds(row.mae_c, 3),
            number(row.parameters, 0), number(row.ms_per_step, 1),
        )
        for row in rows
        if row.job.left_out is None
    ]  # fmt: skip
    head = ("scene", "selection", "effects", "PSNR (dB)", "clean (dB)", "MAE (°C)", "parameters", "ms per step")
    lines = [
        "# What selecting effects is worth",
        "",
        f"{NOTE} {CLOCKS[clock]}",
        "",
        about,
        "",
        *markdown_table(head, chosen, align="lllrrrrr"),
    ]
    whole = {row.job.preset: row for row in rows if row.job.selection == "auto" and row.job.left_out is None}
    left = []
    for row in (row for row in rows if row.job.left_out):
        auto = whole[row.job.preset]
        left.append((
            row.job.preset, row.job.left_out, over_seeds(_less(auto.psnr, row.psnr), 2),
            over_seeds(_less(auto.clean_psnr, row.clean_psnr), 2), over_seeds(_less(row.mae_c, auto.mae_c), 3),
            number(auto.parameters - row.parameters, 0), number(auto.ms_per_step - row.ms_per_step, 2),
        ))  # fmt: skip
    if left:
        head = (
            "scene",
            "without",
            "PSNR lost (dB)",
            "clean",
            "MAE gained (°C)",
            "parameters saved",
            "ms per step saved",
        )
        lines += ["", "## Leaving out one effect", ""]
        lines += ["Losses (PSNR down, MAE up) and savings without the effect and everything that depends on it.", ""]
        lines += markdown_table(head, left, align="llrrrrr")
    return "\n".join([*lines, ""])


def _less(more: Sequence[float], less: Sequence[float]) -> list[float]:
    """Differences seed by seed; empty where one of the two does not know them."""
    return [a - b for a, b in zip(more, less, strict=True)] if more and less else []


def picture(rows: Sequence[Row]) -> Figure | None:
    """PSNR and milliseconds per step of each selection beside those of the truth, by scene; None without an oracle."""
    truths = {row.job.preset: row for row in rows if row.job.selection == "oracle"}
    if not truths:
        return None
    figure = Figure(figsize=(10, 0.5 * len(truths) + 1.8), dpi=110, layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    names = list(truths)
    for i, selection in enumerate(("auto", "none", "all")):
        found = [row for row in rows if row.job.selection == selection and row.job.left_out is None]
        found = [row for row in found if row.job.preset in truths]
        if not found:
            continue
        heights = [names.index(row.job.preset) + 0.15 * (i - 1) for row in found]
        style = {"marker": "os^"[i], "linestyle": "", "color": f"C{i}", "label": selection}
        gains = [statistics.fmean(_less(row.psnr, truths[row.job.preset].psnr)) for row in found]
        left.plot(gains, heights, **style)
        right.plot([row.ms_per_step / truths[row.job.preset].ms_per_step for row in found], heights, **style)
    left.axvspan(-0.3, 0.3, color="0.9", zorder=0)  # what counts as equal
    left.set(xlabel="PSNR minus that of the true effects (dB)", yticks=range(len(names)), yticklabels=names)
    left.set_xscale("symlog", linthresh=1.0)
    right.axvline(1.0, color="0.7", linewidth=1)
    right.set(xlabel="time of a training step over that with the true effects")
    for axes in (left, right):
        axes.grid(alpha=0.25)
    left.invert_yaxis()
    right.legend()
    return figure
