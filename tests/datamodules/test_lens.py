import numpy as np
import pytest

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.images import undistorted, undistorted_mask
from heatsplat.datamodules.formats.lens import Lens, lens_of, undistortion_maps

WIDTH, HEIGHT = 64, 48

# COLMAP model -> parameters; distortions of several pixels at the corner.
CAMERAS = {
    "SIMPLE_RADIAL": (60.0, 31.0, 25.0, -0.12),
    "RADIAL": (60.0, 31.0, 25.0, -0.2, 0.05),
    "OPENCV": (58.0, 66.0, 31.0, 25.0, -0.15, 0.04, 0.01, -0.02),
    "FULL_OPENCV": (58.0, 66.0, 31.0, 25.0, -0.1, 0.02, 0.01, -0.01, 0.01, 0.02, 0.01, 0.005),
    "SIMPLE_RADIAL_FISHEYE": (60.0, 31.0, 25.0, 0.05),
    "RADIAL_FISHEYE": (60.0, 31.0, 25.0, 0.05, -0.02),
    "OPENCV_FISHEYE": (58.0, 66.0, 31.0, 25.0, 0.04, -0.02, 0.01, 0.005),
}


def scene_value(x, y):
    """A smooth picture over normalised image coordinates."""
    return 30000 + 9000 * np.sin(9 * x) * np.cos(7 * y) + 4000 * x


def pixel_centers():
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)


@pytest.mark.parametrize("model", CAMERAS)
def test_undistorted_images_show_what_a_pinhole_would(model):
    """The distorted picture is made with COLMAP's own camera model, which the loader does not use."""
    import cv2  # noqa: F401, I001
    import pycolmap

    params = CAMERAS[model]
    camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=list(params))
    seen = np.array(camera.cam_from_img(pixel_centers()))
    stored = scene_value(seen[:, 0], seen[:, 1]).reshape(HEIGHT, WIDTH).round().astype(np.uint16)
    lens = lens_of(model, params, WIDTH, HEIGHT, "test")
    assert lens.is_distorted

    result = undistorted(stored, lens)
    assert result.dtype == np.uint16
    straight = (pixel_centers() - [lens.cx, lens.cy]) / [lens.fx, lens.fy]
    truth = scene_value(straight[:, 0], straight[:, 1]).reshape(HEIGHT, WIDTH)
    valid = undistorted_mask(None, lens)
    valid[[0, -1]] = valid[:, [0, -1]] = False  # the half pixel at the border is extrapolated
    assert valid.mean() > 0.6
    error = np.abs(result - truth)[valid]
    before = np.abs(stored - truth)[valid]
    # Linear interpolation of this picture errs by at most 80 counts; half a pixel of shift would be 500.
    assert error.max() < 100
    assert before.max() > 10 * error.max()


def test_lenses_without_distortion_are_pinholes():
    assert not lens_of("SIMPLE_PINHOLE", (50, 32, 24), WIDTH, HEIGHT, "test").is_distorted
    assert not lens_of("OPENCV", (50, 51, 32, 24, 0, 0, 0, 0), WIDTH, HEIGHT, "test").is_distorted
    lens = lens_of("SIMPLE_PINHOLE", (50, 32, 24), WIDTH, HEIGHT, "test")
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (50, 50, 32, 24)


def test_a_pinhole_comes_from_its_matrix():
    lens = Lens.pinhole(np.array([[50.0, 0, 31], [0, 52, 23], [0, 0, 1]]), WIDTH, HEIGHT)
    assert not lens.is_distorted
    assert lens.matrix().tolist() == [[50, 0, 31], [0, 52, 23], [0, 0, 1]]
    assert lens.resized(32, 48).matrix().tolist() == [[25, 0, 15.5], [0, 52, 23], [0, 0, 1]]


def test_sixteen_bit_values_survive_exactly():
    lens = lens_of("RADIAL", CAMERAS["RADIAL"], WIDTH, HEIGHT, "test")
    for value in (0, 1, 40001, 65535):
        assert (undistorted(np.full((HEIGHT, WIDTH), value, np.uint16), lens) == value).all()


def test_pixels_from_outside_the_image_are_invalid():
    lens = lens_of("SIMPLE_RADIAL", (60.0, 32.0, 24.0, 0.3), WIDTH, HEIGHT, "test")  # pincushion: corners lie outside
    valid = undistorted_mask(None, lens)
    assert not valid[0, 0] and not valid[-1, -1] and valid[24, 32]


def test_where_the_polynomial_folds_back_nothing_is_valid():
    # r_d = r - 0.6 r^3 turns back at r = 0.745: beyond it the same stored pixels would be shown again.
    lens = Lens(fx=30, fy=30, cx=32, cy=24, width=64, height=48, distortion=(-0.6, 0, 0, 0, 0, 0, 0, 0))
    valid = undistortion_maps(lens)[2]
    y, x = np.mgrid[:48, :64] + 0.5
    radius = np.hypot(x - 32, y - 24) / 30
    assert not valid[radius > 0.80].any()
    assert valid[radius < 0.70].all()


def test_nothing_is_valid_either_where_it_has_passed_the_middle():
    # r_d = r - 0.6 r^3 is negative beyond r = 1.29, and grows from there as a picture that is turned round does.
    lens = Lens(fx=20, fy=20, cx=32, cy=24, width=64, height=48, distortion=(-0.6, 0, 0, 0, 0, 0, 0, 0))
    valid = undistortion_maps(lens)[2]
    y, x = np.mgrid[:48, :64] + 0.5
    radius = np.hypot(x - 32, y - 24) / 20
    assert radius.max() > 1.9 and not valid[radius > 0.80].any() and valid[radius < 0.70].all()


def test_masks_are_undistorted_with_the_image():
    lens = lens_of("RADIAL", CAMERAS["RADIAL"], WIDTH, HEIGHT, "test")
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:, :10] = False
    marked = np.where(mask, 65535, 0).astype(np.uint16)
    result = undistorted_mask(mask, lens)
    assert result.any() and not result.all()
    assert (undistorted(marked, lens)[result] == 65535).all()


def test_unsupported_models_name_the_remedy():
    with pytest.raises(SceneError, match="sparse, camera 3: camera model FOV is not supported.*image_undistorter"):
        lens_of("FOV", (1, 2, 3, 4, 5), 10, 10, "sparse, camera 3")


def test_impossible_parameters_are_refused():
    with pytest.raises(SceneError, match="focal lengths must be positive"):
        lens_of("SIMPLE_PINHOLE", (-50, 32, 24), WIDTH, HEIGHT, "test")
    with pytest.raises(SceneError, match="PINHOLE has 4 parameters"):
        lens_of("PINHOLE", (50, 32, 24), WIDTH, HEIGHT, "test")
