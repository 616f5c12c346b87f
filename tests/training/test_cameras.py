"""Cameras that are learned with the scene: their form against scipy's rotations, what they do together, and what runs recover."""

import math

import pytest
import torch
from running import BARE, TINY, run
from scipy.spatial.transform import Rotation

from heatsplat.callbacks.camera_check import OFF
from heatsplat.composition import build, compose
from heatsplat.contracts import Camera, Frame, SceneError
from heatsplat.runs.run import load
from heatsplat.training.cameras import Cameras, RefinedCameras, _common, _moved, check_sight

FOCAL, SIDE = 100.0, 64


def camera(turn, centre) -> Camera:
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.from_numpy(Rotation.from_rotvec(turn).as_matrix())
    viewmat[:3, 3] = -viewmat[:3, :3] @ torch.tensor(centre, dtype=torch.float64)
    K = torch.tensor([[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(viewmat, K, SIDE, SIDE)


def ring(count: int) -> list[Camera]:
    """Cameras on a ring of radius 2 about the origin, all looking at it."""
    cameras = []
    for k in range(count):
        angle = 2 * math.pi * k / count
        cameras.append(camera([0.0, angle, 0.0], [2 * math.sin(angle), 0.1 * k, -2 * math.cos(angle)]))
    return cameras


class Scene:
    """In place of SceneData: what cameras are learned from."""

    name = "ring"
    extent = 2.0

    def __init__(self, cameras: list[Camera], points: torch.Tensor | None = None) -> None:
        self.train = self
        self.frames = [Frame(f"{k}.png", 10 + k, one) for k, one in enumerate(cameras)]
        spread = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) - 0.5
        self.points = spread if points is None else points


def test_a_world_that_is_too_small_to_be_seen_is_refused_and_one_that_is_in_part_is_told(tmp_path, caplog):
    scene = Scene(ring(8))  # its points lie 1.1 to 2.9 away
    check_sight(scene, 0.01)
    assert not caplog.text
    check_sight(scene, 1.7)
    assert "% of its points nearer than renderer.near=1.7 world units" in caplog.text
    with pytest.raises(SceneError, match=r"100 % of its points nearer .* lie 2 away\): give renderer.near=2e-02"):
        check_sight(scene, 5.0)
    check_sight(Scene(ring(8), torch.full((4, 3), 1e3)), 0.01)  # no camera sees any
    with pytest.raises(SceneError, match=r"give renderer\.near="):
        run(tmp_path, *TINY, *BARE, "method=3dgs", "renderer.near=30")


def test_a_camera_turns_about_its_centre_and_moves_as_scipy_says():
    given = camera([0.3, -0.2, 0.9], [1.0, 2.0, 3.0])
    moves = torch.tensor([0.1, -0.4, 0.2, 3.0, -1.0, 2.0], dtype=torch.float64)
    found = _moved(given, moves, 0.5, 0.25)
    half = 0.25 * moves[:3]
    angle = 2 * torch.atan(half.norm())
    turn = Rotation.from_rotvec((angle * half / half.norm()).numpy()).as_matrix()
    expected = given.viewmat[:3, :3] @ torch.from_numpy(turn).T
    torch.testing.assert_close(found.viewmat[:3, :3], expected, rtol=0, atol=1e-14)
    torch.testing.assert_close(found.center, given.center + 0.25 * moves[3:], rtol=0, atol=1e-14)
    still = _moved(given, torch.zeros(6, dtype=torch.float64), 0.5, 0.25)
    torch.testing.assert_close(still.viewmat, given.viewmat, rtol=0, atol=1e-15)


def test_the_gradient_of_a_camera_is_that_of_differences():
    given = camera([0.3, -0.2, 0.9], [1.0, 2.0, 3.0])
    moves = torch.tensor([0.1, -0.4, 0.2, 3.0, -1.0, 2.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda moves: _moved(given, moves, 0.5, 0.25).viewmat, moves)


def test_a_number_is_a_pixel():
    scene = Scene(ring(8))
    cameras = RefinedCameras()
    cameras.prepare(scene)
    frame = scene.frames[0]
    middle = torch.zeros(1, 3, dtype=torch.float64)
    before, _ = frame.camera.project(middle)
    for axis, pixel in ((1, 0), (0, 1)):  # a turn about the upright axis moves the image sideways
        for kind, along in ((0, axis), (3, 1 - axis)):
            with torch.no_grad():
                cameras.moves.zero_()
                cameras.moves[0, kind + along] = 1.0
            after, _ = cameras.of(frame).project(middle)
            assert abs(float((after - before)[0, pixel].abs()) - 1.0) < 0.1, (kind, axis)


def test_what_all_cameras_do_together_is_no_movement():
    """A scene that is moved, turned and scaled with its cameras has the same images: none of it is learned."""
    cameras = ring(9)
    scene, generator = Scene(cameras), torch.Generator().manual_seed(1)
    learned = RefinedCameras(start=0.0)
    learned.prepare(scene)
    assert learned.common.shape == (7, 54)
    torch.testing.assert_close(learned.common @ learned.common.T, torch.eye(7), rtol=0, atol=1e-5)
    centres = torch.stack([one.center for one in cameras])
    turn, shift, scale = (1e-3 * torch.randn(3, generator=generator, dtype=torch.float64) for _ in range(3))
    about = centres.mean(0)
    moved = torch.linalg.cross(turn.expand(9, 3), centres - about) + scale[0] * (centres - about) + shift
    pixels = learned.pixels
    own = torch.zeros(9, 6)
    own[4, 2] = 1.0  # one camera alone keeps its own
    with torch.no_grad():
        learned.moves.copy_(torch.cat([turn.expand(9, 3) / pixels[:, :1], moved / pixels[:, 1:]], 1).float())
    learned.keep_apart()
    assert float(learned.moves.detach().abs().max()) < 1e-4
    with torch.no_grad():
        learned.moves.copy_(own)
    learned.keep_apart()
    assert learned.moves.detach()[4, 2] > 0.7


def test_cameras_in_one_place_have_no_scale_and_a_scene_without_points_has_its_extent():
    still = _common(torch.zeros(4, 3, dtype=torch.float64), torch.full((4, 2), 0.01, dtype=torch.float64))
    assert still.shape == (6, 24)
    cameras = RefinedCameras()
    cameras.prepare(Scene(ring(4), torch.zeros(0, 3)))
    assert cameras.pixels[0].tolist() == pytest.approx([1 / FOCAL, Scene.extent / FOCAL])


def test_cameras_that_are_given_stay_and_have_nothing_to_learn():
    scene = Scene(ring(4))
    cameras = Cameras()
    cameras.prepare(scene)
    frame = scene.frames[1]
    assert cameras.of(frame, 0.5) is frame.camera and cameras.align_steps == 0
    assert not list(cameras.parameters()) and cameras.learned() is None and cameras.regularisers() == {}


def test_before_its_start_nothing_is_learned():
    scene = Scene(ring(4))
    cameras = RefinedCameras(start=0.25)
    cameras.prepare(scene)
    assert cameras.of(scene.frames[1], 0.2) is scene.frames[1].camera
    assert cameras.of(scene.frames[1], 0.3).viewmat.requires_grad
    other = Frame("other.png", 99, scene.frames[1].camera)
    assert cameras.of(other, 0.3) is other.camera


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"start": 1.0}, "start in"),
        ({"weight": -1.0}, "weight"),
        ({"lr": None}, "lr must be a number"),
        ({"lr_end": -1.0}, "lr_end of 0 or more"),
        ({"align_steps": 1.5}, "align_steps"),
    ],
)
def test_options_out_of_range_are_refused(options, told):
    with pytest.raises(ValueError, match=told):
        RefinedCameras(**options)


def test_too_few_images_are_refused():
    with pytest.raises(SceneError, match="2 training images.*cameras=given"):
        RefinedCameras().prepare(Scene(ring(2)))


def test_fields_are_refused(tmp_path):
    with pytest.raises(SceneError, match="no gradient to cameras: give cameras=given"):
        run(tmp_path, *TINY, "method=thermonerf", "max_steps=3", "cameras=refined")


WRONG = (
    *TINY,
    "method=3dgs",
    "data.scene=static",
    "data.pose_error_px=1",
    "max_steps=450",
    "callbacks.camera_check.least_steps=300",
    "callbacks.costs=null",
    "callbacks.statistics=null",
    "callbacks.dashboard=null",
    "callbacks.metrics.lpips_net=null",
    "logger=none",
    "trainer.limit_val_batches=0",
)


def off(frames: list[Frame], cameras: list[Camera], points: torch.Tensor) -> float:
    """By how many pixels other cameras see the points of a scene beside where they are, root mean square over the frames."""
    squares = []
    for frame, other in zip(frames, cameras, strict=True):
        (true, depths), (seen, _) = frame.camera.project(points), other.project(points)
        squares.append((seen - true)[depths > 0].median(0).values.square().sum())
    return float(torch.stack(squares).mean().sqrt())


def test_a_run_finds_cameras_that_are_a_pixel_off(tmp_path):
    module, _ = run(tmp_path / "off", *WRONG, "cameras=refined", "cameras.align_steps=40")
    exact = build(compose([*WRONG, "data.pose_error_px=0"])["data"])
    exact.setup("fit")
    frames, points = exact.scene.train.frames, exact.scene.points.double()
    given = module.scene.train.frames
    before = off(frames, [frame.camera for frame in given], points)
    with torch.no_grad():
        after = off(frames, [module.cameras.of(frame, 1.0) for frame in given], points)
    assert before > 1.0 and after < 0.6 * before, (before, after)
    learned = module.results.run["cameras"]
    assert 0.5 < learned["turned_px"] + learned["moved_px"] < 3.0
    assert "40 steps" in module.results.data["test_cameras_aligned"]
    left, _ = run(tmp_path / "left", *WRONG)
    assert module.results.test["psnr"] > left.results.test["psnr"] + 1.0, (module.results.test, left.results.test)
    fits = [one.results.run["camera_check"]["error_falls"] for one in (module, left)]
    assert fits[0] < 0.8 * fits[1] and fits[1] > OFF, fits
    assert "cameras" not in left.results.run and "test_cameras_aligned" not in left.results.data


def test_a_run_that_was_stopped_goes_on_with_its_cameras(tmp_path):
    settings = (*WRONG, "cameras=refined", "max_steps=30", "test=false")
    whole, _ = run(tmp_path / "whole", *settings, "callbacks.checkpoint.every_n_train_steps=15")
    found = torch.load(tmp_path / "whole" / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"][
        "cameras.moves"
    ]
    assert torch.equal(found, whole.cameras.moves) and float(found.abs().max()) > 0
    ckpt = tmp_path / "whole" / "checkpoints" / "step_000015.ckpt"
    again, _ = run(tmp_path / "again", *settings, f"ckpt={ckpt}")
    assert torch.equal(again.cameras.moves, whole.cameras.moves)
    assert torch.equal(again.splats["means"], whole.splats["means"])
    trained = load(tmp_path / "whole" / "checkpoints" / "last.ckpt").module
    frame = trained.scene.train.frames[3]
    stood = whole.cameras.of(whole.scene.train.frames[3]).viewmat.detach()
    assert torch.equal(trained.cameras.of(frame).viewmat.detach(), stood) and not torch.equal(
        stood, frame.camera.viewmat
    )
    seen = whole.render(frame, camera=whole.cameras.of(frame)).features
    assert torch.equal(trained.render(frame).features, seen)


def test_a_camera_that_was_aligned_is_not_moved_again_where_its_image_was_trained_on_too(tmp_path):
    module, _ = run(tmp_path, *BARE, "method=3dgs", "max_steps=20", "cameras=refined", "cameras.align_steps=3")
    view = module.scene.train[0]  # as of a list of names that holds it for training and for the test
    with torch.no_grad():
        module.cameras.moves[0] = 3.0
    with torch.inference_mode():
        camera = module.aligned(view, view.frame.camera, 3)
        seen = module.render(view.frame, camera=camera).features.clamp(0, 1)
        assert torch.equal(module.test_step(view, 0)["prediction"], seen)


def test_only_pixels_that_count_align_a_camera(tmp_path):
    settings = (*BARE, "method=3dgs", "data.scene=static", "data.only=crate", "max_steps=20", "cameras=refined")
    module, _ = run(tmp_path, *settings, "cameras.align_steps=3", "test=true")
    assert math.isfinite(module.results.test["psnr"]) and "test_cameras_aligned" in module.results.data
