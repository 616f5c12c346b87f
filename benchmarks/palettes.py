"""What false colours cost: levels of pictures in several palettes and encodings beside the truth (docs/your_own_data.md).

python -m benchmarks.palettes
"""

from __future__ import annotations

import argparse
import io
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from PIL import Image

from heatsplat.datamodules.formats.palette import named
from heatsplat.datamodules.formats.pseudo_colour import PaletteReader
from heatsplat.datamodules.synthetic_scene.film import SIZES, Recording, film
from heatsplat.datamodules.synthetic_scene.presets import PRESETS
from heatsplat.datamodules.synthetic_scene.scene import Scene

PALETTES = ("gray", "iron", "inferno", "turbo", "jet", "opencv_rainbow")
# Quality of the JPEG (None: PNG), and how chroma is stored: 4:4:4 or 4:2:0.
ENCODINGS = ((None, 0), (95, 0), (95, 2), (75, 0), (75, 2))


@dataclass(frozen=True)
class Cost:
    """Of one palette and encoding.

    Args:
        palette, encoding: in words.
        median, most: absolute error in per cent of the span, of known pixels: median and 95 %.
        left_out: per cent of the pixels that are not known.
        ms: milliseconds for an image, decoding left out.
    """

    palette: str
    encoding: str
    median: float
    most: float
    left_out: float
    ms: float


def recorded(size: str, frames: int) -> Recording:
    """A few images of the scene "cooling", without noise."""
    return film(Scene(PRESETS["cooling"]), replace(SIZES[size], frames=frames), noise_k=0.0)


def costs(recording: Recording, palettes: Sequence[str] = PALETTES) -> Iterator[Cost]:
    """What each palette and encoding costs, over all images of a recording."""
    bounds = recording.thermal_range
    true = [(celsius - bounds.min_c) / bounds.span_k for celsius in recording.celsius]
    greys = [recording.grey(frame) for frame in range(len(true))]
    for name in palettes:
        colours = np.rint(named(name).curve(256)).astype(np.uint8)
        for quality, chroma in ENCODINGS:
            pictures = [_stored(colours[grey], quality, chroma) for grey in greys]
            reader = PaletteReader(named(name))
            begun = time.perf_counter()
            found = [reader.read(picture, None, name) for picture in pictures]
            ms = 1e3 * (time.perf_counter() - begun) / len(found)
            off = [np.abs(f.levels / 255.0 - t)[f.known] for f, t in zip(found, true, strict=True)]
            median, most = np.percentile(100.0 * np.concatenate(off), (50, 95))
            left_out = 100.0 * (1.0 - np.mean([f.known.mean() for f in found]))
            said = "PNG" if quality is None else f"JPEG {quality}, {'4:2:0' if chroma else '4:4:4'}"
            yield Cost(name, said, median, most, left_out, ms)


def _stored(pixels: np.ndarray, quality: int | None, chroma: int) -> np.ndarray:
    """The pixels as they come back from a file."""
    if quality is None:
        return pixels
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=quality, subsampling=chroma)
    return np.asarray(Image.open(file))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", default="large", choices=SIZES)
    parser.add_argument("--frames", type=int, default=8)
    given = parser.parse_args()
    recording = recorded(given.size, given.frames)
    print(
        f"{given.frames} images of {recording.lens.width}x{recording.lens.height}, span {recording.thermal_range.span_k:g} K"
    )
    print("| palette | encoding | median % | 95 % | left out % | ms |\n|---|---|---|---|---|---|")
    for c in costs(recording):
        print(f"| {c.palette} | {c.encoding} | {c.median:.2f} | {c.most:.2f} | {c.left_out:.2f} | {c.ms:.0f} |")


if __name__ == "__main__":
    main()
