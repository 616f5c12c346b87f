"""Videos of pictures."""

from __future__ import annotations

import errno
import logging
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from heatsplat.errors import check_option
from heatsplat.io.files import utf8

log = logging.getLogger("heatsplat")

CODECS = ("auto", "h264", "mpeg4")
QUALITY = 8  # of H.264, of 10: numbers beside the bar stay sharp


@contextmanager
def video(path: str | Path, fps: float = 24.0, codec: str = "auto") -> Iterator[Callable[[np.ndarray], None]]:
    """What takes the RGB pictures of a video one by one: a long one needs the memory of one picture.

    Pictures are [H, W, 3] uint8, all of one size with even sides (codecs work on 2 x 2 blocks).

    Args:
        path: ends in .mp4; its folder is made.
        fps: pictures per second.
        codec: "h264", which browsers play and which needs the extra "video"; "mpeg4" (part 2), which OpenCV writes and
            most players play; "auto" takes the first of them that there is.

    Raises:
        ImportError: codec "h264" without the extra.
        ValueError: no pictures, one of another size or type, an unknown codec, or a path that is not UTF-8 and not H.264.
        OSError: the file cannot be written, or not as a whole.
    """
    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise ValueError(f"{path}: videos are written as MPEG-4, name the file .mp4")
    open_file = encoder(codec)
    path.parent.mkdir(parents=True, exist_ok=True)
    opened: list[tuple[Callable[[np.ndarray], Any], Callable[[], Any]]] = []
    shape: tuple[int, ...] = ()
    count = 0

    def add(picture: np.ndarray) -> None:
        nonlocal shape, count
        if not opened:
            shape = picture.shape
            if picture.ndim != 3 or shape[2] != 3 or shape[0] % 2 or shape[1] % 2:
                raise ValueError(f"video frames are [H, W, 3] with even sides, got {list(shape)}")
            opened.append(open_file(path, (shape[1], shape[0]), fps))
        if picture.shape != shape or picture.dtype != np.uint8:
            raise ValueError(
                f"video frame {count} is {picture.dtype} {list(picture.shape)}, the first was uint8 {list(shape)}"
            )
        opened[0][0](picture)
        count += 1

    try:
        yield add
    finally:
        for _, close in opened:
            close()
    if count == 0:
        raise ValueError(f"{path}: a video needs at least one frame")
    if not _complete(path):  # of which neither encoder says a word
        raise OSError(errno.ENOSPC, "not all of the video was written", str(path))


def encoder(codec: str) -> Callable[[Path, tuple[int, int], float], tuple[Callable, Callable]]:
    """What opens a video of a codec: of path, width and height, and pictures per second it makes what adds and what closes.

    Raises:
        ImportError, ValueError: as ``video``.
    """
    check_option("codec", codec, CODECS)
    if codec == "mpeg4":
        return _opencv
    try:
        package = import_module("imageio_ffmpeg")
    except ImportError as error:
        if codec == "auto":
            log.info("videos are MPEG-4 part 2, which browsers do not play; pip install 'heatsplat[video]' gives H.264")
            return _opencv
        raise ImportError("codec=h264 needs imageio-ffmpeg: pip install 'heatsplat[video]'") from error

    def ffmpeg(path: Path, size: tuple[int, int], fps: float) -> tuple[Callable, Callable]:
        rate = Fraction(fps).limit_denominator(1000)
        options = {"codec": "libx264", "quality": QUALITY, "macro_block_size": 2, "ffmpeg_log_level": "error"}
        writer = package.write_frames(str(path), size, fps=rate, output_params=["-movflags", "faststart"], **options)
        writer.send(None)
        return lambda picture: writer.send(np.ascontiguousarray(picture)), writer.close

    return ffmpeg


def _complete(path: Path) -> bool:
    """Whether a file is a whole MPEG-4: boxes up to its end, with the index ("moov") among them."""
    size, place, kinds = path.stat().st_size, 0, set()
    with path.open("rb") as file:
        while place < size:
            file.seek(place)
            length, kind = struct.unpack(">I4s", file.read(8).ljust(8, b"\0"))
            length = int.from_bytes(file.read(8), "big") if length == 1 else length or size - place
            kinds.add(kind)
            place += max(length, 8)
    return place == size and b"moov" in kinds


def _opencv(path: Path, size: tuple[int, int], fps: float) -> tuple[Callable, Callable]:
    if utf8(str(path)) != os.fsencode(path):  # which ends the process within OpenCV
        raise ValueError(
            f"{utf8(str(path)).decode()}: the name is not UTF-8, which OpenCV cannot write to: rename the folder, or install "
            "H.264 by pip install 'heatsplat[video]'"
        )
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
    if not writer.isOpened():
        raise OSError(f"cannot write {path}: this OpenCV has no MPEG-4 encoder or the folder is read-only")
    return lambda picture: writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)), writer.release
