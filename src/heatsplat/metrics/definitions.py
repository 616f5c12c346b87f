"""What each score is, in words: for tables and files, which need no tensors."""

from __future__ import annotations

from dataclasses import dataclass

OUTLIER_C = 10.0  # SupIR-GS drops pixels with a larger error


@dataclass(frozen=True)
class Definition:
    """What a score is: its unit, which direction is better, and one sentence that another lab could compute it from."""

    unit: str
    better: str
    sentence: str


DEFINITIONS = {
    "psnr": Definition("dB", "higher", "data range 1, mean of the images' PSNR"),
    "ssim": Definition(
        "", "higher", "Gaussian window 11 x 11, sigma 1.5, C1 0.01², C2 0.03²; windows wholly within image and mask"
    ),
    "lpips": Definition("", "lower", "learned perceptual image patch similarity"),
    "mae_c": Definition("°C", "lower", "mean |error| x (Tmax - Tmin), all counted pixels"),
    "mae_inlier_c": Definition(
        "°C", "lower", f"mae_c over pixels with an error of at most {OUTLIER_C:g} °C (SupIR-GS)"
    ),
    "mae_roi_c": Definition("°C", "lower", "mae_c above the image's own Otsu threshold (SupIR-GS's region)"),
    "mae_roi_inlier_c": Definition(
        "°C", "lower", f"mae_roi_c over pixels with an error of at most {OUTLIER_C:g} °C (SupIR-GS as printed)"
    ),
    "mae_roi_scene_c": Definition(
        "°C",
        "lower",
        "mae_c on the object's side of one threshold, the mean of all frames' Otsu thresholds (ThermoNeRF)",
    ),
    "mae_roi_scene_inlier_c": Definition(
        "°C", "lower", f"mae_roi_scene_c over pixels with an error of at most {OUTLIER_C:g} °C"
    ),
}

IMAGE_SCORES = ("psnr", "ssim", "lpips")  # those of any image, temperature or not
