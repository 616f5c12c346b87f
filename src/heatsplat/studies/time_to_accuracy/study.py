"""Time to the accuracy of a reference: how long recipes take until they are as good as the standard run, and what they cost.

Rules: recipes are compared with the reference on the same method, scene and seed only. On the way both are measured by the
validation views, at the end by the test views, each against the reference's own last value there. A compressed schedule is
worth its end, so ends count beside courses; beside every recipe stands what the standard schedule, made shorter, reaches in
the same time, on the line between the ends of standard runs of several lengths over log seconds, never beyond them.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

from heatsplat.contracts import SceneError, check_count, check_numbers, check_option
from heatsplat.io.command_lines import as_dict
from heatsplat.io.files import write_atomically
from heatsplat.io.pictures import figure_picture, write_png
from heatsplat.io.tables import write_csv
from heatsplat.studies.child_runs import train_or_read
from heatsplat.studies.finished import settings_of
from heatsplat.studies.frontier.runs import find_runs
from heatsplat.studies.options import listed, non_empty, of_runs
from heatsplat.studies.time_to_accuracy.report import markdown, picture, records
from heatsplat.studies.time_to_accuracy.runs import Panel, panels_of, without_length
from heatsplat.training.clocks import CLOCKS

log = logging.getLogger("heatsplat")

IDENTITY = ("method", "data", "data.scene", "data.scene_seed", "seed")  # with the settings, what tells runs apart


def run(
    output_dir: Path | str,
    runs: str | Sequence[str] | None,
    reference: Sequence[str],
    recipes: Mapping[str, Sequence[str] | None],
    clock: str = "train_seconds",
    psnr_margin_db: float = 0.2,
    mae_margin_c: float = 0.02,
    cases: Mapping[str, Sequence[str]] | None = None,
    lengths: Sequence[int] = (),
    seeds: Sequence[int] = (0,),
    overrides: Sequence[str] = (),
    threads: int | None = None,
    train: str | None = None,
    outputs: str = "outputs",
) -> list[Panel]:
    """The panels found; writes time_to_accuracy.md, .csv and .png.

    Args:
        output_dir: folder of the results, and of the runs that the study trains.
        runs: folders of finished runs or sweeps, searched to any depth; None: ``outputs`` where there are no cases, else none.
        reference: overrides of the reference, its max_steps among them; runs of another length with the same overrides are
            the standard schedule made shorter.
        recipes: name -> overrides, or None for a recipe that is left out. Finished runs with other overrides are shown under
            these.
        clock: "train_seconds" (a quiet machine) or "cpu_seconds" (one that does other work besides); see
            ``callbacks.timing.CostMeter``.
        psnr_margin_db, mae_margin_c: by how much a run may be worse than the reference and count as its equal.
        cases: name -> overrides that choose method and scene; of each, the reference, the standard schedule of ``lengths``
            and all recipes are trained with every seed, unless they are among ``runs``. What else a case says is in the title
            of its panel. None: nothing is trained.
        lengths: steps of shorter standard runs.
        seeds: of the runs that are trained.
        overrides: of the runs that are trained; finished runs count as theirs whether they have them or not.
        threads: CPU threads of the runs that are trained; None: all cores.
        train: path of train.py; None: the installed heatsplat-train.
        outputs: where runs lie.

    Raises:
        SceneError: the reference has no length, the clock is none, a margin no number, a length is no number of steps, there are
            cases and no seed, a run of the study failed, or there is no finished reference.
    """
    output_dir, reference = Path(output_dir), listed(reference)
    overrides = of_runs(overrides, threads)
    recipes = {name: listed(given) for name, given in recipes.items() if given is not None}
    check_option("study.clock", clock, CLOCKS, SceneError)
    margins = {"psnr": psnr_margin_db, "mae_c": mae_margin_c}
    for key, margin in zip(("study.psnr_margin_db", "study.mae_margin_c"), margins.values(), strict=True):
        check_numbers(key, margin, error=SceneError)
    if not as_dict(reference).get("max_steps", "").isdecimal():
        raise SceneError(f"study.reference={reference}: give its length too, a whole number, such as max_steps=30000")
    if runs is None:
        runs = [] if cases else outputs
    folders = [Path(text).expanduser() for text in listed(runs)]
    wanted = asked_for(cases, reference, lengths, recipes, seeds)
    known = find_runs(folders, clock)
    common = set(settings_of(as_dict(overrides)))
    there = {_identity(found, common) for found in known["overrides"]} if len(known) else set()
    for place, own in wanted:
        if _identity(as_dict(own), common) not in there:
            train_or_read(output_dir / "runs" / place, train, [*overrides, *own], output_dir)
            folders = [*folders, output_dir / "runs" / place]
    panels = panels_of(find_runs(folders, clock), clock, reference, recipes, margins, common, (cases or {}).values())
    if not panels:
        raise SceneError(
            f"study.runs={', '.join(map(str, folders))}: there is no finished run of the reference ({' '.join(reference)}) that "
            f"tells its {clock}, PSNR and Gaussians. Give folders that src/train.py wrote with these overrides, or "
            "study.cases, and they are trained."
        )
    write_png(output_dir / "time_to_accuracy.png", figure_picture(picture(panels, clock)))
    write_csv(output_dir / "time_to_accuracy.csv", records(panels))
    text = markdown(panels, clock)
    write_atomically(output_dir / "time_to_accuracy.md", text)
    log.info("%s", text)
    return panels


def asked_for(
    cases: Mapping[str, Sequence[str]] | None,
    reference: Sequence[str],
    lengths: Sequence[int],
    recipes: Mapping[str, Sequence[str]],
    seeds: Sequence[int],
) -> list[tuple[str, list[str]]]:
    """Folder and overrides of every run that the study needs. Raises SceneError as ``run`` does."""
    if not cases:
        return []
    lengths, seeds = listed(lengths), non_empty("study.seeds", seeds)
    for length in lengths:
        check_count("study.lengths", length)
    shorter = {f"standard_{length}": [*without_length(reference), f"max_steps={length}"] for length in lengths}
    wanted = {"reference": list(reference), **shorter, **recipes}
    return [
        (f"{case}_{name}_{seed}", [*listed(cases[case]), *wanted[name], f"seed={seed}"])
        for case, name, seed in itertools.product(cases, wanted, seeds)
    ]


def _identity(overrides: Mapping[str, str], common: set[str]) -> frozenset[str]:
    """What makes a run the one that was asked for; ``common`` settings say nothing."""
    default = {"seed": "0"}
    places = [f"{key}={overrides.get(key, default.get(key))}" for key in IDENTITY]
    return frozenset([*places, *(text for text in settings_of(overrides) if text not in common)])
