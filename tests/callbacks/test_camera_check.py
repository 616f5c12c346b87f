"""What the check of cameras says: of images that fit better from beside, of images that do not, and where it does not look."""

import logging
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from heatsplat.callbacks.camera_check import OFF, CameraCheck
from heatsplat.contracts import Camera, Frame, View

FOCAL, DEPTH = 50.0, 2.0
POINTS = torch.tensor([[x, y, DEPTH] for x in (-0.3, 0.0, 0.3) for y in (-0.2, 0.2)])


def seen_from(x: float) -> Camera:
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3] = -x
    K = torch.tensor([[FOCAL, 0, 20.0], [0, FOCAL, 15.0], [0, 0, 1]], dtype=torch.float64)
    return Camera(viewmat, K, 40, 30)


def view(number: int) -> View:
    return View(Frame(f"{number}.png", number, seen_from(0.01 * number)))


class Module:
    """Images differ least from ``beside`` pixels to the right of where cameras are said to be, and then by ``left`` of before."""

    device, dtype, splats = "cpu", torch.float32, [1]
    supersample = 1

    def __init__(self, beside: float, left: float, learns: bool = False, steps: int = 2000) -> None:
        self.beside, self.left = beside, left
        self.cameras = SimpleNamespace(learns=learns, of=lambda frame: frame.camera)
        self.schedule = SimpleNamespace(end=steps)
        self.scene = SimpleNamespace(train=[view(k) for k in range(20)], points=POINTS)
        self.results = SimpleNamespace(run={})
        self.looked: list[int] = []

    def aligned(self, view, camera, steps):
        self.looked.append(view.frame.frame_id)
        viewmat = camera.viewmat.clone()
        viewmat[0, 3] -= self.beside * DEPTH / FOCAL
        return replace(camera, viewmat=viewmat)

    def squared_error(self, view, camera):
        return torch.tensor(4.0 if torch.equal(camera.viewmat, view.frame.camera.viewmat) else 4.0 * self.left)


def checked(module: Module, **options) -> dict | None:
    CameraCheck(**options).on_test_start(None, module)
    return module.results.run.get("camera_check")


def test_cameras_that_are_off_are_told_with_the_remedy(caplog):
    module = Module(beside=0.4, left=0.6)
    with caplog.at_level(logging.WARNING, "heatsplat"):
        found = checked(module, views=4)
    assert found == {"images": 4, "moved_px": pytest.approx(0.4, rel=1e-6), "error_falls": pytest.approx(0.4)}
    assert len(set(module.looked)) == 4 and "moved by 0.4 pixels" in caplog.text and "40 %" in caplog.text
    assert "cameras=refined" in caplog.text


def test_images_of_which_no_pixel_counts_say_nothing_of_cameras():
    module = Module(beside=0.4, left=0.6)
    hidden = torch.zeros(30, 40, dtype=torch.bool)
    module.scene.train = [*(replace(one, mask=hidden) for one in module.scene.train[:-1]), module.scene.train[-1]]
    assert checked(module, views=4)["images"] == 1 and module.looked == [19]


@pytest.mark.parametrize(("left", "learns"), [(1 - OFF + 0.01, False), (1.02, False), (0.5, True)])
def test_cameras_that_are_right_or_learned_already_are_measured_without_a_word(left, learns, caplog):
    with caplog.at_level(logging.WARNING, "heatsplat"):
        found = checked(Module(0.1, left, learns))
    assert found["error_falls"] == pytest.approx(1 - left) and not caplog.text


def test_short_runs_fields_finer_renders_and_no_views_are_not_looked_at():
    assert checked(Module(0.4, 0.6, steps=999)) is None
    field = Module(0.4, 0.6)
    field.splats = []
    assert checked(field) is None and not field.looked
    finer = Module(0.4, 0.6)
    finer.supersample = 4
    assert checked(finer) is None
    assert checked(Module(0.4, 0.6), views=0) is None
