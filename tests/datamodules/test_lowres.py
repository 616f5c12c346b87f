"""Degraded scenes: half pixels, both grids, masks, what stays as it is, and input that cannot be reduced."""

from dataclasses import replace

import pytest
import torch

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, View, ViewSet
from heatsplat.datamodules.lowres import Reduction, degraded
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.geometry.resampling import resampled

HEIGHT, WIDTH = 48, 64


def camera(width=WIDTH, height=HEIGHT):
    K = torch.tensor([[61.3, 0, 0.47 * width], [0, 58.9, 0.53 * height], [0, 0, 1]], dtype=torch.float64)
    return Camera(torch.eye(4), K, width, height)


def rays(camera):
    """Directions x/z and y/z through the pixel centres, [H, W] each."""
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    return (u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy


def plane(camera):
    """An image whose value is a linear function of the ray, so that any shift of the grid shows."""
    x, y = rays(camera)
    return (0.5 + 0.3 * x - 0.2 * y).float()[..., None]


def make_scene(count=3, width=WIDTH, height=HEIGHT, mask=None, rgb=True):
    frames = [Frame(f"{i:03d}.png", i, camera(width, height), float(i)) for i in range(count)]

    def decode(position):
        image = plane(frames[position].camera)
        return View(frames[position], image, image.expand(-1, -1, 3) if rgb else None, mask)

    views = ViewSet(frames, decode)
    return SceneData("room", views, views.subset([0]), views.subset([1, 2]), torch.zeros(4, 3), notes={"kept": 1})


@pytest.mark.parametrize("degrade", ["lr4", "area4", "bicubic2", "lr8"])
def test_a_reduced_image_is_what_its_camera_would_see(degrade):
    scene = degraded(make_scene(), degrade)
    view, factor = scene.train[1], Reduction.parse(degrade).factor
    assert scene.reduced_by == Reduction.parse(degrade).kernel and make_scene().reduced_by is None
    assert (view.camera.width, view.camera.height) == (WIDTH // factor, HEIGHT // factor)
    inside = (slice(2, -2), slice(2, -2))  # the border has less of the kernel
    assert torch.allclose(view.thermal[inside], plane(view.camera)[inside], atol=1e-6)
    wrong = view.camera.K.clone()
    wrong[:2, 2] -= 0.5 * (1 - 1 / factor)  # intrinsics of pixel centres at whole numbers
    shifted = plane(Camera(view.camera.viewmat, wrong, view.camera.width, view.camera.height))
    assert not torch.allclose(view.thermal[inside], shifted[inside], atol=1e-4)  # and the test would notice


def test_intrinsics_are_exact_and_go_back_exactly():
    scene = degraded(make_scene(), "lr4")
    fine, coarse = camera(), scene.train.frames[0].camera
    assert torch.equal(coarse.K[:2] * 4, fine.K[:2])
    assert torch.equal(coarse.resized(WIDTH, HEIGHT).K, fine.K)


def test_only_training_images_shrink():
    original = make_scene()
    scene = degraded(original, "lr4")
    for split in ("val", "test"):
        assert getattr(scene, split) is getattr(original, split)
    assert scene.train[0].rgb.shape == (HEIGHT // 4, WIDTH // 4, 3)
    assert scene.notes["kept"] == 1 and "16x12 by lr4 (bicubic)" in scene.notes["degraded"]
    assert [frame.frame_id for frame in scene.train.frames] == [0, 1, 2]
    assert scene.train.times_s == [0.0, 1.0, 2.0]


def test_a_pixel_counts_where_all_that_it_is_made_of_does():
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[20, 30] = False
    assert (~degraded(make_scene(mask=mask), "area4").train[0].mask).nonzero().tolist() == [[5, 7]]
    assert (~degraded(make_scene(mask=mask), "lr4").train[0].mask).sum() == 16  # four pixels each way see it


def test_enlarged_again_images_have_the_original_grid():
    scene = degraded(make_scene(), "lr4", upsample="lanczos")
    view = scene.train[0]
    assert torch.equal(view.camera.K, camera().K) and view.thermal.shape == (HEIGHT, WIDTH, 1)
    small = degraded(make_scene(), "lr4").train[0].thermal
    assert torch.equal(view.thermal, resampled(small, HEIGHT, WIDTH, "lanczos").clamp(0, 1))


def test_overshoot_is_clamped():
    step = torch.zeros(HEIGHT, WIDTH, 1)
    step[:, WIDTH // 2 :] = 1.0
    frame = Frame("step.png", 0, camera())
    views = ViewSet([frame], lambda position: View(frame, step))
    small = degraded(SceneData("edge", views, views, views, torch.zeros(4, 3)), "lr4").train[0].thermal
    assert resampled(step, HEIGHT // 4, WIDTH // 4, "bicubic").max() > 1.0
    assert small.min() == 0.0 and small.max() == 1.0


def test_nothing_asked_is_nothing_done():
    scene = make_scene()
    assert degraded(scene, None) is scene


@pytest.mark.parametrize(
    "degrade, upsample, message",
    [
        ("lr5", None, r"image 000.png has 64 x 48 pixels, which 5 does not divide; factors that do: 2, 4, 8, 16"),
        ("lr1", None, r"data.degrade=lr1: write a kernel \(lr, bicubic, area\) and a factor of 2 or more"),
        ("4", None, r"data.degrade=4: write a kernel"),
        ("lanczos4", None, r"data.degrade=lanczos4: write a kernel"),
        ("lr4", "area", r"data.upsample=area is unknown; choose bilinear, bicubic or lanczos"),
        (None, "lanczos", r"enlarges degraded images; give data.degrade too"),
    ],
)
def test_errors_name_the_key_and_the_remedy(degrade, upsample, message):
    with pytest.raises(SceneError, match=message):
        degraded(make_scene(), degrade, upsample)


def test_a_size_that_nothing_divides_says_so():
    with pytest.raises(SceneError, match="61 x 48 pixels, which 4 does not divide; no factor up to 16 does"):
        degraded(make_scene(width=61), "lr4")


def test_images_that_are_shrunk_first_can_be_divided():
    scene = Synthetic(scene="static", size="tiny", frames=9, downscale=4, degrade="lr4").scene  # of 64 x 52 pixels
    assert {(f.camera.width, f.camera.height) for f in scene.train.frames} == {(4, 3)}
    assert {(f.camera.width, f.camera.height) for f in scene.test.frames} == {(16, 12)}


def test_what_was_cut_off_stays_known():
    scene = make_scene()
    ends = torch.zeros(HEIGHT, WIDTH, dtype=torch.int8)
    ends[5, 9] = 1
    cut = replace(scene, train=ViewSet(scene.train.frames, lambda i: replace(scene.train[i], ends=ends)))
    assert degraded(cut, "lr4", None).train[0].ends.nonzero().tolist() == [[1, 2]]
    assert degraded(cut, "lr4", "bicubic").train[0].ends.sum() == 16
    assert degraded(scene, "lr4", None).train[0].ends is None
