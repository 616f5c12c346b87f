"""What scores are, in words."""

import subprocess
import sys

from heatsplat.metrics.definitions import COSTS, DEFINITIONS, IMAGE_SCORES, described


def test_every_score_says_its_unit_which_way_is_better_and_how_it_is_computed():
    assert set(IMAGE_SCORES) < set(DEFINITIONS)
    for name, definition in DEFINITIONS.items():
        assert definition.better in ("higher", "lower") and definition.sentence, name
        assert (definition.unit == "°C") == name.startswith("mae")


def test_results_are_read_without_the_libraries_that_compute_them():
    """Programs that only read metrics.json start in a twentieth of a second."""
    code = "import sys, heatsplat.io.results; sys.exit('torch' in sys.modules or 'skimage' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_scores_and_costs_say_what_a_table_calls_them():
    names = ("psnr", "ssim", "mae_c", "rgb_psnr", "clean_mae_c", "train_seconds", "gaussians")
    headings = ["PSNR (dB)", "SSIM", "MAE (°C)", "RGB PSNR (dB)", "clean MAE (°C)", "train (s)", "Gaussians"]
    assert [described(name).heading for name in names] == headings
    assert described("coverage_68") is None
    assert len({quantity.heading for quantity in (DEFINITIONS | COSTS).values()}) == len(DEFINITIONS | COSTS)
