"""What each score and cost is, in words: for tables and files, which need no tensors."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

OUTLIER_C = 10.0  # SupIR-GS drops pixels with a larger error


@dataclass(frozen=True)
class Definition:
    """What a score is.

    Args:
        title: its name in tables.
        unit: of its values; empty for none.
        digits: behind the point in tables.
        higher: whether more is better.
        sentence: from which another lab could compute it.
    """

    title: str
    unit: str
    digits: int
    higher: bool
    sentence: str

    @property
    def heading(self) -> str:
        """Of a column: the title with its unit."""
        return f"{self.title} ({self.unit})" if self.unit else self.title

    @property
    def better(self) -> str:
        """Which values are: "higher" or "lower"."""
        return "higher" if self.higher else "lower"

    @property
    def sign(self) -> float:
        """1 where more is better, else -1: of values times this, more is better."""
        return 1.0 if self.higher else -1.0


@dataclass(frozen=True)
class Cost:
    """What a run takes.

    Args:
        heading: of a column, with the unit.
        unit: of its values; empty for none.
        digits: behind the point in tables.
    """

    heading: str
    unit: str
    digits: int


# Keys that every metrics.json has, in its order: scores of the test views, then costs.
DEFINITIONS = {
    "psnr": Definition("PSNR", "dB", 2, True, "data range 1, at most 100, mean of the images' PSNR"),
    "ssim": Definition(
        "SSIM", "", 4, True, "Gaussian window 11 x 11, sigma 1.5, C1 0.01², C2 0.03²; windows wholly within image and mask"
    ),
    "lpips": Definition("LPIPS", "", 4, False, "learned perceptual image patch similarity"),
    "mae_c": Definition("MAE", "°C", 3, False, "mean |error| x (Tmax - Tmin), all counted pixels"),
    "mae_inlier_c": Definition(
        "MAE inliers", "°C", 3, False, f"mae_c over pixels with an error of at most {OUTLIER_C:g} °C (SupIR-GS)"
    ),
    "mae_roi_c": Definition(
        "MAE ROI", "°C", 3, False, "mae_c above the image's own Otsu threshold (SupIR-GS's region)"
    ),
    "mae_roi_inlier_c": Definition(
        "MAE ROI inliers", "°C", 3, False,
        f"mae_roi_c over pixels with an error of at most {OUTLIER_C:g} °C (SupIR-GS as printed)",
    ),
    "mae_roi_scene_c": Definition(
        "MAE ROI of the scene", "°C", 3, False,
        "mae_c on the object's side of one threshold, the mean of all frames' Otsu thresholds (ThermoNeRF)",
    ),
    "mae_roi_scene_inlier_c": Definition(
        "MAE ROI of the scene, inliers", "°C", 3, False,
        f"mae_roi_scene_c over pixels with an error of at most {OUTLIER_C:g} °C",
    ),
}  # fmt: skip
COSTS = {
    "choosing_seconds": Cost("choosing (s)", "s", 1),
    "train_seconds": Cost("train (s)", "s", 1),
    "cpu_seconds": Cost("cpu (s)", "s", 1),
    "steps_per_second": Cost("steps/s", "1/s", 1),
    "render_fps": Cost("frames/s", "1/s", 0),
    "peak_memory_mb": Cost("memory (MB)", "MB", 0),
    "gaussians": Cost("Gaussians", "", 0),
    "warmup_seconds": Cost("warm-up (s)", "s", 1),
    "evaluation_seconds": Cost("evaluation (s)", "s", 1),
    "wall_seconds": Cost("wall (s)", "s", 1),
}

IMAGE_SCORES = ("psnr", "ssim", "lpips")  # those of any image, temperature or not


def described(name: str) -> Definition | Cost | None:
    """What a score or cost of metrics.json is, None for what is neither; clean_mae_c is a score of a further image."""
    if known := DEFINITIONS.get(name) or COSTS.get(name):
        return known
    image, _, score = name.partition("_")
    if score not in DEFINITIONS:
        return None
    return replace(DEFINITIONS[score], title=f"{'RGB' if image == 'rgb' else image} {DEFINITIONS[score].title}")


def unit_of(definition: object) -> str:
    """The unit with which what metrics.json says of a score begins ("°C, lower is better: ..."); empty for none."""
    found = re.match(r"(\S+), (?:lower|higher) is better", str(definition))
    return found[1] if found else ""
