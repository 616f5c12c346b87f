"""What drift does to a map: the seams of a mosaic of recorded images, and how large the steps across them are."""

from __future__ import annotations

import logging
from collections.abc import Mapping

import numpy as np
import torch
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import median_filter, uniform_filter
from torch import Tensor
from torch.nn.functional import interpolate

from heatsplat.contracts import SceneData, SceneError
from heatsplat.geometry.projection import to_camera, to_pixels
from heatsplat.io.pictures import ERROR, Bar, Panel, bounds_of, colorize, compose, error_limit_of

log = logging.getLogger("heatsplat")

WINDOW = 9  # pixels over which a side of a seam is averaged
APART = 7  # pixels from a seam to the middle of its side
GROUND = 32  # pixels of a block of the ground
LEAST = 40  # pairs of pixels of a seam that counts


def mosaic(scene: SceneData, points: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """°C (or image values) [H, W] of a mosaic, NaN where no image is, and which training view each pixel is of (-1: none).

    Every pixel is what that training image recorded whose middle is nearest, as programs for maps make them.

    Args:
        scene: with its training views.
        points: [H, W, 3] of the map in the world.
    """
    shape = points.shape[:2]
    nearest = torch.full(shape, torch.inf, dtype=torch.float64)
    values = torch.full(shape, torch.nan, dtype=torch.float64)
    owner = torch.full(shape, -1)
    for i in range(len(scene.train)):
        view = scene.train[i]
        if view.thermal is None:
            raise SceneError(f"what.against compares temperatures, and scene '{scene.name}' has no thermal images")
        camera, image = view.camera, view.thermal[..., 0].double()
        local = to_camera(points.reshape(-1, 3), camera.viewmat).view(*shape, 3)
        place = to_pixels(local.reshape(-1, 3), camera.K).view(*shape, 2).nan_to_num(-1)
        column, row = place.floor().clamp(-1, 1e6).long().unbind(-1)
        inside = (local[..., 2] > 0) & (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
        row, column = row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)
        if view.mask is not None:
            inside &= view.mask[row, column]
        away = (place - torch.tensor([camera.width / 2, camera.height / 2])).square().sum(-1)
        better = inside & (away < nearest)
        nearest[better] = away[better]
        values[better] = image[row, column][better]
        owner[better] = i
    celsius = values if scene.thermal_range is None else scene.thermal_range.to_celsius(values)
    return celsius.numpy(), owner.numpy()


def smoothed(depth: Tensor) -> Tensor:
    """A depth map [H, W] as the ground as a whole lies: medians of blocks and of their neighbours, linear in between."""
    height, width = depth.shape
    known = torch.where(depth.isfinite(), depth, torch.nan).double().numpy()
    if not np.isfinite(known).any():
        return depth.double()
    rows, columns = (-(-side // GROUND) for side in (height, width))
    padded = np.full((rows * GROUND, columns * GROUND), np.nan)
    padded[:height, :width] = known
    cells = padded.reshape(rows, GROUND, columns, GROUND).swapaxes(1, 2).reshape(rows, columns, -1)
    enough = np.isfinite(cells).any(-1)
    blocks = np.full((rows, columns), np.median(known[np.isfinite(known)]))
    blocks[enough] = np.nanmedian(cells[enough], axis=-1)
    blocks = torch.from_numpy(median_filter(blocks, 5, mode="nearest"))[None, None]
    return interpolate(blocks, (rows * GROUND, columns * GROUND), mode="bilinear", align_corners=False)[
        0, 0, :height, :width
    ]


def step_across(values: np.ndarray, owner: np.ndarray) -> tuple[float, int]:
    """Root mean square over seams of the mean step across each, in the unit of the values, and how many seams there are.

    A seam is where two training views meet. Both sides are averaged over a window, so that texture counts little.

    Args:
        values: [H, W] of a map, or of its difference to one without seams, which leaves out what the ground does; NaN where
            there is none.
        owner: [H, W] of ``mosaic``.
    """
    known = np.isfinite(values)
    share = uniform_filter(known.astype(float), WINDOW)
    smooth = np.where(share > 0.5, uniform_filter(np.where(known, values, 0.0), WINDOW) / share.clip(1e-9), np.nan)
    steps: dict[tuple[int, int], list[np.ndarray]] = {}
    for axis in (0, 1):
        one, other, low, high = (np.moveaxis(a, axis, 0) for a in (owner, owner, smooth, smooth))
        one, other = one[APART - 1 : -APART], other[APART : len(other) - APART + 1]
        low, high = low[: len(one)], high[len(high) - len(one) :]
        crossed = (one != other) & (one >= 0) & (other >= 0) & np.isfinite(low) & np.isfinite(high)
        for first, second, step in zip(one[crossed], other[crossed], (high - low)[crossed], strict=True):
            pair = (min(first, second), max(first, second))
            steps.setdefault(pair, []).append(step if first < second else -step)
    means = [np.mean(found) for found in steps.values() if len(found) >= LEAST]
    return (float(np.sqrt(np.mean(np.square(means)))), len(means)) if means else (float("nan"), 0)


def shift_between(one: np.ndarray, other: np.ndarray) -> tuple[int, int, float, float]:
    """By how many rows and columns one map lies further down and to the right than another, by where they correlate most, and
    how much they do there and as they lie; NaN where too few pixels of both are known.

    Only pixels that both maps know count (masked normalised cross-correlation; Padfield, IEEE Trans. Image Process. 21, 2012).

    Args:
        one, other: [H, W], NaN where there is none.
    """
    shape = [next_fast_len(2 * side - 1, real=True) for side in other.shape]
    masks = [np.isfinite(values).astype(float) for values in (one, other)]
    filled = [
        np.where(m > 0, v - np.mean(v[m > 0]), 0.0) if m.any() else m for v, m in zip((one, other), masks, strict=True)
    ]
    spectra = [[rfft2(m, shape), rfft2(v, shape), rfft2(v**2, shape)] for v, m in zip(filled, masks, strict=True)]

    def sums(of_one: int, of_other: int) -> np.ndarray:
        return irfft2(spectra[0][of_one] * spectra[1][of_other].conj(), shape)

    count = sums(0, 0).round()
    enough = count >= max(LEAST, 0.5 * count.max())
    number = count.clip(1.0)
    spread = (sums(2, 0) - sums(1, 0) ** 2 / number).clip(0.0) * (sums(0, 2) - sums(0, 1) ** 2 / number).clip(0.0)
    alike = (sums(1, 1) - sums(1, 0) * sums(0, 1) / number) / np.sqrt(spread).clip(1e-12)
    alike[~enough] = np.nan
    if not np.isfinite(alike).any():
        return 0, 0, float("nan"), float("nan")
    place = np.unravel_index(np.nanargmax(alike), alike.shape)
    rows, columns = (int(p) - size * (p > size // 2) for p, size in zip(place, shape, strict=True))
    return int(rows), int(columns), float(alike[place]), float(alike[0, 0])


def seam_lines(owner: np.ndarray) -> np.ndarray:
    """Where two training views meet, [H, W] bool."""
    lines = np.zeros(owner.shape, dtype=bool)
    lines[1:] |= owner[1:] != owner[:-1]
    lines[:, 1:] |= owner[:, 1:] != owner[:, :-1]
    return lines


def comparison(
    maps: Mapping[str, np.ndarray], owner: np.ndarray, unit: str, spread: np.ndarray | None = None
) -> np.ndarray:
    """Maps side by side with common colours; below, how others differ from the last one, with the steps across the seams.

    Args:
        maps: name -> [H, W]; the last one is compared with the others.
        owner: of ``mosaic``.
        unit: of the values.
        spread: standard deviation of the last map's pixels [H, W], which has a panel where it is known.
    """
    *others, (name, own) = maps.items()
    low, high = bounds_of(own[np.isfinite(own)])
    panels = [Panel(colorize(values, low, high), title) for title, values in maps.items()]
    panels[-1] = Panel(panels[-1].image, name, Bar(low, high, unit))
    differences = {title: values - own for title, values in others}
    limit = error_limit_of(np.concatenate([np.abs(found[np.isfinite(found)]) for found in differences.values()]))
    lines = seam_lines(owner)
    for title, found in differences.items():
        step, count = step_across(found, owner)
        image = colorize(found, -limit, limit, ERROR)
        image[lines & np.isfinite(found)] = 60
        told = f"{title} − {name}: steps of {step:.2f} {unit} (rms) across {count} seams"
        log.info("%s", told)
        panels.append(Panel(image, told))
    panels[-1] = Panel(panels[-1].image, panels[-1].title, Bar(-limit, limit, unit, ERROR))
    if spread is not None:
        widest = error_limit_of(spread[np.isfinite(spread)])
        bar = Bar(0.0, widest, unit, "viridis")
        panels.append(Panel(colorize(spread, 0.0, widest, "viridis"), f"standard deviation of {name}", bar))
    count = len(maps)
    rows = [compose(panels[:count]), compose(panels[count:])]
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    return np.concatenate(padded)
