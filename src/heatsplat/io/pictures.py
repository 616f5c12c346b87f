"""Pictures for people: colour-mapped images with a bar that says what the colours mean.

Composed from arrays with Pillow for the lettering, which takes milliseconds where a figure of matplotlib takes
tenths of a second; the colour maps and the tick positions are matplotlib's.
"""

from __future__ import annotations

import base64
import difflib
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from PIL import Image, ImageDraw, ImageFont

from heatsplat.contracts import SceneError, ThermalRange, as_written, is_number

THERMAL = "inferno"
ERROR = "RdBu_r"  # red: rendered too warm, blue: too cold
IMAGE_VALUES = "image value"  # stands at the bar of thermal images that are no temperatures
UNKNOWN = ((128, 128, 128), (176, 176, 176))  # NaN and masked pixels are hatched in two greys
HATCH = 3  # pixels of a stripe

PAPER = 255
INK = (45, 45, 45)
FONT = 13
GAP = 14
BAR = 14
ARROW = 9  # pixels of the triangle at an end of a bar beyond which there are values
BLANK = 236  # grey of a cell without an image
PANEL_HEIGHT = 260  # small images are enlarged by a whole factor to about this height,
WIDEST_PANEL = 1040  # and to about this width at most
MARKS = "os^Dv<>P"  # of matplotlib, for many series in one figure
TOLD_BEYOND = 0.05  # share of an image beyond an end of its bar from which the title says so
MARKED = (26, 217, 115)  # of an isotherm, in no colour map; as viewer.html has it
MOST_CONTOURS = 50  # at equal distances between the ends of a bar
LABELLED = 60  # pixels of a contour line from which on its value stands at it
FIGURE_PANEL = 1.8  # inches of height of an image in print


@cache
def lut(name: str) -> np.ndarray:
    """The 256 colours of a matplotlib map, uint8 [256, 3]."""
    return matplotlib.colormaps[name](np.arange(256), bytes=True)[:, :3]


def checked_colormap(name: str, value: str) -> str:
    """A name of a matplotlib map. Raises SceneError with the option's ``name``, and names that are alike, where there is none."""
    if value not in matplotlib.colormaps:
        alike = difflib.get_close_matches(str(value), matplotlib.colormaps) or ["gray", "turbo", "viridis"]
        raise SceneError(f"{name}={as_written(value)} is no map of matplotlib, as {', '.join([THERMAL, *alike])} are")
    return value


def checked_isotherm(name: str, value: Any) -> tuple[float, float] | None:
    """The ends of an isotherm, of which one may be None and becomes infinite; None stays. Raises SceneError with the option's
    ``name`` for anything else."""
    if value is None:
        return None
    ends = value if isinstance(value, Sequence) and not isinstance(value, str) and len(value) == 2 else (None, None)
    low, high = (open_end if end is None else end for open_end, end in zip((-np.inf, np.inf), ends, strict=True))
    if not all(end is None or is_number(end) for end in ends) or not low < high or low == -high == -np.inf:
        raise SceneError(
            f"{name} must be [low, high] of rising numbers, [low, null] for all above, or [null, high] for all below; got "
            f"{as_written(value)}"
        )
    return float(low), float(high)


def checked_contours(name: str, value: Any) -> float | list[float] | None:
    """A positive distance of contour lines, or a list of their values; None stays. Raises SceneError with the option's ``name``
    for anything else."""
    if value is None or (isinstance(value, list) and value and all(map(is_number, value))):
        return value
    if not (is_number(value) and value > 0):
        raise SceneError(
            f"{name} must be a distance above 0, such as 5, or a list of values, such as [20, 25], got {as_written(value)}"
        )
    return value


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    """The font that matplotlib ships, which has the degree sign."""
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size)


@dataclass(frozen=True)
class Bar:
    """What colours mean: the values at the lower and upper end of a colour map, with their unit.

    Arrows at the ends say that some of what is shown lies below, or above.

    Args:
        isotherm: ends between which values have the colour ``MARKED`` in place of that of the map; None marks none.
        contours: values at which lines are drawn, or their distance; None draws none.
    """

    low: float
    high: float
    unit: str
    colormap: str = THERMAL
    below: bool = False
    above: bool = False
    isotherm: tuple[float, float] | None = None
    contours: float | Sequence[float] | None = None

    def marks(self, values: np.ndarray) -> np.ndarray:
        """Which of some values the isotherm holds, bool of their shape."""
        low, high = self.isotherm or (np.inf, -np.inf)
        return (values >= low) & (values <= high)

    @property
    def marked(self) -> str:
        """What the isotherm holds in words, such as "above 30 °C"."""
        ends = [f"{end:.4g}" for end in self.isotherm if np.isfinite(end)]
        how = "between" if len(ends) == 2 else "above" if np.isfinite(self.isotherm[0]) else "below"
        return f"{how} {' and '.join(ends)} {self.unit}".replace("-", "−")

    def levels(self) -> list[float]:
        """Values of the contour lines; of those at a distance, its multiples between the ends.

        Raises:
            SceneError: these are more than ``MOST_CONTOURS``.
        """
        if self.contours is None or isinstance(self.contours, Sequence):
            return sorted(set(self.contours or ()))
        if (self.high - self.low) / self.contours > MOST_CONTOURS:
            raise SceneError(
                f"contours={self.contours:g} draws more than {MOST_CONTOURS} lines between {self.low:.4g} and {self.high:.4g} "
                f"{self.unit}: give {_round_up((self.high - self.low) / MOST_CONTOURS):g} or more, or a list of values"
            )
        first, last = np.ceil(self.low / self.contours), np.floor(self.high / self.contours)
        return (np.arange(first, last + 1) * self.contours).tolist()

    def of(self, *images: Any) -> Bar:
        """The bar with arrows where values of these images lie beyond its ends by more than a hundredth of their distance."""
        lowest, highest = (self.low, self.high) if self.high > self.low else (-np.inf, np.inf)
        slack = 0.01 * (self.high - self.low)
        known = [np.asarray(image)[np.isfinite(image)] for image in images]
        return replace(
            self,
            below=any(bool((values < lowest - slack).any()) for values in known),
            above=any(bool((values > highest + slack).any()) for values in known),
        )


@dataclass(frozen=True)
class Panel:
    """One image [H, W, 3] uint8 under a title, with a bar at its right or without, or a text over a cell without an image.

    Over it contour lines may run: of each its value, and its places (x, y) [n, 2] in pixels from the middle of the first one.
    """

    image: np.ndarray
    title: str
    bar: Bar | None = None
    text: str = ""
    lines: Sequence[tuple[float, np.ndarray]] = ()


def colorize(values: Any, low: float, high: float, colormap: str = THERMAL) -> np.ndarray:
    """Colours of values, uint8 RGB [H, W, 3]; values outside low..high take the end's colour, NaN is hatched grey.

    Args:
        values: [H, W], tensor or array.
        low, high: values of the two ends of the map; where they are equal everything takes the middle's colour.
        colormap: name of a matplotlib map.
    """
    values = np.asarray(values, dtype=np.float64)
    known = np.isfinite(values)
    unit = (np.where(known, values, low) - low) / (high - low) if high > low else np.full(values.shape, 0.5)
    colors = lut(colormap)[(unit.clip(0, 1) * 255).round().astype(np.uint8)]
    colors[~known] = _hatching(values.shape)[~known]
    return colors


def _hatching(shape: tuple[int, ...]) -> np.ndarray:
    """Diagonal stripes, uint8 RGB [H, W, 3] (or [N, 1, 3] and the like), for pixels of which nothing is known."""
    stripes = sum(np.indices(shape)) // HATCH % 2
    return np.array(UNKNOWN, dtype=np.uint8)[stripes]


def enlarged(image: np.ndarray, factor: int) -> np.ndarray:
    """An image [H, W, 3] with squares of ``factor`` pixels a side in place of its pixels, [factor H, factor W, 3]."""
    return np.repeat(np.repeat(image, factor, axis=0), factor, axis=1)


def bar_unit(thermal_range: ThermalRange | None) -> str:
    """What numbers at the bar of a thermal image are."""
    return IMAGE_VALUES if thermal_range is None else "°C"


def image_panel(image: Any, title: str, bar: Bar, thermal_range: ThermalRange | None = None) -> Panel:
    """An image [H, W, C] under a title: with C = 3 in its own colours, with C = 1 in those of a bar, which stands beside it.

    Args:
        image: in [0, 1], or with C = 1 and no range in the unit of the bar; what is NaN is hatched.
        title: of the panel.
        bar: the values at the ends of the colours, in °C with a range.
        thermal_range: temperatures of 0 and 1.
    """
    if image.shape[-1] == 3:
        return Panel(visible(image), title)
    values = np.asarray((image if thermal_range is None else thermal_range.to_celsius(image))[..., 0])
    colours, marked = colorize(values, bar.low, bar.high, bar.colormap), bar.marks(values)
    colours[marked] = MARKED
    isotherm = bar.isotherm and f"green: {100 * marked.sum() / max(np.isfinite(values).sum(), 1):.1f} % {bar.marked}"
    # What was asked for first: a narrow picture cuts off the end of its title.
    told = " · ".join(part for part in (isotherm, title, beyond(values, bar)) if part)
    return Panel(colours, told, bar.of(values), lines=contour_lines(values, bar.levels()))


def contour_lines(values: np.ndarray, levels: Sequence[float]) -> list[tuple[float, np.ndarray]]:
    """Contour lines of an image [H, W] as ``Panel`` has them; they end where NaN is."""
    known = values[np.isfinite(values)]
    levels = [level for level in levels if known.size and known.min() < level < known.max()]
    if not levels or min(values.shape) < 2:
        return []
    found = Figure().subplots().contour(np.ma.masked_invalid(values), levels)
    return [(float(level), line) for level, lines in zip(found.levels, found.allsegs, strict=True) for line in lines]


def beyond(values: Any, bar: Bar) -> str:
    """Such as "82 % above 5 °C", where a good part of an image takes the colour of an end of its bar; else empty."""
    known = np.asarray(values)[np.isfinite(values)]
    if not known.size:
        return ""
    shares = (("below", bar.low, (known < bar.low).mean()), ("above", bar.high, (known > bar.high).mean()))
    told = (f"{share:.0%} {side} {end:.3g} {bar.unit}".rstrip() for side, end, share in shares if share >= TOLD_BEYOND)
    return ", ".join(told).replace("%", " %")


def text_panel(shape: tuple[int, int], title: str, text: str) -> Panel:
    """A cell of the size of an image [H, W] with a text in its middle, for what is no map."""
    return Panel(np.full((*shape, 3), BLANK, dtype=np.uint8), title, text=text)


def comparison_panels(
    target: Any,
    prediction: Any,
    thermal_range: ThermalRange | None = None,
    mask: Any = None,
    bounds: tuple[float, float] | None = None,
    error_limit: float | None = None,
    against: str = "ground truth",
) -> list[Panel]:
    """Ground truth, render and their difference, for one picture or figure.

    **Convention:** the difference is render minus ground truth: red is too warm, blue too cold. Ground truth and render
    share the colours.

    Args:
        target, prediction: [H, W, C] in [0, 1], C = 1 or 3.
        thermal_range: temperatures of 0 and 1; None labels bars with image values.
        mask: [H, W] bool, True where a pixel counts; the others are hatched in ground truth and difference.
        bounds: ends of the colours in °C (image values without a range); None spreads them over the ground truth.
        error_limit: end of the difference's bar in the same unit; None takes that of ``error_limit_of``.
        against: what the target is called.
    """
    target, prediction = (np.asarray(image, dtype=np.float32) for image in (target, prediction))
    counted, error = difference(target, prediction, thermal_range, mask)
    thermal = target.shape[2] == 1
    unit = bar_unit(thermal_range) if thermal else ""
    if error_limit is None:
        error_limit = error_limit_of(np.abs(error[counted]))

    if thermal:
        images = [image[..., 0] for image in (target, prediction)]
        if thermal_range is not None:
            images = [thermal_range.to_celsius(image) for image in images]
        low, high = bounds or bounds_of(images[0][counted] if counted.any() else images[1])
        images[0] = np.where(counted, images[0], np.nan)
        pictures = [colorize(image, low, high) for image in images]
        bar = Bar(low, high, unit).of(*images)
    else:
        pictures = [visible(image) for image in (target, prediction)]
        pictures[0][~counted] = _hatching(counted.shape)[~counted]
        bar = None
    error_bar = Bar(-error_limit, error_limit, unit, ERROR).of(error)
    return [
        Panel(pictures[0], against),
        Panel(pictures[1], "render", bar),
        Panel(colorize(error, -error_limit, error_limit, ERROR), f"render − {against}", error_bar),
    ]


def difference(
    target: Any, prediction: Any, thermal_range: ThermalRange | None = None, mask: Any = None
) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels count [H, W], and render minus ground truth [H, W] in °C or image values, NaN where they do not.

    Args: as ``comparison_panels``.
    """
    target, prediction = (np.asarray(image, dtype=np.float32) for image in (target, prediction))
    if target.shape != prediction.shape or target.ndim != 3:
        raise ValueError(f"two images [H, W, C] of one shape are compared, got {target.shape} and {prediction.shape}")
    counted = np.isfinite(target).all(-1)
    if mask is not None:
        counted &= np.asarray(mask)
    scale = thermal_range.span_k if target.shape[2] == 1 and thermal_range else 1.0
    return counted, np.where(counted, (prediction - target).mean(-1) * scale, np.nan)


def bounds_of(values: Any) -> tuple[float, float]:
    """Ends of colours that all but a thousandth of some values at each side lie between."""
    low, high = np.percentile(values, (0.1, 99.9))
    return float(low), float(high)


def error_limit_of(errors: Any) -> float:
    """A round end of an error's bar, from magnitudes [n]: what 99 in 100 stay below, but no more than ten times the mean of the
    smaller three quarters.

    So edges that no camera saw, wrong by the range of the scene, do not blot out all other errors.
    """
    errors = np.sort(np.asarray(errors, dtype=np.float64))
    if not errors.size:
        return _round_up(0.0)
    most, usual = np.percentile(errors, 99), errors[: 3 * errors.size // 4].mean() if errors.size > 1 else 0.0
    return _round_up(float(min(most, 10 * usual) if usual > 0 else most))


def visible(image: Any) -> np.ndarray:
    """An image [H, W, 3] in [0, 1] as uint8; a pixel with NaN is hatched grey."""
    image = np.asarray(image)
    colors = (np.nan_to_num(image).clip(0, 1) * 255).round().astype(np.uint8)
    unknown = np.isnan(image).any(-1)
    colors[unknown] = _hatching(image.shape[:2])[unknown]
    return colors


def compose(panels: Sequence[Panel], title: str = "", columns: int | None = None) -> np.ndarray:
    """Panels on white paper, each with its title and bar, under a common title, uint8 RGB with even sides.

    Small images are enlarged by a whole factor without smoothing, so that their pixels can be counted.

    Args:
        panels: all of the size of the first.
        title: above all of them.
        columns: panels in a row; None has all in one.
    """
    columns = columns or len(panels)
    rows = [_row(panels[i : i + columns]) for i in range(0, len(panels), columns)]
    line = FONT + 9
    top = GAP + (line if title else 0)
    shape = (top + sum(map(len, rows)), 2 * GAP + max(row.shape[1] for row in rows))
    canvas = np.full((shape[0] + shape[0] % 2, shape[1] + shape[1] % 2, 3), PAPER, dtype=np.uint8)  # even: video codecs
    for row in rows:
        canvas[top : top + len(row), GAP : GAP + row.shape[1]] = row
        top += len(row)
    if not title:
        return canvas
    page = Image.fromarray(canvas)
    ImageDraw.Draw(page).text((GAP, GAP), _fit(title, shape[1] - 2 * GAP), font=_font(FONT), fill=INK)
    return np.asarray(page)


def fitted(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    """A picture, uint8 RGB, in the middle of white paper [height, width, 3]; smaller where it is larger than that."""
    factor = min(1.0, height / picture.shape[0], width / picture.shape[1])
    if factor < 1.0:
        rows, columns = (max(1, int(side * factor)) for side in picture.shape[:2])
        picture = cv2.resize(picture, (columns, rows), interpolation=cv2.INTER_AREA)
    page = np.full((height, width, 3), PAPER, dtype=np.uint8)
    top, left = (height - picture.shape[0]) // 2, (width - picture.shape[1]) // 2
    page[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return page


def _row(panels: Sequence[Panel]) -> np.ndarray:
    """Panels beside each other, each under its title, with a margin below only, uint8 RGB."""
    line = FONT + 9
    height, width = panels[0].image.shape[:2]
    factor = max(1, round(min(PANEL_HEIGHT / height, WIDEST_PANEL / width)))
    height, width = height * factor, width * factor
    ticks = [_ticks(panel.bar) if panel.bar else [] for panel in panels]
    labels = [max((_font(FONT).getlength(text) for _, text in marks), default=0) for marks in ticks]
    widths = [
        width + (BAR + 14 + int(np.ceil(label)) if panel.bar else 0)
        for panel, label in zip(panels, labels, strict=True)
    ]
    page = Image.new("RGB", (sum(widths) + GAP * (len(widths) - 1), line + height + GAP), (PAPER,) * 3)
    draw = ImageDraw.Draw(page)
    x, y = 0, line
    for panel, marks, step in zip(panels, ticks, widths, strict=True):
        draw.text((x, 0), _fit(panel.title, step), font=_font(FONT), fill=INK)
        page.paste(Image.fromarray(_with_lines(enlarged(panel.image, factor), panel.lines, factor)), (x, y))
        _label_lines(draw, panel.lines, (x, y), factor)
        if panel.text:
            draw.text((x + width / 2, y + height / 2), _fit(panel.text, width), font=_font(FONT), fill=INK, anchor="mm")
        if panel.bar:
            left = x + width + 6
            ramp = np.broadcast_to(_ramp(panel.bar, height)[::-1, None], (height, BAR, 3))
            page.paste(Image.fromarray(np.ascontiguousarray(ramp)), (left, y))
            draw.rectangle((left - 1, y - 1, left + BAR, y + height), outline=(170, 170, 170))
            span = panel.bar.high - panel.bar.low
            for level in panel.bar.levels():
                if panel.bar.low <= level <= panel.bar.high and span > 0:
                    row = y + round((height - 1) * (1 - (level - panel.bar.low) / span))
                    draw.line((left, row, left + BAR - 1, row), fill=INK, width=3)
                    draw.line((left, row, left + BAR - 1, row), fill="white")
            for value, text in marks:
                row = y + (height - 1) * (1 - ((value - panel.bar.low) / span if span > 0 else 0.5))
                draw.line((left + BAR, row, left + BAR + 3, row), fill=INK)
                draw.text((left + BAR + 6, row), text, font=_font(FONT), fill=INK, anchor="lm")
            _arrows(draw, panel.bar, left, y, height)
        x += step + GAP
    return np.asarray(page)


def _ramp(bar: Bar, count: int) -> np.ndarray:
    """Colours along a bar from its low to its high end, uint8 [count, 3]."""
    colours = lut(bar.colormap)[np.linspace(0, 255, count).round().astype(int)]
    colours[bar.marks(np.linspace(bar.low, bar.high, count))] = MARKED
    return colours


def _with_lines(image: np.ndarray, lines: Sequence[tuple[float, np.ndarray]], factor: int) -> np.ndarray:
    """An image that was enlarged by a factor with contour lines of the smaller one: white between dark edges."""
    image = np.ascontiguousarray(image)
    for width, colour in ((3, INK), (1, (255, 255, 255))):
        for _, line in lines:
            points = np.rint(((line + 0.5) * factor - 0.5) * 16).astype(np.int32)
            cv2.polylines(image, [points], False, colour, width, cv2.LINE_AA, shift=4)
    return image


def _label_lines(
    draw: ImageDraw.ImageDraw, lines: Sequence[tuple[float, np.ndarray]], corner: tuple[int, int], factor: int
) -> None:
    """Writes the value of each level in the middle of its longest contour line, where that is long enough."""
    longest: dict[float, tuple[float, np.ndarray]] = {}
    for level, line in lines:
        length = factor * float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
        if length > max(longest.get(level, (LABELLED,))[0], LABELLED):
            longest[level] = length, line[len(line) // 2]
    for level, (_, place) in longest.items():
        at = tuple(float(start + (part + 0.5) * factor) for start, part in zip(corner, place, strict=True))
        text = f"{level:.4g}".replace("-", "−")
        draw.text(at, text, font=_font(FONT), fill="white", anchor="mm", stroke_width=2, stroke_fill=INK)


def _arrows(draw: ImageDraw.ImageDraw, bar: Bar, left: int, top: int, height: int) -> None:
    """Draws triangles in the colours of the ends of a bar beyond which there are values, in place of its last pixels."""
    colours = _ramp(bar, 256)
    for there, tip, way, colour in (
        (bar.above, top, 1, colours[-1]),
        (bar.below, top + height - 1, -1, colours[0]),
    ):
        if there:
            base = tip + way * ARROW
            draw.rectangle((left - 1, min(tip, base) - 1, left + BAR, max(tip, base) + 1), fill=(PAPER,) * 3)
            corners = ((left - 1, base), (left + BAR, base), (left + (BAR - 1) / 2, tip))
            draw.polygon(corners, fill=tuple(colour.tolist()), outline=INK)


def write_figure(path: str | Path, panels: Sequence[Panel], title: str = "") -> None:
    """Writes panels in a row as a figure for print, .pdf or .svg: lettering stays text, pixels stay pixels; makes its folder."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = panels[0].image.shape[:2]
    each = FIGURE_PANEL * width / height
    barred = sum(panel.bar is not None for panel in panels)
    size = (each * len(panels) + 0.7 * barred + 0.2, FIGURE_PANEL + 0.35 + (0.2 if title else 0))
    logging.getLogger("fontTools").setLevel(logging.WARNING)  # which lists the tables of every font it embeds
    settings = {"font.size": 8, "pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "heatsplat"}
    with matplotlib.rc_context(settings):
        figure = Figure(figsize=size, layout="constrained")
        if title:
            figure.suptitle(literal(title), fontsize=8)
        for i, panel in enumerate(panels, start=1):
            axes = figure.add_subplot(1, len(panels), i)
            axes.imshow(panel.image, interpolation="none")
            for _, line in panel.lines:
                axes.plot(*line.T, color="black", linewidth=1.0, scalex=False, scaley=False)
                axes.plot(*line.T, color="white", linewidth=0.4, scalex=False, scaley=False)
            axes.set_title(literal(panel.title), fontsize=8)
            axes.set_axis_off()
            if panel.text:
                axes.text(0.5, 0.5, literal(panel.text), ha="center", va="center", transform=axes.transAxes)
            if (bar := panel.bar) is not None:
                colormap = ListedColormap(_ramp(bar, 256) / 255) if bar.isotherm else bar.colormap
                colours = ScalarMappable(Normalize(bar.low, bar.high), colormap)
                extend = {(True, True): "both", (True, False): "min", (False, True): "max"}
                ends = extend.get((bar.below, bar.above), "neither")
                drawn = figure.colorbar(colours, ax=axes, fraction=0.05, pad=0.02, label=bar.unit, extend=ends)
                for level in bar.levels():
                    drawn.ax.axhline(level, color="white", linewidth=0.4)
        date = {".pdf": "CreationDate", ".svg": "Date"}[path.suffix]
        figure.savefig(path, metadata={date: None})


def series_look(i: int) -> tuple[str, str]:
    """Colour and mark of the i-th of many series in a figure of matplotlib: ten colours, then the same with another mark."""
    return f"C{i % 10}", MARKS[i // 10 % len(MARKS)]


def literal(text: str) -> str:
    """A text for a figure of matplotlib, which reads what stands between two dollar signs of a name as a formula."""
    return text.replace("$", r"\$")


def lettering(draw: ImageDraw.ImageDraw, place: tuple[float, float], text: str, within: float | None = None) -> None:
    """Writes white text with a dark edge on a picture, its left end at half height at ``place``; with a width of the picture its
    middle, or as near as it fits ``within``."""
    if within is not None:
        text = _fit(text, within - 4)
        half = _font(FONT).getlength(text) / 2
        place = min(max(place[0], half + 2), within - half - 2) - half, place[1]
    draw.text(place, text, font=_font(FONT), fill="white", anchor="lm", stroke_width=2, stroke_fill=INK)


def figure_picture(figure: Figure) -> np.ndarray:
    """A matplotlib figure as pixels, uint8 RGB. Make it as an object (``Figure(...)``): pyplot keeps global state."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def write_png(path: str | Path, picture: np.ndarray) -> bytes:
    """Writes an RGB picture [H, W, 3] uint8, makes its folder and returns what is in the file. Raises OSError where it cannot."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    done, encoded = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    if not done:
        raise OSError(f"cannot write {path}")
    content = encoded.tobytes()
    path.write_bytes(content)
    return content


def data_uri(picture: np.ndarray, quality: int = 85) -> str:
    """An RGB picture [H, W, 3] uint8 as the ``src`` of an image in a page (WebP). Raises OSError where OpenCV lacks it."""
    done, encoded = cv2.imencode(".webp", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_WEBP_QUALITY, quality])
    if not done:
        raise OSError("this OpenCV has no WebP encoder")
    return f"data:image/webp;base64,{base64.b64encode(encoded.tobytes()).decode()}"


def _ticks(bar: Bar) -> list[tuple[float, str]]:
    """Values at round numbers within the bar, with their labels; the unit stands at the uppermost."""
    if not bar.high - bar.low > 1e-9 * max(abs(bar.low), abs(bar.high)):  # apart by rounding, if at all
        return [(bar.low, f"{bar.low:g} {bar.unit}".strip())]
    steps = MaxNLocator(nbins=6, steps=[1, 2, 2.5, 5, 10]).tick_values(bar.low, bar.high)
    margin = 0.02 * (bar.high - bar.low)
    values = [v for v in steps if bar.low - 1e-9 * margin <= v <= bar.high + 1e-9 * margin]
    digits = max(0, int(np.ceil(-np.log10(steps[1] - steps[0]) - 1e-9)))
    digits += int(round((steps[1] - steps[0]) * 10**digits, 6) % 1 != 0)  # steps of 2.5
    texts = [f"{v + 0.0:.{digits}f}".replace("-", "−") for v in values]
    texts[-1] = f"{texts[-1]} {bar.unit}".strip()
    return list(zip(values, texts, strict=True))


def _fit(text: str, width: float) -> str:
    """``text``, cut with an ellipsis where it is wider than ``width`` pixels."""
    if _font(FONT).getlength(text) <= width:
        return text
    while text and _font(FONT).getlength(text + "…") > width:
        text = text[:-1]
    return text + "…"


def _round_up(value: float) -> float:
    """The next of 1, 2, 5 times a power of ten; 1e-3 for anything smaller, so that a bar has two different ends."""
    value = max(value, 1e-3)
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= value * 0.999))
