"""The 3D smoothing filter: arithmetic against mpmath, gradients, and what the cameras sample against a plain loop."""

import math

import mpmath
import pytest
import torch

from heatsplat.contracts import Camera
from heatsplat.geometry.projection import look_at
from heatsplat.geometry.smoothing import sampling_intervals, smoothed

AXES = (1e-20, 1e-7, 3e-4, 0.02, 1.0, 4e3)


@pytest.mark.parametrize("width", [1e-6, 0.01, 30.0])
def test_smoothed_gaussians_have_all_digits_of_float32(width):
    scales = torch.cartesian_prod(*[torch.tensor(AXES)] * 3)
    widths = torch.full((len(scales),), width)
    wide, opacities = smoothed(scales, torch.full((2, len(scales)), 0.7), widths)
    with mpmath.workdps(40):
        f = mpmath.mpf(widths[0].item())
        for row, s in enumerate(scales.tolist()):
            exact = [mpmath.sqrt(mpmath.mpf(x) ** 2 + f**2) for x in s]
            product = mpmath.fprod(mpmath.mpf(x) / e for x, e in zip(s, exact, strict=True))
            assert wide[row].tolist() == pytest.approx([float(e) for e in exact], rel=3e-7)
            expected = float(mpmath.mpf(opacities.new_tensor(0.7).item()) * product)
            assert opacities[:, row].tolist() == pytest.approx([expected] * 2, rel=1e-6, abs=1e-37)


def test_mass_is_kept():
    """The integral of a Gaussian is opacity times the product of its semi-axes: a convolution leaves it alone."""
    generator = torch.Generator().manual_seed(0)
    scales = torch.rand(50, 3, generator=generator, dtype=torch.float64).mul(12).sub(10).exp()
    opacities, widths = torch.rand(2, 50, generator=generator, dtype=torch.float64)
    wide, fainter = smoothed(scales, opacities, widths)
    assert torch.allclose(fainter * wide.prod(1), opacities * scales.prod(1), rtol=1e-12, atol=0)


def test_gradients_are_those_of_finite_differences_for_tiny_scales_too():
    logs = torch.log(torch.tensor([[1e-7, 1e-4, 0.3], [0.02, 0.01, 5.0]], dtype=torch.float64)).requires_grad_()
    opacities = torch.tensor([[0.9, 0.2]], dtype=torch.float64, requires_grad=True)
    widths = torch.tensor([0.01, 0.05], dtype=torch.float64)

    def logarithms(logs, opacities):
        return [result.log() for result in smoothed(logs.exp(), opacities, widths)]

    assert torch.autograd.gradcheck(logarithms, (logs, opacities), rtol=1e-6)
    tiny = torch.full((1, 3), 1e-30, requires_grad=True)
    smoothed(tiny, torch.ones(1, 1), torch.full((1,), 0.1))[1].sum().backward()
    assert tiny.grad.isfinite().all()


def cameras() -> list[Camera]:
    eyes = ([0.0, 0.0, -4.0], [2.0, 0.5, -2.5], [-1.5, 1.0, -3.0])
    up, target = torch.tensor([0.0, -1.0, 0.0]), torch.zeros(3)
    found = []
    for k, eye in enumerate(eyes):
        K = torch.tensor([[40.0 + 8 * k, 0, 20], [0, 36.0 + 11 * k, 13], [0, 0, 1]])  # the longest is one of the y axis
        found.append(Camera(look_at(torch.tensor(eye), target, up), K, 36, 28))
    return found


def test_sampling_intervals_are_those_of_a_loop_over_points_and_cameras():
    generator = torch.Generator().manual_seed(3)
    points = torch.rand(400, 3, generator=generator, dtype=torch.float64) * 10 - 5
    near, margin, unseen, least = 0.2, 0.15, [], []
    for point in points.tolist():
        distances = []
        for camera in cameras():
            turn, shift, K = camera.viewmat[:3, :3].tolist(), camera.viewmat[:3, 3].tolist(), camera.K.tolist()
            x, y, z = (sum(a * b for a, b in zip(turn[k], point, strict=True)) + shift[k] for k in range(3))
            if z <= near:
                continue
            column, line = K[0][0] * x / z + K[0][2], K[1][1] * y / z + K[1][2]
            if -margin * 36 <= column <= 1.15 * 36 and -margin * 28 <= line <= 1.15 * 28:
                distances.append(z)
        unseen.append(not distances)
        least.append(min(distances, default=math.nan))
    farthest = max(z for z in least if not math.isnan(z))
    expected = [farthest if hidden else z for hidden, z in zip(unseen, least, strict=True)]
    assert 50 < sum(unseen) < 350
    found = sampling_intervals(points, cameras(), near, margin)
    assert torch.allclose(found, torch.tensor(expected, dtype=torch.float64) / 58.0, rtol=1e-12)


def test_points_that_no_camera_sees_are_told():
    with pytest.raises(ValueError, match="none of 2 points is seen .* lower 'near'"):
        sampling_intervals(torch.full((2, 3), 100.0), cameras())
    with pytest.raises(ValueError, match="none of 1 points is seen by a camera from more than 50 "):
        sampling_intervals(torch.zeros(1, 3), cameras(), near=50.0)
