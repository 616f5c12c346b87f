"""The printed figures of five papers, as they are printed, errors included, and what each metric is to heatsplat."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from heatsplat.contracts import SceneError
from heatsplat.metrics.definitions import described

FOLDER = Path(__file__).parent
TITLES = {"etgs": "ETGS", "thermogs": "ThermoGS", "ti3dgs": "TI-3DGS", "ravigs": "RaViGS", "supirgs": "SupIR-GS"}
AVERAGE = "average"  # a printed mean over all scenes of the table's data set


@dataclass(frozen=True)
class Figure:
    """One printed number.

    Args:
        table: label as printed, such as 1 or IV; "text" for running text.
        scene: key of the scene, a group of scenes, ``AVERAGE``, or empty where the paper does not say.
        method: key of the method; empty for facts about data.
        setting: iterations, protocol or switches; empty for none.
        metric: key in ``METRICS``.
        printed: exactly as printed, trailing zeros kept; empty where nothing is printed or readable.
        note: how an unclear cell was read, and what is doubtful about it.
    """

    table: str
    scene: str
    method: str
    setting: str
    metric: str
    printed: str
    note: str

    @property
    def value(self) -> float | None:
        """The printed number, None where there is none."""
        return float(self.printed) if self.printed else None


@dataclass(frozen=True)
class Metric:
    """A quantity of the tables.

    Args:
        title: heading, with its unit.
        digits: that are shown of our values and of differences.
        ours: score or cost in metrics.json, None where heatsplat measures none.
        convert: our value in the table's unit.
        why_not: why there is no value of ours.
    """

    title: str
    digits: int
    ours: str | None = None
    convert: Callable[[float], float] = float
    why_not: str = "heatsplat does not measure it"


def _as_ours(name: str) -> Metric:
    """A printed score that is called, measured and rounded as heatsplat's."""
    return Metric(described(name).heading, described(name).digits, name)


_TRUTH = "the error needs the true materials of the scene, which no data set on disk has"
_FACT = "a fact about the data, not a result"
METRICS = {
    **{name: _as_ours(name) for name in ("psnr", "ssim", "lpips", "mae_c", "mae_roi_c")},
    **{name: _as_ours(name) for name in ("rgb_psnr", "rgb_ssim", "rgb_lpips")},
    "train_s": Metric("train (s)", 1, "train_seconds"),
    "train_min": Metric("train (min)", 2, "train_seconds", lambda s: s / 60),
    "train_h": Metric("train (h)", 2, "train_seconds", lambda s: s / 3600),
    "memory_mb": Metric("memory (MB)", 0, "peak_memory_mb"),
    "memory_gb": Metric("memory (GB)", 2, "peak_memory_mb", lambda mb: mb / 1000),
    "fps": Metric("frames/s", 1, "render_fps"),
    "infer_s": Metric("inference (s)", 2, why_not="the paper does not say what is inferred in these seconds"),
    "mae_emissivity": Metric("error of emissivity", 3, why_not=_TRUTH),
    "mae_absorptivity": Metric("error of absorptivity", 3, why_not=_TRUTH),
    "mae_h_w_m2k": Metric("error of h (W/(m² K))", 3, why_not=_TRUTH),
    "mae_c_kj_m3k": Metric("error of c (kJ/(m³ K))", 1, why_not=_TRUTH),
    "emissivity": Metric("emissivity", 2, why_not=_FACT),
    "absorptivity": Metric("absorptivity", 2, why_not=_FACT),
    "h_w_m2k": Metric("h (W/(m² K))", 1, why_not=_FACT),
    "c_kj_m3k": Metric("c (kJ/(m³ K))", 0, why_not=_FACT),
    "views": Metric("views", 0, why_not=_FACT),
    "t_min_c": Metric("min (°C)", 1, why_not=_FACT),
    "t_max_c": Metric("max (°C)", 1, why_not=_FACT),
    "span_s": Metric("span (s)", 3, why_not=_FACT),
    "ambient_c": Metric("ambient (°C)", 1, why_not=_FACT),
    "frames_k": Metric("thousand frames", 0, why_not=_FACT),
    "split_train_parts": Metric("parts to train", 0, why_not=_FACT),
    "split_test_parts": Metric("parts to test", 0, why_not=_FACT),
    "land_cover_categories": Metric("classes", 0, why_not=_FACT),
}


@cache
def _all(paper: str) -> tuple[Figure, ...]:
    if paper not in TITLES:
        raise SceneError(f"table.paper={paper}: there are {', '.join(TITLES)}")
    with open(FOLDER / f"{paper}.csv", encoding="utf-8", newline="") as file:
        return tuple(Figure(printed=row.pop("value"), **row) for row in csv.DictReader(file))


def tables(paper: str) -> list[str]:
    """Labels of a paper's tables, in the order of the paper."""
    return list(dict.fromkeys(figure.table for figure in _all(paper)))


def figures(paper: str, table: str) -> list[Figure]:
    """The figures of one table.

    Args:
        paper: a key of ``TITLES``.
        table: label as printed.

    Raises:
        SceneError: no such paper or table; the message names those that there are.
    """
    found = [figure for figure in _all(paper) if figure.table == table]
    if not found:
        raise SceneError(f"table.number={table}: {TITLES[paper]} has {', '.join(tables(paper))}")
    return found


def quoted(paper: str, table: str, setting: str, scenes: Sequence[str]) -> dict[str, str]:
    """What a table prints for a setting: score or cost in metrics.json -> text, for several scenes such as "36.61 / 32.78".

    Metrics that heatsplat does not measure, or in another unit, are left out, and so is what is not printed for every scene.
    """
    found = {
        (figure.metric, figure.scene): figure.printed for figure in figures(paper, table) if figure.setting == setting
    }
    texts: dict[str, str] = {}
    for key in dict.fromkeys(key for key, _ in found):
        metric, printed = METRICS[key], [found.get((key, scene)) for scene in scenes]
        if metric.ours is not None and metric.convert is float and all(printed):
            texts[metric.ours] = " / ".join(map(str, printed))
    return texts


def doubts(paper: str, table: str) -> list[str]:
    """What does not add up in a table, a sentence each."""
    return list(read_yaml("doubts").get(paper, {}).get(table, ()))


@cache
def read_yaml(name: str) -> Any:
    """One of the YAML files beside this one."""
    return yaml.safe_load((FOLDER / f"{name}.yaml").read_text(encoding="utf-8"))
