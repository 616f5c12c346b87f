"""Temperatures as pictures in which features can be found: one stretch for all frames, then local equalisation.

The copies serve the search for features alone. What is trained on never passes through them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
import torch

from heatsplat.contracts import SceneError, evenly_spread
from heatsplat.physics.defects import dead_pixels

SAMPLE_FRAMES, SAMPLE_PIXELS, DEAD_FRAMES = 32, 200_000, 8  # from which span and dead pixels are taken


class Stretch:
    """From temperatures to 8 bits, in the same way for every frame of a recording.

    The level of each frame is taken out (an uncooled camera drifts by kelvins between shutters), then a span that the frames
    share is stretched, then contrast is equalised in tiles (CLAHE). Dead pixels are filled first: they stand still while
    the camera moves, and would be matched with themselves.

    Args:
        loads: functions that return the frames [H, W] in °C, NaN where unknown.
        clip: limit of the contrast that equalisation may add (OpenCV's clipLimit).
        percentiles: of the pixels of all frames less their median, which become black and white.

    Raises:
        SceneError: the frames show nothing: they are constant or unknown.
    """

    def __init__(
        self,
        loads: Sequence[Callable[[], np.ndarray]],
        clip: float = 3.0,
        percentiles: tuple[float, float] = (0.5, 99.5),
    ) -> None:
        sample = [loads[i]() for i in evenly_spread(len(loads), SAMPLE_FRAMES)]
        same = [frame for frame in sample if frame.shape == sample[0].shape]
        self.dead = dead_pixels(torch.from_numpy(np.stack(same[:DEAD_FRAMES]))).numpy()
        self.clip = clip
        rng = np.random.default_rng(0)
        taken = []
        for celsius in sample:
            known = celsius[np.isfinite(celsius) & ~self.dead] if celsius.shape == self.dead.shape else celsius.ravel()
            if known.size:
                few = rng.choice(known, min(known.size, SAMPLE_PIXELS // len(sample)), replace=False)
                taken.append(few - np.median(known))
        if not taken:
            raise SceneError("no pixel of the frames has a temperature; there is nothing by which to find cameras")
        low, high = np.percentile(np.concatenate(taken), percentiles)
        if not low < high:
            raise SceneError("the frames show one temperature throughout; there is nothing by which to find cameras")
        self.low, self.high = float(low), float(high)

    def __call__(self, celsius: np.ndarray) -> np.ndarray:
        """The 8-bit copy [H, W] of a frame."""
        known = np.isfinite(celsius)
        level = np.median(celsius[known]) if known.any() else 0.0
        centred = np.where(known, celsius - level, 0.0).astype(np.float32)
        if celsius.shape == self.dead.shape:
            centred[self.dead] = cv2.medianBlur(centred, 5)[self.dead]
        unit = np.clip((centred - self.low) / (self.high - self.low), 0.0, 1.0)
        fine = np.rint(unit * 65535.0).astype(np.uint16)
        equalised = cv2.createCLAHE(self.clip, (8, 8)).apply(fine)
        return np.rint(equalised / 257.0).astype(np.uint8)
