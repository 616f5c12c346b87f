"""Camera paths: they pass through what they should, look at what they should, and turn smoothly."""

import math

import pytest
import torch

from heatsplat.contracts import Camera
from heatsplat.geometry.projection import look_at, to_camera
from heatsplat.geometry.trajectories import attention, fixed_view, interpolate, orbit

K = torch.tensor([[50.0, 0, 30], [0, 55, 26], [0, 0, 1]], dtype=torch.float64)
UP = torch.tensor([0.2, 0.3, 1.0], dtype=torch.float64)
UP = UP / UP.norm()
CENTRE = torch.tensor([3.0, -1.0, 2.0], dtype=torch.float64)


def camera(eye, target=CENTRE, up=UP, size=(64, 48)):
    return Camera(look_at(torch.as_tensor(eye, dtype=torch.float64), target, up), K, *size)


def ring(count=12, radius=4.0, height=1.5, share=1.0):
    """Cameras on (part of) a circle about UP through CENTRE."""
    first = torch.linalg.cross(UP, torch.tensor([1.0, 0, 0], dtype=torch.float64))
    first = first / first.norm()
    second = torch.linalg.cross(UP, first)
    angles = [2 * math.pi * share * i / count for i in range(count)]
    return [camera(CENTRE + height * UP + radius * (math.cos(a) * first + math.sin(a) * second)) for a in angles]


def test_attention_is_where_the_axes_meet():
    torch.testing.assert_close(attention(ring()), CENTRE)


def test_attention_of_parallel_axes_lies_ahead():
    eyes = [torch.tensor([x, 0.0, 0.0], dtype=torch.float64) for x in (-1.0, 0.0, 1.0)]
    forward = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    cameras = [camera(eye, eye + forward, up) for eye in eyes]
    torch.testing.assert_close(attention(cameras), forward * 2 / 3)
    torch.testing.assert_close(attention(cameras[:1]), eyes[0] + forward)


def test_attention_is_never_behind():
    # Axes that part: they meet behind the cameras, where there is nothing to look at.
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    cameras = [
        camera((x, 0.0, 0.0), torch.tensor([2 * x, 0.0, 5.0], dtype=torch.float64), up) for x in (-1.0, -0.5, 0.5, 1.0)
    ]
    assert attention(cameras)[2] > 0


@pytest.mark.parametrize("height", [0.0, 1.5, 6.0])
def test_orbit_is_the_circle_of_a_ring_of_cameras(height):
    cameras = ring(height=height)
    path = orbit(cameras, 24)
    assert len(path) == 24
    torch.testing.assert_close(path[0].center, cameras[0].center)
    torch.testing.assert_close(path[12].center, cameras[6].center)
    for shot in path:
        offset = shot.center - CENTRE
        assert (offset @ UP).item() == pytest.approx(height, abs=1e-9)
        assert offset.norm().item() == pytest.approx(math.hypot(4.0, height))
        ahead = to_camera(CENTRE, shot.viewmat)
        assert ahead[:2].abs().max() < 1e-9
        assert ahead[2] > 0
        assert (shot.viewmat[1, :3] @ UP) < 0  # upright
        assert (shot.width, shot.height) == (64, 48)
        assert torch.equal(shot.K, K)


def test_orbit_of_half_a_ring_goes_all_round():
    path = orbit(ring(share=0.5), 8)
    steps = [(a.center - b.center).norm().item() for a, b in zip(path, [*path[1:], path[0]], strict=True)]
    assert steps == pytest.approx([steps[0]] * 8, rel=1e-6)


@pytest.mark.parametrize("down", [(0.0, 0.0, -1.0), (0.0, 1.0, 0.0)])
def test_orbit_of_a_one_sided_capture_stays_on_its_side(down):
    # A grid of cameras that all look the same way, like a drone over the ground.
    down = torch.tensor(down, dtype=torch.float64)
    ahead = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    side = torch.linalg.cross(down, ahead)
    cameras = [
        camera(-10 * down + i * ahead + j * side, (0.01 * i) * ahead, ahead) for i in range(-2, 3) for j in range(-2, 3)
    ]
    for shot in orbit(cameras, 9):
        assert (shot.center @ down).item() == pytest.approx(-10, abs=0.5)
        assert (shot.viewmat[2, :3] @ down) > 0.9
        assert (shot.viewmat[1, :3] @ ahead) < -0.9


def test_orbit_needs_a_circle():
    one = camera((0.0, 0.0, 0.0))
    around = [camera(CENTRE, turned.center) for turned in ring(5, height=0.0)]  # a panorama from a tripod
    for cameras in ([one, one], around):
        with pytest.raises(ValueError, match="stand at one place or on one line of sight and give no orbit; choose"):
            orbit(cameras, 5)
    with pytest.raises(ValueError, match="a trajectory needs at least one camera"):
        orbit([], 5)


def test_interpolation_passes_through_the_cameras():
    cameras = ring(7)
    path = interpolate(cameras, 6 * 5 + 1)
    assert len(path) == 31
    for given, shot in zip(cameras, path[::5], strict=True):
        torch.testing.assert_close(shot.viewmat, given.viewmat, rtol=0, atol=1e-12)


def test_interpolation_is_smooth():
    path = interpolate(ring(7), 6 * 50 + 1)
    centres = torch.stack([shot.center for shot in path])
    steps = centres.diff(dim=0)
    assert steps.norm(dim=1).min() > 0
    assert (steps.diff(dim=0).norm(dim=1) / steps.norm(dim=1).mean()).max() < 0.05  # no kink at a camera
    turns = torch.stack([a.viewmat[2, :3] @ b.viewmat[2, :3] for a, b in zip(path, path[1:], strict=False)])
    assert turns.clamp(max=1).arccos().max() < 0.03


def test_interpolation_scales_intrinsics_to_the_first_camera():
    small, large = camera((0.0, 0.0, 0.0)), camera((1.0, 0.0, 0.0), size=(128, 96))
    path = interpolate([small, large], 3)
    assert {(shot.width, shot.height) for shot in path} == {(64, 48)}
    assert path[2].K[0, 0].item() == 25
    assert path[1].K[0, 0].item() == 37.5


def test_interpolation_of_one_camera_stands_still():
    one = camera((0.0, 0.0, 0.0))
    assert interpolate([one], 4) == fixed_view(one, 4) == [one] * 4
    assert len(interpolate(ring(3), 1)) == 1
