"""Videos of pictures."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np


def write_video(path: str | Path, frames: Iterable[np.ndarray], fps: float = 24.0) -> int:
    """Writes RGB pictures as an MPEG-4 video and returns their number.

    Frames are taken one by one, so that a long video needs the memory of one picture.

    Args:
        path: ends in .mp4; its folder is made.
        frames: [H, W, 3] uint8, all of one size with even sides (the codec works on 2 x 2 blocks).
        fps: frames per second.

    Raises:
        ValueError: no frames, or one of another size or type.
        OSError: the codec or the file is not there.
    """
    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise ValueError(f"{path}: videos are written as MPEG-4, name the file .mp4")
    path.parent.mkdir(parents=True, exist_ok=True)
    writer, shape, count = None, None, 0
    try:
        for frame in frames:
            if writer is None:
                shape = frame.shape
                if frame.ndim != 3 or shape[2] != 3 or shape[0] % 2 or shape[1] % 2:
                    raise ValueError(f"video frames are [H, W, 3] with even sides, got {list(shape)}")
                size = (shape[1], shape[0])
                writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
                if not writer.isOpened():
                    raise OSError(f"cannot write {path}: this OpenCV has no MPEG-4 encoder or the folder is read-only")
            if frame.shape != shape or frame.dtype != np.uint8:
                raise ValueError(
                    f"video frame {count} is {frame.dtype} {list(frame.shape)}, the first was uint8 {list(shape)}"
                )
            writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
            count += 1
    finally:
        if writer is not None:
            writer.release()
    if count == 0:
        raise ValueError(f"{path}: a video needs at least one frame")
    return count
