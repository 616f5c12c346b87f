"""Super-resolution teachers: where a guess of the fine image comes from. Used in training only."""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
import warnings
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor, nn

from heatsplat.contracts import Frame, SceneData, SceneError, View
from heatsplat.geometry.resampling import resampled
from heatsplat.losses import swinir
from heatsplat.losses.masking import filled

log = logging.getLogger(__name__)

INTERPOLATIONS = ("lanczos", "bicubic")
SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg")
# Modes of Pillow in which numbers are no brightness, or have an alpha among them, and what they become.
PLAIN_MODES = dict.fromkeys(("1", "LA", "La"), "L") | dict.fromkeys(("P", "PA"), "RGB")
OVERSHOOT = 0.25  # by which sharp edges of an enlarged image may leave [0, 1]; they are clamped
WHERE = (
    "Give a file with a network (a state dict of SwinIR such as 002_lightweightSR_DIV2K_s64w8_SwinIR-S_x4.pth from "
    "github.com/JingyunLiang/SwinIR/releases; with trust=true also TorchScript or torch.export's .pt2) or a folder with one "
    "enlarged image per training image, by teacher=PATH; or choose interpolation by teacher=lanczos or teacher=bicubic."
)


class Teacher(ABC):
    """A guess of the fine image behind a coarse one.

    Attributes:
        description: what it is, for the log and the report.
    """

    description: str

    def check(self, frame: Frame, factor: int) -> None:
        """Raises SceneError, naming the file and the remedy, when it cannot serve this training image."""
        return

    @abstractmethod
    def __call__(self, image: Tensor, frame: Frame, factor: int) -> Tensor:
        """The image ``factor`` times as fine, [factor H, factor W, C], of [H, W, C] in [0, 1]."""


def load_teacher(source: str | None, cache: str | None = "~/.cache/heatsplat/teacher", trust: bool = False) -> Teacher:
    """The teacher that a word or a path means.

    Args:
        source: "lanczos" or "bicubic"; a folder of enlarged images; or a file that holds a network.
        cache: folder in which a network's answers are kept, so that later runs need not ask again; None keeps none.
        trust: whether a file may run code that it brings along (TorchScript, .pt2); a state dictionary has none.

    Raises:
        SceneError: nothing was chosen, there is no such path, or the file holds no network that is understood or trusted.
    """
    if source in INTERPOLATIONS:
        return Interpolation(source)
    if source is None or str(source) == "":
        raise SceneError(f"this loss learns from a super-resolution teacher, and none is chosen. {WHERE}")
    path = Path(source).expanduser()
    if path.is_dir():
        return Images(path)
    if not path.is_file():
        raise SceneError(f"teacher={source}: there is no file or folder {path.absolute()}. {WHERE}")
    return Network(path, None if cache is None else Path(cache).expanduser(), trust)


class TeacherImages:
    """What is learnt of a teacher's images: made once per training image, kept in half precision.

    Args:
        teacher: gives where fine images come from; called when the first is needed, so that only training loads it.
        factor: how much finer than the training images the teacher's are.
        made: of a teacher's image [factor H, factor W, C] and the target [H, W, C] that it is of, what is kept.
    """

    def __init__(
        self,
        teacher: Callable[[], Teacher],
        factor: int,
        made: Callable[[Tensor, Tensor], tuple[Tensor, ...]],
    ) -> None:
        self._load, self._teacher, self.factor, self._make = teacher, None, factor, made
        self._made: dict[int, tuple[Tensor, ...]] = {}

    def prepare(self, scene: SceneData, modality: str) -> dict[str, str]:
        """Checks that the teacher can serve every training image, asks it for all of them and forgets it.

        Returns what the report should say.
        """
        teacher = self._loaded()
        log.info("super-resolution teacher: %s", teacher.description)
        for frame in scene.train.frames:
            teacher.check(frame, self.factor)
        for view in scene.train:
            self.of(view, view.image(modality))
        self._teacher = None
        return {"teacher": teacher.description}

    @torch.no_grad()
    def of(self, view: View, target: Tensor) -> tuple[Tensor, ...]:
        """What is kept of a training image; the teacher is asked when it is first seen. Masked pixels are filled for it: an edge
        about them would ring in what counts beside."""
        key = view.frame.frame_id
        if key not in self._made:
            target = filled(target, view.mask)
            fine = self._loaded()(target, view.frame, self.factor)
            self._made[key] = tuple(kept.half() for kept in self._make(fine, target))
        return self._made[key]

    def _loaded(self) -> Teacher:
        if self._teacher is None:
            self._teacher = self._load()
        return self._teacher


class Interpolation(Teacher):
    """The coarse image enlarged by a kernel: adds sharpness, knows nothing."""

    def __init__(self, kernel: str) -> None:
        self.kernel = kernel
        self.description = f"{kernel} interpolation (no network)"

    def __call__(self, image: Tensor, frame: Frame, factor: int) -> Tensor:
        height, width = image.shape[:2]
        return resampled(image, factor * height, factor * width, self.kernel).clamp(0.0, 1.0)


class Images(Teacher):
    """A folder of enlarged images, found by the name of the training image whatever its extension.

    Grey or RGB, 8 or 16 bit, or float in [0, 1], encoded like the training images: 0 and full scale are 0 and 1. Images
    in °C are refused, for the teacher does not know the scene's bounds.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.files = {
            path.relative_to(folder).with_suffix("").as_posix().lower(): path
            for path in sorted(folder.rglob("*"))
            if path.suffix.lower() in SUFFIXES
        }
        if not self.files:
            raise SceneError(f"teacher={folder}: the folder holds no image ({', '.join(SUFFIXES)}). {WHERE}")
        self.description = f"images in {folder.name}/"
        self._served: dict[Path, str] = {}  # file -> the training image that it is of

    def check(self, frame: Frame, factor: int) -> None:
        path = self._file_of(frame)
        other = self._served.setdefault(path, frame.name)
        if other != frame.name:
            raise SceneError(
                f"teacher image {path} would be that of {other} and of {frame.name}: put enlarged images into folders of the "
                "same names as the training images'"
            )
        with _opened(path) as image:
            self._check_size(path, image.size, frame, factor)

    def __call__(self, image: Tensor, frame: Frame, factor: int) -> Tensor:
        path = self._file_of(frame)
        with _opened(path) as stored:
            self._check_size(path, stored.size, frame, factor)
            plain = PLAIN_MODES.get(stored.mode)
            pixels = np.asarray(stored if plain is None else stored.convert(plain))
        full = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 65535 if pixels.dtype.kind == "i" else 1
        values = torch.from_numpy(pixels.astype(np.float32) / full)
        low, high = values.min().item(), values.max().item()
        if not (low >= -OVERSHOOT and high <= 1.0 + OVERSHOOT):  # nor where one is NaN
            raise SceneError(
                f"teacher image {path} has values from {low:g} to {high:g}, but must be encoded like the training images, "
                "0 to 1. Of °C subtract the scene's lower bound, divide by the difference of its bounds, and store that"
            )
        values = values[..., None] if values.ndim == 2 else values[..., :3]
        channels = image.shape[2]
        values = values if values.shape[2] == channels else values.mean(2, keepdim=True).expand(-1, -1, channels)
        return values.clamp(0.0, 1.0).to(image.device)

    def _file_of(self, frame: Frame) -> Path:
        name = Path(frame.name).with_suffix("").as_posix().lower()
        path = self.files.get(name) or self.files.get(Path(name).name)
        if path is None:
            raise SceneError(
                f"teacher={self.folder}: there is no image for {frame.name}; it holds {len(self.files)} images such as "
                f"{next(iter(self.files.values())).name}. Every training image needs one of its name."
            )
        return path

    def _check_size(self, path: Path, size: tuple[int, int], frame: Frame, factor: int) -> None:
        expected = (factor * frame.camera.width, factor * frame.camera.height)
        if size != expected:
            raise SceneError(
                f"teacher image {path} has {size[0]} x {size[1]} pixels, but {factor} times the training image "
                f"{frame.name} is {expected[0]} x {expected[1]}"
            )


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """A stored image. Raises SceneError, with the file's name, where it cannot be read."""
    try:
        with Image.open(path) as image:
            yield image
    except SceneError:
        raise
    except Exception as error:  # Pillow raises half a dozen types on a damaged file
        raise SceneError(f"teacher image {path} cannot be read: {error}. Copy it again, or make it again") from error


class Network(Teacher):
    """A super-resolution network from a file, asked once per image; answers are kept on disk.

    It gets [1, 3, H, W] in [0, 1] (grey is repeated) and must return [1, 3, fH, fW].
    """

    def __init__(self, path: Path, cache: Path | None, trust: bool = False) -> None:
        self.path, self.cache = path, cache
        self.network, kind = load_network(path, trust)
        self._digest = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
        self.description = f"{kind} in {path.name} (SHA-256 {self._digest[:8]})"

    def __call__(self, image: Tensor, frame: Frame, factor: int) -> Tensor:
        kept = self._kept(image, factor)
        height, width, channels = image.shape
        if kept is not None:
            answer = _stored(kept, (factor * height, factor * width, channels))
            if answer is not None:
                return answer.to(image.device)
        planes = image.detach().cpu().float().permute(2, 0, 1)[None]
        with torch.no_grad():
            answer = self.network(planes.expand(-1, 3, -1, -1) if channels == 1 else planes)
        if tuple(answer.shape) != (1, 3, factor * height, factor * width):
            raise SceneError(
                f"teacher={self.path}: of an image of {width} x {height} pixels it made {list(answer.shape)}, but "
                f"[1, 3, {factor * height}, {factor * width}] is needed; is it a network for factor {factor}?"
            )
        fine = answer[0].permute(1, 2, 0).clamp(0.0, 1.0)
        fine = fine.mean(2, keepdim=True) if channels == 1 else fine
        fine = fine.half().float()  # as it is kept, so that a later run trains on the same bits
        if not fine.isfinite().all():
            raise SceneError(f"teacher={self.path}: its answer to {frame.name} is not finite")
        if kept is not None:
            try:
                _store(kept, fine)
            except OSError as error:
                log.warning(
                    "the answers of teacher=%s cannot be kept in %s (%s), so every run asks it again; teacher.cache of the "
                    "loss term names another folder, and null keeps none",
                    self.path, self.cache, error.strerror or error,
                )  # fmt: skip
                self.cache = None
        return fine.to(image.device)

    def _kept(self, image: Tensor, factor: int) -> Path | None:
        """Where the answer to an image is kept: named by network, image and factor."""
        if self.cache is None:
            return None
        content = image.detach().cpu().contiguous().numpy().tobytes()
        key = hashlib.sha256(f"{self._digest}/{list(image.shape)}/{factor}/".encode() + content).hexdigest()[:32]
        return self.cache / f"{key}.npy"


def _stored(file: Path, shape: tuple[int, ...]) -> Tensor | None:
    """The answer in a file of the cache; None where there is none of this shape that can be read."""
    try:
        values = np.load(file)
    except (OSError, ValueError, EOFError):
        return None
    return torch.from_numpy(values.astype(np.float32)) if values.shape == shape else None


def _store(file: Path, answer: Tensor) -> None:
    """Writes an answer to a file of the cache. Raises OSError, and leaves nothing, where that cannot be done."""
    file.parent.mkdir(parents=True, exist_ok=True)
    # Jobs share the cache: each writes a file of its own.
    number, partial = tempfile.mkstemp(dir=file.parent, suffix=".part")
    try:
        with os.fdopen(number, "wb") as stream:
            np.save(stream, answer.numpy().astype(np.float16))
        os.chmod(partial, 0o644)
        os.replace(partial, file)
    except OSError:
        os.unlink(partial)
        raise


def load_network(path: Path, trust: bool = False) -> tuple[nn.Module, str]:
    """The network in a file, ready to be asked, and what it is.

    Args:
        path: of the file.
        trust: whether it may run code that it brings along; without, only state dictionaries are loaded.

    Raises:
        SceneError: the file holds none that is understood, with what it holds instead, or brings code and is not trusted.
    """
    untrusted = (
        f"teacher={path} is no state dictionary, and TorchScript and .pt2 files run code that they bring along. If you "
        "trust the place that it comes from, say so with trust=true; else give a state dictionary."
    )
    if path.suffix == ".pt2":
        if not trust:
            raise SceneError(untrusted)
        try:
            return torch.export.load(path).module(), "exported network"
        except Exception as error:
            raise SceneError(f"teacher={path} is no program of torch.export: {error}") from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that it is TorchScript, which is tried below
            stored = torch.load(path, map_location="cpu", weights_only=True)
    except Exception:
        stored = None
    if stored is not None:
        return swinir.from_state_dict(stored, path), "SwinIR"
    if not trust and zipfile.is_zipfile(path):
        raise SceneError(untrusted)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # TorchScript is what many released networks come in
            return torch.jit.load(path, map_location="cpu").eval(), "TorchScript network"
    except Exception as error:
        raise SceneError(
            f"teacher={path} is neither weights that torch can load safely nor TorchScript. {WHERE}"
        ) from error
