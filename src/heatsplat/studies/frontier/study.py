"""What accuracy costs in time: quality against seconds along finished runs, the Pareto front, and time to a quality.

Rules: seconds are of training alone, evaluation excluded; a course is that of the validation views, its end mark that of
the test views; runs of one recipe on one scene with different seeds are averaged. The front is that of all points, those of
courses too: an end is on it if no other recipe was as good sooner, at its end or on its way. Only runs that measured alike
views are compared. Finished runs are read, old ones too; what ``methods`` asks for is trained before.
"""

from __future__ import annotations

import io
import itertools
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from heatsplat.contracts import SceneError, counted, is_number
from heatsplat.io.files import short_name, write_atomically
from heatsplat.io.page import write_page
from heatsplat.io.pictures import figure_picture, write_png
from heatsplat.io.results import CURVE_FILE, METRICS_FILE
from heatsplat.io.tables import write_csv
from heatsplat.studies.child_runs import spelled, train_or_read
from heatsplat.studies.frontier.report import markdown, picture, records
from heatsplat.studies.frontier.runs import Recipe, find_runs, group
from heatsplat.studies.options import listed, non_empty

log = logging.getLogger("heatsplat")

LONGEST = 200  # bytes of the name of a run's folder, of which file systems allow 255


def run(
    output_dir: Path | str,
    runs: str | Sequence[str] | None,
    psnr_levels_db: Sequence[float],
    mae_levels_c: Sequence[float],
    methods: Sequence[str] | Mapping[str, Mapping[str, Sequence[Any]]] | None = None,
    scenes: Sequence[str] = ("heated",),
    seeds: Sequence[int] = (0,),
    knobs: Mapping[str, Sequence[Any]] | None = None,
    overrides: Sequence[str] = (),
    train: str | None = None,
    outputs: str = "outputs",
) -> list[Recipe]:
    """The recipes found; writes frontier.md, .csv, .png, .svg and .html, and the picture to TensorBoard.

    Args:
        output_dir: folder of the results, and of the runs that the study trains.
        runs: folders of finished runs or sweeps that are shown, searched to any depth; None: ``outputs`` where there are no
            methods, else no others.
        psnr_levels_db, mae_levels_c: qualities (dB; °C) until which the seconds of training are told.
        methods: what to train, every combination of them with scenes, seeds and knobs; none: nothing. With a mapping each
            has knobs of its own besides: {"etgs": {"thermal.frequencies": [8, 24]}, "3dgs": {}}.
        scenes, seeds: on which they train.
        knobs: override -> its values, of all methods.
        overrides: of all these runs.
        train: path of train.py; None: the installed heatsplat-train.
        outputs: where runs lie.

    Raises:
        SceneError: there is no finished run in them, one of the study's failed, levels are not positive numbers, or what is to
            be trained has no scene, seed or value of a knob.
    """
    output_dir = Path(output_dir)
    levels = {
        "psnr": checked_levels("psnr_levels_db", psnr_levels_db),
        "mae_c": checked_levels("mae_levels_c", mae_levels_c)[::-1],
    }
    if runs is None:
        runs = [] if methods else outputs
    folders = [Path(text).expanduser() for text in listed(runs)]
    for place, wanted in asked_for(methods, scenes, seeds, knobs):
        train_or_read(output_dir / "runs" / place, train, [*listed(overrides), *wanted], output_dir)
        folders = [*folders, output_dir / "runs" / place]
    found = find_runs(folders)
    if found.empty:
        raise SceneError(
            f"study.runs={', '.join(map(str, folders))}: there is no finished run (no {METRICS_FILE} that can be read with a "
            f"{CURVE_FILE} beside). Give folders that src/train.py wrote, such as "
            "study.runs=[outputs/etgs_cooling,outputs/sweeps/...]; a run whose files are damaged must be trained again, in "
            "a new folder."
        )
    recipes = group(found)
    figure = picture(recipes)
    pixels = figure_picture(figure)
    write_png(output_dir / "frontier.png", pixels)
    vector = io.StringIO()
    figure.savefig(vector, format="svg", metadata={"Date": None})
    write_atomically(output_dir / "frontier.svg", vector.getvalue())
    write_csv(output_dir / "frontier.csv", records(recipes))
    text = markdown(recipes, levels)
    write_atomically(output_dir / "frontier.md", text)
    write_page(output_dir / "frontier.html", text)
    from torch.utils.tensorboard import SummaryWriter

    with SummaryWriter(str(output_dir / "tb")) as writer:
        writer.add_image("frontier", pixels, dataformats="HWC")
        writer.add_text("frontier", text)
    log.info("%s of %s:\n%s", counted(len(found), "run"), counted(len(recipes), "recipe"), text)
    return recipes


def asked_for(
    methods: Sequence[str] | Mapping[str, Mapping[str, Sequence[Any]]] | None,
    scenes: Sequence[str],
    seeds: Sequence[int],
    knobs: Mapping[str, Sequence[Any]] | None,
) -> list[tuple[str, list[str]]]:
    """Folder and overrides of every run that ``run`` trains. Raises SceneError where it is said of nothing."""
    if not methods:
        return []
    jobs, scenes, seeds = [], non_empty("study.scenes", scenes), non_empty("study.seeds", seeds)
    own = methods if isinstance(methods, Mapping) else dict.fromkeys(listed(methods))
    for method in own:
        grid = {**_grid("study.knobs", knobs), **_grid(f"study.methods.{method}", own[method])}
        for scene, seed, *values in itertools.product(scenes, seeds, *grid.values()):
            settings = [f"{key}={spelled(value)}" for key, value in zip(grid, values, strict=True)]
            place = "_".join([method, scene, *(text.replace("/", "-") for text in settings), f"seed={seed}"])
            jobs.append(
                (short_name(place, LONGEST), [f"method={method}", f"data.scene={scene}", f"seed={seed}", *settings])
            )
    return jobs


def _grid(key: str, knobs: Any) -> dict[str, list[Any]]:
    """Knobs and their values; none for null. Raises SceneError where one has no value."""
    if not isinstance(knobs, Mapping | None):
        raise SceneError(f"{key}={knobs}: give settings with their values, such as {{max_steps: [1000, 3000]}}")
    return {name: non_empty(f"{key}.{name}", values) for name, values in (knobs or {}).items()}


def checked_levels(name: str, levels: Any) -> list[float]:
    """Levels of a score in ascending order, each once.

    Raises:
        SceneError: they are no list of positive numbers; the message names the option.
    """
    numbers = list(levels) if isinstance(levels, (list, tuple)) else [None]
    for value in numbers:
        if not is_number(value) or value <= 0:
            raise SceneError(f"study.{name}={levels}: give positive numbers in brackets, such as [1, 2]; [] for none")
    return sorted({float(value) for value in numbers})
