"""Which of the frames of a video is the sharpest."""

import cv2
import numpy as np
import pytest
from recordings import write_images

from heatsplat.contracts import SceneError
from heatsplat.preparation.frames import Reading, read_recording
from heatsplat.preparation.sharpness import sharpness

rng = np.random.default_rng(0)
# Surfaces of several sizes and temperatures, wider than a frame.
WORLD = sum(2.0 * np.kron(rng.standard_normal((64 // n, 256 // n)), np.ones((n, n))) for n in (4, 8, 16)) + 20.0
DEAD = rng.random((64, 96)) < 0.001


def filmed(shift: int, motion: int, noise: float = 0.1) -> np.ndarray:
    """A frame of the world, moved by so many pixels while it was taken, of a camera with noise and dead pixels."""
    moved = cv2.blur(WORLD, (motion, 1))[:, shift : shift + 96] + noise * rng.standard_normal((64, 96))
    return np.where(DEAD, 90.0, moved).astype(np.float32)


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.5])
def test_what_moved_less_is_sharper_wherever_the_camera_looks(noise):
    clear, blurred = ([sharpness(filmed(shift, motion, noise)) for shift in (0, 40, 80, 120)] for motion in (1, 5))
    assert max(blurred) < min(clear)


def test_level_gain_and_unknown_pixels_do_not_count():
    plain = filmed(0, 1)
    assert sharpness(1e3 + 10 * plain) == pytest.approx(sharpness(plain), rel=1e-3)
    holed = plain.copy()
    holed[:, :5] = np.nan
    assert sharpness(holed) == pytest.approx(sharpness(plain), rel=0.1)
    assert sharpness(np.full((8, 8), np.nan)) == sharpness(np.full((8, 8), 20.0)) == 0.0


def test_of_each_so_many_frames_the_sharpest_is_taken(tmp_path):
    motions = [5, 3, 1, 3, 1, 5, 3, 3, 3, 5]
    names = {f"a{i}.tiff": filmed(6 * i, motion) for i, motion in enumerate(motions)}
    small = {f"b{i}.tiff": cv2.resize(filmed(0, motion), (48, 32)) for i, motion in enumerate((7, 1))}
    folder = write_images(tmp_path, names | small)
    found = read_recording(folder, Reading(every=4, sharpest=True))
    assert [frame.name for frame in found.frames] == ["a2", "a4", "a8", "b1"]
    (note,) = [note for note in found.notes if "sharpest" in note]
    assert note.startswith("every=4 sharpest=true takes 4 of 12 frames, the sharpest of each 4: ") and "median" in note


def test_frames_that_show_nothing_are_thinned_as_without(tmp_path):
    folder = write_images(tmp_path, {f"a{i}.tiff": np.full((16, 20), 20.0, np.float32) for i in range(4)})
    found = read_recording(folder, Reading(every=2, sharpest=True))
    assert [frame.name for frame in found.frames] == ["a0", "a2"] and "none shows anything" in found.notes[-1]


def test_a_choice_among_single_frames_is_refused():
    with pytest.raises(SceneError, match="sharpest=true changes nothing with every=1: give every=15"):
        Reading(sharpest=True)
    with pytest.raises(SceneError, match="sharpest must be one of true, false, got 'yes'"):
        Reading(every=2, sharpest="yes")
