"""Low resolution made from high: training sees small images, evaluation keeps the originals (SupIR-GS, section 4.1)."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

from torch import Tensor

from heatsplat.contracts import Frame, SceneData, SceneError, View, ViewSet
from heatsplat.geometry.resampling import KERNELS, ends_on, resampled, valid_after

# "lr" is the name that super-resolution papers give to bicubic reduction with antialiasing.
REDUCTIONS = {"lr": "bicubic", "bicubic": "bicubic", "area": "area"}


@dataclass(frozen=True)
class Reduction:
    """By what whole factor the sides of training images shrink, and with which kernel (``geometry.resampling``)."""

    factor: int
    kernel: str

    @classmethod
    def parse(cls, text: str) -> Reduction:
        """The reduction that a word means: "lr4" (bicubic, antialiased, to a quarter) or "area4" (averages; SRGS).

        Raises:
            SceneError: it is no such word, or the factor is less than 2.
        """
        found = re.fullmatch(r"([a-z]+)(\d+)", str(text))
        if not found or found[1] not in REDUCTIONS or int(found[2]) < 2:
            raise SceneError(
                f"data.degrade={text}: write a kernel ({', '.join(REDUCTIONS)}) and a factor of 2 or more, such as lr4"
            )
        return cls(int(found[2]), REDUCTIONS[found[1]])


def degraded(scene: SceneData, degrade: str | None, upsample: str | None = None) -> SceneData:
    """The scene with training images of low resolution; validation and test keep their pixels.

    **Convention:** a reduced image covers what the original covers, and its camera is ``Camera.resized``, so intrinsics
    are exact on both grids, half pixels included. Values that bicubic lets overshoot are clamped to [0, 1]. A pixel
    counts where all pixels that it was made from do.

    Args:
        scene: any scene. Without ``degrade`` it comes back as it is.
        degrade: "lr4", "area2" or the like (``Reduction.parse``), or None.
        upsample: kernel that enlarges the small images again to the original grid, for baselines that train on enlarged
            images: "bilinear", "bicubic" or "lanczos"; None leaves them small.

    Raises:
        SceneError: a factor does not divide the size of a training image, or a word is unknown.
    """
    if upsample is not None and (upsample not in KERNELS or upsample == "area"):
        raise SceneError(f"data.upsample={upsample} is unknown; choose bilinear, bicubic or lanczos")
    if degrade is None:
        if upsample is not None:
            raise SceneError(f"data.upsample={upsample} enlarges degraded images; give data.degrade too, such as lr4")
        return scene
    reduction = Reduction.parse(degrade)
    small = [_reduced_frame(frame, reduction, degrade) for frame in scene.train.frames]
    frames = scene.train.frames if upsample else small
    views: dict[int, View] = {}  # small images are kept: they are few bytes, and making one takes milliseconds

    def reduce(position: int) -> View:
        if position not in views:
            camera = small[position].camera
            view = _on_grid(scene.train[position], small[position], camera.height, camera.width, reduction.kernel)
            views[position] = view
        return views[position]

    def decode(position: int) -> View:
        if upsample is None:
            return reduce(position)
        frame = frames[position]
        return _on_grid(reduce(position), frame, frame.camera.height, frame.camera.width, upsample)

    sizes = Counter(f"{frame.camera.width}x{frame.camera.height}" for frame in small)
    notes = {
        "degraded": f"training images reduced to {', '.join(sizes)} by {degrade} ({reduction.kernel}); tests are not"
    }
    if upsample:
        notes["upsampled"] = f"training images enlarged again to the original grid ({upsample})"
    return replace(scene, train=ViewSet(frames, decode), notes={**scene.notes, **notes}, reduced_by=reduction.kernel)


def _reduced_frame(frame: Frame, reduction: Reduction, degrade: str) -> Frame:
    width, height = frame.camera.width, frame.camera.height
    if width % reduction.factor or height % reduction.factor:
        whole = [f for f in range(2, 17) if width % f == 0 and height % f == 0]
        remedy = f"factors that do: {', '.join(map(str, whole))}" if whole else "no factor up to 16 does"
        raise SceneError(
            f"data.degrade={degrade}: image {frame.name} has {width} x {height} pixels, which {reduction.factor} does "
            f"not divide; {remedy}. data.downscale=1.1, or any above 1, makes images of a size that it divides."
        )
    return replace(frame, camera=frame.camera.resized(width // reduction.factor, height // reduction.factor))


def _on_grid(view: View, frame: Frame, height: int, width: int, kernel: str) -> View:
    """A view on another grid, with the frame that belongs to it."""

    def moved(image: Tensor | None, resample: Callable[..., Tensor]) -> Tensor | None:
        return None if image is None else resample(image, height, width, kernel)

    thermal, rgb = moved(view.thermal, resampled), moved(view.rgb, resampled)
    return View(
        frame,
        thermal=None if thermal is None else thermal.clamp(0.0, 1.0),
        rgb=None if rgb is None else rgb.clamp(0.0, 1.0),
        mask=moved(view.mask, valid_after),
        ends=ends_on(view.ends, height, width),
    )
