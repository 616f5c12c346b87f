"""Pictures of what a thermal model knows of its Gaussians besides the image: emissivity, temperature and the like."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytorch_lightning as pl
import torch
from torch import Tensor

from heatsplat.callbacks.board import add_picture
from heatsplat.callbacks.images import file_stem
from heatsplat.contracts import Frame, SceneData, check_count, evenly_spread
from heatsplat.io.pictures import Bar, Panel, bounds_of, colorize, compose, text_panel, write_png
from heatsplat.io.quantities import impossible, words_and_unit
from heatsplat.io.tables import write_csv
from heatsplat.metrics.attribute_errors import attribute_errors, true_values
from heatsplat.shots import at_time, first_free_id
from heatsplat.uncertainty import Uncertainty, shown

LEARNED_FILE = "learned.csv"
COLORMAP = "viridis"  # not that of temperatures
COLUMNS = 4  # maps in a row
CONSTANT = 1e-4  # relative spread below which a map would show how float32 rounds


class AttributeMaps(pl.Callback):
    """Draws the attributes of the thermal model (``module.attribute_maps``) as images, four in a row; constants are numbers.

    The same validation views every time (renders/attributes/val), and test views at the end (renders/attributes/test);
    TensorBoard holds all of them. Models without attributes have no such pictures.

    Args:
        val_views: how many validation views, spread evenly; 0 for none.
        test_views: how many test views, spread evenly; 0 for none.
    """

    def __init__(self, val_views: int = 1, test_views: int = 2) -> None:
        check_count("callbacks.attributes.val_views", val_views, 0)
        check_count("callbacks.attributes.test_views", test_views, 0)
        self.val_views, self.test_views = val_views, test_views

    def on_validation_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if not trainer.sanity_checking:
            self._draw("val", module, self.val_views, trainer.global_step)

    def on_test_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self._draw("test", module, self.test_views, trainer.global_step)

    def _draw(self, split: str, module: pl.LightningModule, count: int, step: int) -> None:
        frames = getattr(module.scene, split).frames
        for i in evenly_spread(len(frames), count):
            picture = attribute_picture(module, frames[i])
            if picture is None:
                return
            name = file_stem(frames[i])
            png = write_png(module.output_dir / "renders" / "attributes" / split / f"{name}.png", picture)
            add_picture(module, f"attributes/{split}/{name}", picture, png, step)


class AttributeErrors(pl.Callback):
    """Compares what the thermal model tells of its Gaussians with the truth, where the scene knows it.

    Mean absolute errors over the Gaussians, weighted by their opacity, go into the data of metrics.json and the report;
    beside each stands that of the table that training pulled it to. Where both are alike, nothing was learned.
    """

    def on_test_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        frames = module.scene.test.frames
        if module.scene.true_attributes is None or not len(frames):
            return
        told = module.attributes(frames[0])
        if not told:
            return
        truth = module.scene.true_attributes(module.splats.means.detach().cpu())
        opacity = module.splats.opacities[0].detach()
        errors = attribute_errors(told, truth, opacity)
        table = attribute_errors(module.thermal.prior(module.splats), truth, opacity)
        found = errors | {f"{name}, table": error for name, error in table.items() if name in errors}
        if found:
            module.results.data["attribute_errors"] = found


class LearnedValues(pl.Callback):
    """Writes learned.csv at the end of the test: of each attribute its unit, and what the median Gaussian and nine in ten have.

    Gaussians count by how much of the training views they show (``shown``), so that what stands behind a wall or far outside
    does not, however large; and at one moment, the middle of the record. Where a part of them has what no surface can have, such
    as an absorptivity above 1, the column "remark" says how large it is. Where the scene knows what is true of some attribute,
    the column "truth" has the median of that over the same Gaussians, counted alike.

    Args:
        views: training views, evenly spread, that tell how much Gaussians show; each is rendered once.
        deviations: whether how far the value of a single Gaussian is likely off stands beside, in the median
            (``Uncertainty.of_attributes``); renders every training view several times.
    """

    def __init__(self, views: int = 32, deviations: bool = False) -> None:
        check_count("callbacks.learned.views", views)
        self.views, self.deviations = views, deviations

    def on_test_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        scene = module.scene
        # An id of its own: what is known of that one image is not meant.
        frame = replace(scene.train.frames[0], frame_id=first_free_id(scene))
        if frame.time_s is not None:
            frame = at_time(scene, frame, scene.middle_s)
        told = module.attributes(frame)
        if not told:
            return
        off: dict[str, Tensor] = {}
        # A test allows no gradient, of which weights and deviations are made.
        with torch.inference_mode(False), torch.no_grad():
            weights = shown(module, scene.train.subset(evenly_spread(len(scene.train), self.views))).numpy()
            if self.deviations:
                off = Uncertainty(module).of_attributes(frame)
        true: dict[str, Tensor] = {}
        if scene.true_attributes is not None:
            true = true_values(told, scene.true_attributes(module.splats.means.detach().cpu()))
        rows = []
        for name, of_each in told.items():
            words, unit = words_and_unit(name)
            values = of_each.double().cpu().numpy()
            ends = _quantiles(values, weights, (0.05, 0.5, 0.95))
            if ends is not None:
                low, median, high = (float(f"{end:.6g}") for end in ends)
                usual = _quantiles(off[name].double().cpu().numpy(), weights, (0.5,)) if name in off else None
                deviation = None if usual is None else float(f"{usual[0]:.3g}")
                rows.append(
                    {
                        "name": words,
                        "unit": unit,
                        "median": median,
                        **({"truth": _true_median(true.get(name), values, weights)} if true else {}),
                        "low": low,
                        "high": high,
                        "deviation": deviation,
                        "remark": _remark(impossible(name, values, weights), scene) or None,
                    }
                )
        columns = ("name", "unit", "median", *(["truth"] if true else []), "low", "high", "deviation", "remark")
        write_csv(module.output_dir / LEARNED_FILE, rows, columns)


def _remark(found: str, scene: SceneData) -> str:
    """What is said of a quantity of which ``found`` is impossible; where nothing is, nothing."""
    if not found:
        return ""
    weathers = [frame.environment for frame in scene.train.frames if frame.environment is not None]
    dark = weathers and not any(weather.irradiance_w_m2 for weather in weathers)
    return f"not told by these images: {found}" + ("; none was taken in daylight" if dark else "")


def _true_median(truth: Tensor | None, values: np.ndarray, weights: np.ndarray) -> float | None:
    """Weighted median of what is true of the Gaussians of which the model tells something; None where that is not known."""
    told = np.isfinite(values)
    found = None if truth is None else _quantiles(truth.cpu().numpy()[told], weights[told], (0.5,))
    return None if found is None else float(f"{found[0]:.6g}")


def _quantiles(values: np.ndarray, weights: np.ndarray, shares: tuple[float, ...]) -> np.ndarray | None:
    """Weighted quantiles of the values that are known; None where none is."""
    known = np.isfinite(values) & (weights > 0)
    if not known.any():
        return None
    order = values[known].argsort()
    reached = weights[known][order].cumsum()
    places = np.searchsorted(reached, np.array(shares) * reached[-1])
    return values[known][order][places.clip(max=len(order) - 1)]


def attribute_picture(module: pl.LightningModule, frame: Frame) -> np.ndarray | None:
    """The attribute maps of a view, each with its bar, uint8 RGB; None for models without attributes.

    What has one value everywhere is a number in place of a map. Titles say what part of a map is impossible.
    """
    panels = []
    for name, image in module.attribute_maps(frame).items():
        values = image.double().cpu().numpy()
        words, unit = words_and_unit(name)
        found = impossible(name, values)
        title = f"{words}: {found}" if found else words
        known = values[np.isfinite(values)]
        if not known.size:
            panels.append(text_panel(values.shape, title, "known nowhere"))
            continue
        low, high = bounds_of(known)
        if high - low <= CONSTANT * max(abs(low), abs(high)):
            panels.append(text_panel(values.shape, title, f"{np.median(known):.4g} {unit}".rstrip() + " everywhere"))
        else:
            bar = Bar(low, high, unit, COLORMAP)
            panels.append(Panel(colorize(values, low, high, COLORMAP), title, bar.of(values)))
    return compose(panels, frame.name, COLUMNS) if panels else None
