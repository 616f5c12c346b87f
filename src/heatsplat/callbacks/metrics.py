"""Scores of the validation and test views: per image, their means, and their course over steps and seconds."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from typing import Any

import pytorch_lightning as pl
from torch import Tensor

from heatsplat.callbacks.board import add_scalars
from heatsplat.contracts import SceneData, SceneError, check_option
from heatsplat.geometry.resampling import with_what_lies_beyond
from heatsplat.io.results import CURVE_FILE
from heatsplat.io.tables import write_csv
from heatsplat.metrics.definitions import DEFINITIONS, IMAGE_SCORES
from heatsplat.metrics.lpips import FILES, LpipsUnavailable, load_lpips
from heatsplat.metrics.mae_roi import scene_threshold
from heatsplat.metrics.scores import Scorer, mean_of_images

log = logging.getLogger("heatsplat")

TEST_FILE = "test_per_image.csv"


class QualityMetrics(pl.Callback):
    """Scores what the camera would record, clamped to [0, 1], against what it did record.

    Validation: means over the views as ``val/*`` against steps and as ``val_by_seconds/*`` against seconds of training
    (evaluation excluded), and a row in curve.csv, with the mean loss since the row before. Test: means into
    ``module.results.test``, every image's scores into test_per_image.csv, what the scores mean into
    ``module.results.definitions``.

    Images that a model explains besides (its companions) are scored as images, under names such as ``rgb_psnr``;
    methods without companions have no such scores. Where the camera has flaws that a sensor chain explains or the scene
    knows, the clean image has scores of its own, ``clean_psnr`` and the like: against the flawless record where it is
    known, and else against the recorded one.

    Args:
        lpips_net: "alex" or "vgg"; values of one net say nothing about the other's. None leaves LPIPS out.
        lpips_weights: file of the backbone's weights; None looks in torch's hub folder, and LPIPS is null if that has none.
        lpips_in_validation: LPIPS costs more than all other scores together, so validation goes without it by default.
        cold_scene: the scene's object is colder than its surroundings (for ThermoNeRF's region of interest).
    """

    def __init__(
        self,
        lpips_net: str | None = "alex",
        lpips_weights: str | None = None,
        lpips_in_validation: bool = False,
        cold_scene: bool = False,
    ) -> None:
        self.lpips_net, self.lpips_weights = lpips_net, lpips_weights
        self.lpips_in_validation, self.cold_scene = lpips_in_validation, cold_scene
        self.curve: list[dict[str, float | None]] = []
        self._scorer = self._image_scorer = Scorer()
        self._companions: tuple[str, ...] = ()
        self._rows: list[dict[str, Any]] = []
        self._empty = 0  # images that have one value everywhere
        self._no_lpips = "not asked for"
        self._checked = False
        self._losses: Tensor | float = 0.0  # of the steps since the last row of the curve
        self._steps = 0

    def setup(self, trainer: pl.Trainer, module: pl.LightningModule, stage: str) -> None:
        """Raises SceneError, before the first step, where LPIPS was asked for by a name or file that cannot serve."""
        if self._checked or self.lpips_net is None:
            return
        check_option("callbacks.metrics.lpips_net", self.lpips_net, (*FILES, None), SceneError)
        if self.lpips_weights is not None:
            try:
                load_lpips(self.lpips_net, self.lpips_weights)
            except LpipsUnavailable as error:
                raise SceneError(f"callbacks.metrics.lpips_weights={self.lpips_weights}: {error}") from error
        self._checked = True  # by fit; a file that is gone once all is learnt costs no test

    # Scores of one image ---------------------------------------------------------------------------------------------

    def _begin(self, module: pl.LightningModule, lpips: bool, threshold: float | None = None) -> None:
        """Makes the scorer of one pass over views."""
        self._rows, self._empty = [], 0
        network = None
        if lpips and self.lpips_net is not None:
            try:
                network = load_lpips(self.lpips_net, self.lpips_weights).to(module.device)
            except LpipsUnavailable as error:
                self._no_lpips = str(error)
        self._scorer = Scorer(module.scene.range_of(module.modality), threshold, self.cold_scene, network)
        self._image_scorer = Scorer(lpips=network)

    def _score(self, module: pl.LightningModule, outputs: Mapping[str, Any]) -> None:
        """Adds one image's row."""
        view, prediction = outputs["view"], outputs["prediction"]
        frame = view.frame
        row = {"name": frame.name, "frame_id": frame.frame_id, "time_s": frame.time_s, "seconds": outputs["seconds"]}
        target = view.image(module.modality)
        if module.modality == "thermal":
            target = with_what_lies_beyond(target, view.ends, prediction)
        row |= self._scorer(prediction, target, view.mask)
        counted = target if view.mask is None else target[view.mask]
        self._empty += counted.numel() > 0 and bool((counted == counted.flatten()[0]).all())
        companions = outputs.get("companions", {})
        for modality, image in companions.items():
            scorer = self._scorer if modality == "clean" else self._image_scorer
            target = view.image(modality)
            if modality == "clean" and view.clean is None:  # the recorded image
                target = with_what_lies_beyond(target, view.ends, image)
            scores = scorer(image, target, view.mask)
            row |= {f"{modality}_{name}": scores[name] for name in _scores_of(modality)}
        self._companions = tuple(companions)
        self._rows.append(row)

    @property
    def _names(self) -> dict[str, str]:
        """Names of all scores of this pass, and under which each is defined."""
        of_companions = {f"{modality}_{name}": name for modality in self._companions for name in _scores_of(modality)}
        return {name: name for name in DEFINITIONS} | of_companions

    # Validation ------------------------------------------------------------------------------------------------------

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, outputs: Any, *_: Any) -> None:
        self._losses = self._losses + outputs["loss"].detach()
        self._steps += 1

    def on_validation_epoch_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self._begin(module, self.lpips_in_validation)

    def on_validation_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, outputs: Any, *_: Any) -> None:
        self._score(module, outputs)

    def on_validation_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.sanity_checking or not self._rows:
            return
        means = {name: mean_of_images(self._rows, name) for name in self._names}
        step, cost = trainer.global_step, module.results.cost
        clocks = {name: cost.get(name) for name in ("train_seconds", "cpu_seconds")}
        self._log(module, "val", means, step)
        if clocks["train_seconds"] is not None:
            self._log(module, "val_by_seconds", means, round(clocks["train_seconds"]), by_steps=False)
        before = self.curve[-1].get("loss") if self.curve and self.curve[-1]["step"] == step else None
        loss = float(self._losses) / self._steps if self._steps else before
        self._losses, self._steps = 0.0, 0
        self.curve = [row for row in self.curve if row["step"] < step]
        self.curve.append({"step": step, **clocks, "gaussians": len(module.splats), "loss": loss, **means})
        write_csv(module.output_dir / CURVE_FILE, self.curve, tuple(self.curve[-1]))

    # Test ------------------------------------------------------------------------------------------------------------

    def on_test_epoch_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        known = module.scene.range_of(module.modality) is not None
        threshold = scene_threshold(_all_images(module.scene)) if known else None
        self._begin(module, lpips=True, threshold=threshold)

    def on_test_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, outputs: Any, *_: Any) -> None:
        self._score(module, outputs)

    def on_test_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        results, count = module.results, len(self._rows)
        for name, defined_as in self._names.items():
            definition = DEFINITIONS[defined_as]
            value = mean_of_images(self._rows, name) if count else None
            results.put("test", name, value, None if value is not None else self._why_not(defined_as, module))
            having = sum(row[name] is not None for row in self._rows)
            unit = f"{definition.unit}, " if definition.unit else ""
            some = f"; mean of the {having} of {count} test images that have one" if 0 < having < count else ""
            results.definitions[name] = f"{unit}{definition.better} is better: {definition.sentence}{some}"
        if self._scorer.lpips is not None:
            for name in (name for name, defined_as in self._names.items() if defined_as == "lpips"):
                results.definitions[name] = f"lower is better: {self._scorer.lpips.description}"
        results.definitions["scored"] = (
            f"the image that the camera would record, clamped to [0, 1], {module.modality}; mean of {count} test images"
        )
        if "clean" in self._companions:
            known = module.scene.test[0].clean is not None
            results.definitions["clean_..."] = "the image without what the camera adds, scored against " + (
                "one that is known to be without it"
                if known
                else "the recorded image, for no other is known: errors hold what the camera added"
            )
        if self._scorer.threshold is not None:
            results.definitions["scene_threshold_c"] = module.scene.thermal_range.to_celsius(self._scorer.threshold)
        if not count:
            return
        results.data["test_pixels_counted"] = mean_of_images(self._rows, "counted")
        results.data["test_pixels_saturated"] = mean_of_images(self._rows, "saturated")
        if self._empty:
            results.data["test_images_of_one_value"] = self._empty
            log.warning(
                "%d of %d test images have one value everywhere (black?): any model scores well on them, so their PSNR and SSIM "
                "say nothing. Look at the images and at the thermal range",
                self._empty, count,
            )  # fmt: skip
        self._log(module, "test", results.test, trainer.global_step)
        write_csv(module.output_dir / TEST_FILE, self._rows)

    def _why_not(self, name: str, module: pl.LightningModule) -> str:
        """Why no test image has this score."""
        if not self._rows:
            return "no test view was rendered"
        if name == "lpips":
            small = "the images are smaller than the net can take"
            return small if self._scorer.lpips is not None else self._no_lpips
        if not any(row["counted"] for row in self._rows):
            return "the masks leave no pixel of the test images"
        if name == "ssim":
            return "no window of 11 x 11 pixels lies within image and mask"
        if module.modality != "thermal":
            return f"{module.modality} images are no temperatures"
        if module.scene.thermal_range is None:
            return "the scene has no temperature bounds"
        if self._rows[0]["mae_c"] is None and "roi" not in name:
            return "the images have no channel of temperature (pseudo-colour), or every error exceeds the outlier rule"
        return "no test image has a region of interest with such pixels"

    def _log(
        self,
        module: pl.LightningModule,
        tag: str,
        scores: Mapping[str, float | None],
        step: int,
        by_steps: bool = True,
    ) -> None:
        """Scores to the loggers (``add_scalars``) and to the trainer, where checkpoints may monitor them.

        Lightning's own way to the logger counts steps from zero, one less than every other curve.
        """
        known = {f"{tag}/{name}": value for name, value in scores.items() if value is not None}
        module.log_dict(known, logger=False)
        add_scalars(module, known, step, by_steps)

    # Resume ----------------------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        curve = [dict(row) for row in self.curve]
        return {"curve": curve, "losses": float(self._losses), "steps": self._steps}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.curve = [dict(row) for row in state["curve"]]
        self._losses, self._steps = state["losses"], state["steps"]


def _scores_of(companion: str) -> tuple[str, ...]:
    """The scores that a further image has: the clean one is an image of temperature like the recorded one."""
    return (*IMAGE_SCORES, "mae_c") if companion == "clean" else IMAGE_SCORES


def _all_images(scene: SceneData) -> Iterable[tuple[Tensor, Tensor | None]]:
    """Every thermal image of a scene once, with its mask; splits may share frames."""
    seen: set[int] = set()
    for views in (scene.train, scene.val, scene.test):
        for i, frame in enumerate(views.frames):
            if frame.frame_id not in seen:
                seen.add(frame.frame_id)
                view = views[i]
                if view.thermal is not None and view.thermal.shape[-1] == 1:
                    yield view.thermal, view.mask
