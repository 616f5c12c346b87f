"""Scores renders that anybody's code has handed in, as the protocol says: a folder of temperatures, and what they cost."""

from __future__ import annotations

import json
import logging
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from heatsplat.contracts import SceneError, ThermalRange, check_option, is_number
from heatsplat.io.command_lines import setting, typed
from heatsplat.io.files import write_atomically
from heatsplat.io.results import METRICS_FILE
from heatsplat.io.tables import markdown_table, number, write_csv
from heatsplat.io.tiff import read_temperature
from heatsplat.metrics.definitions import DEFINITIONS
from heatsplat.metrics.scores import Scorer, mean_of_images
from heatsplat.studies.options import subset_of

log = logging.getLogger("heatsplat")

META, SCENES, TRUTH = "meta.json", "scenes", "truth"
ENDINGS = (".tiff", ".tif", ".npy")
COSTS = ("seconds", "memory_mb", "gaussians")  # of a scene, in a submission's metrics.json
# Scores that renders alone tell.
OF_RENDERS = ("mae_c", "psnr", "ssim", "mae_inlier_c", "mae_roi_c", "mae_roi_inlier_c")
ABSOLUTE_ZERO_C = -273.15
MANY = 0.2  # share of a scene's pixels outside of the camera's bounds from which on they may be no °C


@dataclass(frozen=True)
class SceneScore:
    """What the renders of one scene are worth.

    Args:
        views: a row for each held-out view: name, part, and its scores.
        cost: seconds of training, memory_mb and gaussians, where they are told.
    """

    views: list[dict[str, Any]]
    cost: dict[str, float] = field(default_factory=dict)

    @property
    def parts(self) -> list[str]:
        """What views are held out by, as it comes."""
        return list(dict.fromkeys(row["part"] for row in self.views))

    def mean(self, score: str, part: str | None = None) -> float | None:
        """Mean over the views, or over those of a part."""
        return mean_of_images([row for row in self.views if part in (None, row["part"])], score)


def score_scene(handed_in: Path, scene: Path, truth: Path, scores: Sequence[str]) -> SceneScore:
    """The scores of the renders of a scene.

    Args:
        handed_in: folder with a file <view>.tiff or <view>.npy for every held-out view.
        scene: what was handed out of it, for the bounds of its camera.
        truth: its exact images.
        scores: names in ``heatsplat.metrics.definitions.DEFINITIONS``.

    Raises:
        SceneError: views are missing or there twice, or a file is no image of temperatures in °C of the right size.
    """
    meta = json.loads((scene / META).read_text(encoding="utf-8"))
    bounds = ThermalRange(meta["min_value"], meta["max_value"])
    names = sorted(path.stem for path in truth.glob("*.tiff"))
    files = {name: _file(handed_in, name) for name in names}
    if missing := [name for name, file in files.items() if file is None]:
        if others := [path for path in sorted(handed_in.glob("*.*")) if path.stem in missing]:
            more = f" and {len(others) - 1} more like it" if len(others) > 1 else ""
            raise SceneError(
                f"{others[0]}{more}: {others[0].suffix} files are not scored, and pictures hold no temperatures in °C. Write "
                f"float32 temperatures in °C, one channel, to {handed_in}/<view>.tiff (or .npy)"
            )
        more = f" and {len(missing) - 5} more" if len(missing) > 5 else ""
        raise SceneError(
            f"{handed_in} lacks {len(missing)} of the {len(names)} held-out views of {scene.name}: "
            f"{', '.join(missing[:5])}{more}. Render every view of {scene / 'transforms_test.json'} and write it to "
            f"{handed_in}/<view>.tiff (or .npy)"
        )
    scorer, rows, outside = Scorer(bounds), [], []
    for name, file in files.items():
        exact = read_temperature(truth / f"{name}.tiff")
        images = (checked(file, exact.shape, bounds), exact)
        prediction, target = (
            torch.from_numpy(bounds.to_unit(image.astype(np.float64))).float()[..., None] for image in images
        )
        outside.append(((prediction < 0) | (prediction > 1)).float().mean().item())
        found = scorer(prediction.clamp(0, 1), target)
        rows.append({"name": name, "part": name.partition("_")[0], **{score: found[score] for score in scores}})
    if (share := sum(outside) / len(outside)) > MANY:
        log.warning(
            "%s: %.0f %% of the pixels lie outside of %g to %g °C, the camera's bounds, and count as these: are they °C?",
            handed_in,
            100 * share,
            bounds.min_c,
            bounds.max_c,
        )
    return SceneScore(rows)


def _file(folder: Path, name: str) -> Path | None:
    """The file of a view; None for none. Raises SceneError for several, of which one may be old."""
    found = [path for ending in ENDINGS if (path := folder / f"{name}{ending}").is_file()]
    if len(found) > 1:
        raise SceneError(f"{found[0]} and {found[1].name} are of one view: delete the one that does not count")
    return found[0] if found else None


def checked(path: Path, shape: tuple[int, ...], bounds: ThermalRange) -> np.ndarray:
    """The temperatures in a file, [H, W] in °C. Raises SceneError, naming the file and the remedy, where they are none."""
    try:
        image = np.load(path, allow_pickle=False) if path.suffix == ".npy" else read_temperature(path)
        if not isinstance(image, np.ndarray):
            raise ValueError("several arrays, as of an .npz")
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise SceneError(f"{path} cannot be read ({error}); write float32 temperatures in °C, one channel") from error
    if image.dtype.kind != "f":
        raise SceneError(f"{path} holds {image.dtype}; write float32 temperatures in °C, not greys or counts")
    image = image[..., 0] if image.ndim == 3 and image.shape[2] == 1 else image
    if image.shape != tuple(shape):
        raise SceneError(
            f"{path} is {list(image.shape)}, its view is {list(shape)} ([height, width]): render it with w, h, fl_x, fl_y, cx "
            "and cy of transforms_test.json"
        )
    if broken := int((~np.isfinite(image)).sum()):
        raise SceneError(f"{path} has {broken} pixels that are NaN or infinite; every pixel needs a temperature")
    middle, low, high = (float(value) for value in (np.median(image), image.min(), image.max()))
    if low >= 0 and high <= 1 and not (bounds.min_c <= 0.5 and bounds.max_c <= 2):
        raise SceneError(
            f"{path} lies between {low:.3g} and {high:.3g}: image values, no °C. °C = {bounds.min_c:g} + value * "
            f"{bounds.span_k:g} (min_value and max_value of {META})"
        )
    kelvin = middle + ABSOLUTE_ZERO_C
    if middle > bounds.max_c and bounds.min_c - bounds.span_k <= kelvin <= bounds.max_c + bounds.span_k:
        raise SceneError(f"{path} has a median of {middle:.1f}: kelvin, no °C. Subtract 273.15")
    if low < ABSOLUTE_ZERO_C:
        raise SceneError(f"{path} has {low:.1f} °C, which is below absolute zero; write temperatures in °C")
    return image


def read_submission(folder: Path) -> dict[str, Any]:
    """metrics.json of a submission. Raises SceneError naming what is missing."""
    path = folder / METRICS_FILE
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SceneError(
            f"{path} is missing: it tells the method and what each scene cost (docs/protocol.md)"
        ) from error
    except ValueError as error:
        raise SceneError(f"{path} is no JSON: {error}") from error
    if (
        not isinstance(told, dict)
        or not isinstance(told.get("method"), str)
        or not (told["method"].strip() and told["method"].isprintable())  # it stands in lines of tables
        or not isinstance(told.get("scenes"), dict)
        or not told["scenes"]
    ):
        raise SceneError(
            f'{path} needs "method": a name, and "scenes": {{name: {{"seconds": ..., "memory_mb": ..., "gaussians": ...}}}}'
        )
    seed = told.get("seed")
    if not (seed is None or (isinstance(seed, int) and not isinstance(seed, bool) and seed >= 0)):
        raise SceneError(f'{path}: "seed" is {seed!r}; a whole number of 0 or more, or leave it out')
    for scene, cost in told["scenes"].items():
        if not isinstance(cost, Mapping | None):
            raise SceneError(f'{path}: scenes.{scene} is {cost!r}; what it cost, {{"seconds": ...}}, or null')
        for key, value in (cost or {}).items():
            check_option(f"{path}: each key of scenes.{scene}", key, COSTS, SceneError)
            if value is not None and not (is_number(value) and value >= 0):
                raise SceneError(f"{path}: scenes.{scene}.{key} is {value!r}; a number of 0 or more, or null")
    return told


def score_submission(folder: Path, root: Path, scores: Sequence[str]) -> tuple[dict[str, Any], dict[str, SceneScore]]:
    """What a submission tells of itself, and the score of each of its scenes.

    Args:
        folder: with metrics.json and a folder of renders for each scene that it names.
        root: folder of the protocol's scenes/ and truth/.
        scores: names in ``heatsplat.metrics.definitions.DEFINITIONS``.

    Raises:
        SceneError: it names a scene that there is not, or ``read_submission`` or ``score_scene`` does.
    """
    told = read_submission(folder)
    there = scenes_in(root)
    if unknown := set(told["scenes"]) - set(there):
        raise SceneError(f"{folder / METRICS_FILE} names {', '.join(sorted(unknown))}; {root} has {', '.join(there)}")
    found = {}
    for scene, cost in told["scenes"].items():
        score = score_scene(folder / scene, root / SCENES / scene, root / TRUTH / scene, scores)
        found[scene] = SceneScore(score.views, {key: cost[key] for key in COSTS if (cost or {}).get(key) is not None})
    return told, found


def scores_of(protocol: Mapping[str, Any]) -> list[str]:
    """The scores of a protocol, the one that ranks first. Raises SceneError for none, and for one that renders do not tell."""
    return subset_of("scores of the protocol", protocol["scores"], OF_RENDERS)


def scenes_in(root: Path) -> list[str]:
    """Names of the scenes of a protocol's folder that have a truth. Raises SceneError where there are none."""
    names = sorted(
        path.parent.name for path in (root / SCENES).glob(f"*/{META}") if (root / TRUTH / path.parent.name).is_dir()
    )
    if not names:
        raise SceneError(
            f"{root} has no scenes/ and truth/ of the protocol; write them: python src/study.py study=scenes "
            f"{typed(setting('study.target', root))}"
        )
    return names


def run(
    output_dir: Path | str, submission: str | None, root: str | None, protocol: Mapping[str, Any]
) -> dict[str, SceneScore]:
    """Scores a submission; writes score.md and score.csv.

    Args:
        output_dir: of the study.
        submission, root: folders, see ``score_submission``.
        protocol: conf/protocol.

    Raises:
        SceneError: a folder is not given, the protocol has no such track, or see ``score_submission``.
    """
    if submission is None or root is None:
        raise SceneError(
            "give the folder of renders and that of the protocol's scenes: submission=FOLDER root=FOLDER (docs/protocol.md)"
        )
    output_dir, scores = Path(output_dir), scores_of(protocol)
    folder, root = Path(submission).expanduser(), Path(root).expanduser()
    if (track := read_submission(folder).get("track")) not in (None, *protocol["tracks"]):
        raise SceneError(
            f'{folder / METRICS_FILE}: "track" is {track}; the protocol has {", ".join(protocol["tracks"])}. Name one of them '
            "there, or leave it out"
        )
    told, found = score_submission(folder, root, scores)
    order = [*protocol["scenes"], *scenes_in(root)]
    found = {scene: found[scene] for scene in sorted(found, key=order.index)}
    rows, head = (
        [],
        ["scene", "part", "views", *(f"{name} ({DEFINITIONS[name].unit or '-'})" for name in scores), *COSTS],
    )
    for scene, score in found.items():
        for part in (None, *score.parts):
            count = sum(part in (None, row["part"]) for row in score.views)
            cells = [number(score.mean(name, part), DEFINITIONS[name].digits) for name in scores]
            costs = [number(score.cost.get(key), 0) if part is None else "" for key in COSTS]
            rows.append([scene, part or "all", count, *cells, *costs])
    lines = [f"# {told['method']}", "", *markdown_table(head, rows, "ll" + "r" * (len(head) - 2)), ""]
    lines += [f"- {name}: {DEFINITIONS[name].better} is better; {DEFINITIONS[name].sentence}" for name in scores]
    if left := [scene for scene in scenes_in(root) if scene not in found]:
        lines.append(f"- not handed in, as {METRICS_FILE} does not name them: {', '.join(left)}")
    write_atomically(output_dir / "score.md", "\n".join([*lines, ""]))
    write_csv(
        output_dir / "score.csv", [{"scene": scene, **row} for scene, score in found.items() for row in score.views]
    )
    log.info("%s", "\n".join(lines))
    return found
