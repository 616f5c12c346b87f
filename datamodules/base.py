"""The Lightning side of a scene: the options that all loaders share, and the data loaders.

``RawFrame``, ``Lens``, ``Counts`` and ``build_scene`` (``heatsplat.datamodules.assemble``) are what a loader works with.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_lightning as pl
from torch.utils.data import DataLoader

from heatsplat.contracts import SceneData, SceneError, check_option, counted
from heatsplat.datamodules.assemble import build_scene
from heatsplat.datamodules.bounds import Spans
from heatsplat.datamodules.formats.images import ImageIndex, read_image, split_alpha, to_grey
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.formats.palette import palette_of
from heatsplat.datamodules.formats.pseudo_colour import PaletteReader
from heatsplat.datamodules.lowres import Reduction, degraded
from heatsplat.datamodules.raw_scene import CELSIUS, Counts, RawFrame, RawScene, SceneOptions
from heatsplat.datamodules.splits import SplitRule
from heatsplat.datamodules.weather import with_weather
from heatsplat.training.sampler import StepSampler

__all__ = ["CELSIUS", "Counts", "Lens", "RawFrame", "RawScene", "SceneDataModule", "SceneOptions", "build_scene"]

REPORT_FILE = "report.html"  # of a preparation
MASKS = "masks"

log = logging.getLogger(__name__)


class SceneDataModule(pl.LightningDataModule, ABC):
    """One scene, loaded once. A data set is one file with one subclass that implements ``load``.

    Args:
        root: folder of the data set, relative to the caller's working directory.
        scene: name of the scene below ``root``; None when ``root`` is the scene itself.
        downscale: factor by which images shrink, 1 or larger.
        split: every_8th, quarter_centre, block, names, folders, json, list or all (``heatsplat.datamodules.splits``).
        split_fraction: share of the frames that ``block`` holds out.
        split_position: where its stretch lies in time, 0 (start) to 1 (end).
        split_file: file of test names for ``list``, relative to the scene or the working directory.
        every: of the training frames of each camera every so many-th is used (``SceneOptions``).
        seed: of the order of views, and of random points where a scene has none.
        thermal_channels: 1, or 3 for pseudo-colour without temperatures.
        palette: of thermal images in pseudo-colour, by name or file, which makes greys of them (``palette_of``); None for none.
        palette_hot: side at which the picture of a colour bar in ``palette`` is hottest; None for top or right.
        masks: folder in the scene with a mask <image name>.png per image (COLMAP's rule), which need not be there; None for none.
        mask_keep: "white" when white pixels count (COLMAP), "black" when they are left out.
        alpha_mask: True to leave out transparent pixels.
        degrade, upsample: how training images lose resolution, and are enlarged again (``heatsplat.datamodules.lowres``).

    Attributes:
        restarts: first steps of the rounds of a run but the first; the run sets them.
    """

    restarts: Sequence[int] = ()

    def __init__(
        self,
        *,
        root: str | None = None,
        scene: str | None = None,
        downscale: float = 1.0,
        split: str = "every_8th",
        split_fraction: float = 0.125,
        split_position: float = 0.5,
        split_file: str | None = None,
        every: int = 1,
        seed: int = 0,
        thermal_channels: int = 1,
        palette: str | None = None,
        palette_hot: str | None = None,
        masks: str | None = MASKS,
        mask_keep: str = "white",
        alpha_mask: bool = False,
        degrade: str | None = None,
        upsample: str | None = None,
    ) -> None:
        super().__init__()
        check_option("data.mask_keep", mask_keep, ("white", "black"), SceneError)
        self.root = root
        self.degrade, self.upsample = degrade, upsample
        self.scene_name = scene
        self.downscale = downscale
        # Where files that settings name are looked for first; None where the data set has no folder.
        self._folder = Path(root).expanduser() / (scene or "") if root else None
        self.split = SplitRule(split, split_fraction, split_position, split_file or None, self._folder)
        self.every = every
        self.seed = seed
        self.thermal_channels = thermal_channels
        self.palette, self.palette_hot = palette, palette_hot
        self.masks = masks
        self.mask_keep = mask_keep
        self.alpha_mask = alpha_mask

    @abstractmethod
    def load(self) -> SceneData:
        """The scene, read from disk or made up. Called once."""

    @cached_property
    def scene(self) -> SceneData:
        """The loaded scene, its training images reduced where that is asked for."""
        loaded = self.load()
        if not isinstance(loaded, SceneData):
            raise SceneError(
                f"{type(self).__name__}.load returned {type(loaded).__name__}; it must return a SceneData, as self.finish(...) "
                "does"
            )
        scene = degraded(loaded, self.degrade, self.upsample)
        log.info("scene %s: %d training, %d test views", scene.name, len(scene.train), len(scene.test))
        return scene

    def change_weather(self, path: Path, zone: str | None = None) -> None:
        """Puts the scene under the weather of another table, for its place; ``heatsplat.datamodules.weather.with_weather``."""
        self.scene = with_weather(self.scene, path, zone)

    def setup(self, stage: str | None = None) -> None:
        """Loads the scene, so that bad input is reported before anything else is built."""
        _ = self.scene

    def train_dataloader(self) -> DataLoader:
        """One view per step, from the current step of the trainer on, without end; each round of a run begins a new pass."""
        step = self.trainer.global_step if self.trainer else 0
        sampler = StepSampler(len(self.scene.train), self.seed, step, self.restarts)
        return DataLoader(self.scene.train, sampler=sampler, batch_size=None, num_workers=0)

    def val_dataloader(self) -> DataLoader:
        """The views that draw curves during training."""
        return DataLoader(self.scene.val, batch_size=None, num_workers=0)

    def test_dataloader(self) -> DataLoader:
        """All held-out views."""
        return DataLoader(self.scene.test, batch_size=None, num_workers=0)

    def scene_folder(
        self, is_scene: Callable[[Path], bool], looked_for: str, nearly: Callable[[Path], str] = lambda _: ""
    ) -> Path:
        """The folder of the scene: ``root``/``scene``, or ``root`` itself when no scene is named.

        Args:
            is_scene: whether a folder holds a scene of this data set.
            looked_for: what makes it one, for the message.
            nearly: what makes one of a folder that nearly is, in words; empty for others.

        Raises:
            SceneError: no root, or no such scene; the message lists the scenes that are there.
        """
        if not self.root:
            raise SceneError("data.root is not set; give the folder of the data set, as in data.root=/data/my_scenes")
        root = Path(self.root).expanduser().absolute()
        if not root.is_dir():
            near = next(p for p in root.parents if p.is_dir())
            raise SceneError(f"data.root={self.root}: there is no folder {root}; {near} holds {_listed(near)}")
        if self.scene_name is None:
            if is_scene(root):
                return root
            scenes = [p.name for p in sorted(root.iterdir()) if p.is_dir() and is_scene(p)]
            raise SceneError(
                f"data.root={root} is no scene itself ({looked_for} is missing); "
                + (
                    f"choose one with data.scene: {', '.join(scenes)}"
                    if scenes
                    else f"it holds {_listed(root)}. {nearly(root) or _towards_a_scene(root)}"
                )
            )
        folder = root / self.scene_name
        if not folder.is_dir():
            raise SceneError(
                f"data.scene={self.scene_name}: there is no such scene in {root}; it holds {_listed(root)}"
            )
        if not is_scene(folder):
            hint = f". {hint}" if (hint := nearly(folder)) else ""
            raise SceneError(
                f"data.scene={self.scene_name}: {looked_for} is missing; {folder} holds {_listed(folder)}{hint}"
            )
        return folder

    def mask_index(self, scene: Path) -> ImageIndex | None:
        """The masks in a scene's folder, None where none are to be used. Raises SceneError where a folder that was named is not
        there."""
        if not self.masks:
            return None
        folder = scene / self.masks
        if self.masks != MASKS and not folder.is_dir():
            raise SceneError(f"data.masks={self.masks}: there is no folder {folder}; data.masks=null uses no masks")
        return ImageIndex(folder)

    def mask_reader(self, masks: ImageIndex | None, image_name: str) -> Callable[[], np.ndarray] | None:
        """Reads the mask of an image as [H, W] bool, True where a pixel counts; None where there is no mask."""
        file = None if masks is None else masks.find(f"{image_name}.png") or masks.find(image_name)
        return None if file is None else partial(_read_mask, masks.folder / file, self.mask_keep == "white")

    def warn_of_masks(self, masks: ImageIndex | None, frames: Sequence[RawFrame]) -> None:
        """Warns of masks that are not used, as none has the name of an image."""
        if masks and masks.names and not any(frame.read_mask for frame in frames):
            log.warning(
                "%s: none of its %s is named after an image, such as %s.png, and no mask is used; there are names like %s",
                *(masks.folder, counted(len(masks.names), "file"), frames[0].name, masks.names[0]),
            )

    def finish(
        self,
        name: str,
        frames: Sequence[RawFrame],
        points: np.ndarray,
        split: SplitRule | None = None,
        spans: Spans | None = None,
        **scene: Any,
    ) -> SceneData:
        """``build_scene`` of a ``RawScene`` with this module's options; thermal images have ``spans`` where there are such."""
        if spans is not None and all(frame.read for frame in frames):
            span_of = spans.of([frame.name for frame in frames])
            frames = [replace(frame, span=span_of[frame.name]) for frame in frames]
        multiple = Reduction.parse(self.degrade).factor if self.degrade else 1
        options = SceneOptions(
            split or self.split,
            self.downscale,
            self.thermal_channels,
            self.alpha_mask,
            multiple,
            self.every,
            self._palette_reader(),
        )
        return build_scene(RawScene(name, frames, points, **scene), options)

    def _palette_reader(self) -> PaletteReader | None:
        """What makes levels of colours; None where no palette is given."""
        if self.palette is None:
            if self.palette_hot is not None:
                raise SceneError(
                    f"data.palette_hot={self.palette_hot} says how a colour bar lies; give it as data.palette"
                )
            return None
        return PaletteReader(palette_of(str(self.palette), self.palette_hot, self._folder))


def _read_mask(path: Path, white_counts: bool) -> np.ndarray:
    pixels = to_grey(split_alpha(read_image(path))[0])
    return (pixels > 0) == white_counts


def _towards_a_scene(folder: Path) -> str:
    """What makes a scene of a folder that is none, in words."""
    if (folder / REPORT_FILE).is_file():
        return f"A preparation left it without cameras: {REPORT_FILE} in it says why"
    return (
        "Of a camera's files, prepare.py source=FOLDER target=OTHER makes a scene in another folder, to be given here"
    )


def _listed(folder: Path, most: int = 20) -> str:
    """Names in a folder, for messages."""
    names = sorted(p.name + "/" * p.is_dir() for p in folder.iterdir() if not p.name.startswith("."))
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return (", ".join(names[:most]) + more) or "nothing"
