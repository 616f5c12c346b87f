"""What finds features in images and matches them."""

from __future__ import annotations

import pickle
import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from heatsplat.contracts import SceneError, check_numbers
from heatsplat.datamodules.formats.colmap_library import pycolmap
from heatsplat.datamodules.formats.images import read_grey

WEIGHTS = ("aliked-n16.pth", "aliked_lightglue.pth")
DESCRIPTOR = 128  # numbers of a descriptor of ALIKED


class Features(ABC):
    """Finds features of images and matches of pairs, and writes them into a COLMAP database."""

    @abstractmethod
    def extract(self, database: Path, images: Path, name: str, reader: pycolmap.ImageReaderOptions) -> None:
        """Adds an image of the folder ``images`` with its features; all images of its folder share one camera."""

    @abstractmethod
    def match(self, database: Path, pairs: Sequence[tuple[str, str]], file: Path, seed: int) -> None:
        """Adds verified matches of pairs of names, of which some may be there already; ``file`` may be written."""


@dataclass(frozen=True)
class Sift(Features):
    """SIFT of COLMAP (Lowe 2004, root normalised), matched by ratio.

    Args:
        most: features of an image.
        peak: threshold on the difference of Gaussians.
        ratio: between the nearest descriptor and the second.
    """

    most: int = 4096
    peak: float = 0.003
    ratio: float = 0.85

    def __post_init__(self) -> None:
        for name in ("most", "peak", "ratio"):
            check_numbers(f"poses.features.{name}", getattr(self, name), error=SceneError, above=0)

    def extract(self, database: Path, images: Path, name: str, reader: pycolmap.ImageReaderOptions) -> None:
        options = pycolmap.FeatureExtractionOptions(num_threads=1)
        options.sift.max_num_features, options.sift.peak_threshold = self.most, self.peak
        pycolmap.extract_features(
            database, images, [name], pycolmap.CameraMode.SINGLE, reader, options, pycolmap.Device.cpu
        )

    def match(self, database: Path, pairs: Sequence[tuple[str, str]], file: Path, seed: int) -> None:
        file.write_text("".join(f"{a} {b}\n" for a, b in pairs))
        options = pycolmap.FeatureMatchingOptions(num_threads=1)
        options.sift.max_ratio = self.ratio
        pycolmap.match_image_pairs(
            database,
            options,
            pycolmap.ImportedPairingOptions(match_list_path=file),
            verification(seed),
            pycolmap.Device.cpu,
        )


@dataclass(frozen=True)
class Aliked(Features):
    """ALIKED (Zhao et al. 2023) and LightGlue (Lindenberger et al. 2023) of kornia, with weights that lie on disk.

    Args:
        most: features of an image.
    """

    most: int = 2048

    def __post_init__(self) -> None:
        """Says before any work is done what is missing: SceneError for weights, ImportError for an old kornia."""
        check_numbers("poses.features.most", self.most, error=SceneError, above=0)
        try:
            from kornia.feature import ALIKED, LightGlue  # noqa: F401
        except ImportError as error:
            raise ImportError("poses/features=aliked needs kornia 0.9 or newer: pip install -U kornia") from error
        if missing := [name for name in WEIGHTS if not (_weights_folder() / name).is_file()]:
            raise SceneError(
                f"ALIKED and LightGlue need their weights on disk: put {' and '.join(missing)} into {_weights_folder()} "
                f"({WEIGHTS[0]} from models/ of Shiaoming/ALIKED, {WEIGHTS[1]} from the releases of cvg/LightGlue, both on "
                "GitHub), or use poses/features=sift"
            )

    def extract(self, database: Path, images: Path, name: str, reader: pycolmap.ImageReaderOptions) -> None:
        pycolmap.Database.open(database).close()  # which has to be there
        pycolmap.import_images(database, images, pycolmap.CameraMode.SINGLE, [name], reader)
        grey = read_grey(images / name)
        image = torch.from_numpy(grey).float()[None, None] / 255.0
        with torch.no_grad():
            found = self._networks[0](image)[0]
        keypoints = found.keypoints.numpy() + 0.5  # kornia counts from the centre of the first pixel
        np.savez(
            _descriptors(database, name),
            keypoints=found.keypoints.numpy(),
            descriptors=found.descriptors.numpy(),
            size=grey.shape,
        )
        with pycolmap.Database.open(database) as opened:
            opened.write_keypoints(opened.read_image_with_name(name).image_id, keypoints.astype(np.float32))

    def match(self, database: Path, pairs: Sequence[tuple[str, str]], file: Path, seed: int) -> None:
        todo = []
        with pycolmap.Database.open(database) as opened:
            number = {image.name: image.image_id for image in opened.read_all_images()}
            for a, b in pairs:
                if opened.exists_two_view_geometry(number[a], number[b]):
                    continue
                todo.append((a, b))
                if not opened.exists_matches(number[a], number[b]):
                    opened.write_matches(number[a], number[b], self._matched(_read(database, a), _read(database, b)))
        if todo:
            file.write_text("".join(f"{a} {b}\n" for a, b in todo))
            pycolmap.verify_matches(database, file, verification(seed))

    def _matched(self, one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> np.ndarray:
        if min(len(one["keypoints"]), len(other["keypoints"])) < 2:
            return np.zeros((0, 2), np.uint32)
        sides = [
            {
                "keypoints": s["keypoints"][None],
                "descriptors": s["descriptors"][None],
                "image_size": s["size"].flip(0)[None].float(),
            }
            for s in (one, other)
        ]
        with torch.no_grad():
            return self._networks[1]({"image0": sides[0], "image1": sides[1]})["matches"][0].numpy().astype(np.uint32)

    @cached_property
    def _networks(self) -> tuple[Any, Any]:
        """Detector and matcher. Raises SceneError for a file that holds other weights."""
        from kornia.feature import ALIKED, LightGlue

        one, other = (_weights_folder() / name for name in WEIGHTS)
        detector = ALIKED("aliked-n16", max_num_keypoints=self.most)
        return _filled(detector, one), _filled(LightGlue(None, input_dim=DESCRIPTOR, weights=None), other)


def _weights_folder() -> Path:
    return Path(torch.hub.get_dir()) / "checkpoints"


def _filled(network: Any, file: Path) -> Any:
    """A network with the weights of a file as it was released, ready for use."""
    try:
        state = torch.load(file, map_location="cpu", weights_only=True)
        # LightGlue's releases call the halves of a layer self_attn.3 and cross_attn.3, kornia transformers.3.self_attn.
        renamed = {re.sub(r"^(self_attn|cross_attn)\.(\d+)", r"transformers.\2.\1", key): v for key, v in state.items()}
        lacking = {name for name, _ in network.named_parameters()} & set(
            network.load_state_dict(renamed, strict=False).missing_keys
        )
    except (OSError, RuntimeError, AttributeError, pickle.UnpicklingError) as error:
        raise SceneError(f"{file} holds no weights of {type(network).__name__} ({error}); download it again") from error
    if lacking:
        raise SceneError(
            f"{file} lacks {len(lacking)} weights of {type(network).__name__}, such as {min(lacking)}; download it again"
        )
    return network.eval()


def _descriptors(database: Path, name: str) -> Path:
    file = database.parent / "features" / f"{name}.npz"
    file.parent.mkdir(parents=True, exist_ok=True)
    return file


def _read(database: Path, name: str) -> dict[str, torch.Tensor]:
    with np.load(_descriptors(database, name)) as stored:
        return {key: torch.from_numpy(stored[key]) for key in stored.files}


def verification(seed: int) -> pycolmap.TwoViewGeometryOptions:
    """How pairs are verified. Matches that stand still in the image are a detector's pattern, and not of the scene."""
    options = pycolmap.TwoViewGeometryOptions(filter_stationary_matches=True, stationary_matches_max_error=1.0)
    options.ransac.random_seed = seed
    options.ransac.max_error = 3.0
    return options
