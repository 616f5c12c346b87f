"""Blur of a learned width: the identity at first, the discrete Gaussian against 40 digits, recovery of a known width."""

import mpmath
import pytest
import torch

from heatsplat.contracts import Camera, Frame, SceneData, ViewSet
from heatsplat.sensors.point_spread import PointSpread, discrete_gaussian

HEIGHT, WIDTH = 24, 32
FRAME = Frame("0.png", 0, Camera(torch.eye(4), torch.eye(3), WIDTH, HEIGHT))


def ready(raw=0.0, **options):
    views = ViewSet([FRAME], lambda index: None)
    part = PointSpread(**options)
    part.prepare(SceneData("bars", views, views, views, torch.zeros(4, 3)))
    with torch.no_grad():
        part.raw_spread.fill_(raw)
    return part


def noise(height=HEIGHT, width=WIDTH, channels=1, seed=0):
    return torch.rand(height, width, channels, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("variance", [0.0, 1e-6, 0.01, 0.5, 2.0])
def test_weights_are_those_of_the_heat_equation_on_a_grid(variance):
    taps = discrete_gaussian(torch.tensor(variance, dtype=torch.float64), 14)
    with mpmath.workdps(40):
        t = mpmath.mpf(variance)
        expected = [float(mpmath.exp(-t) * mpmath.besseli(abs(n), t)) for n in range(-14, 15)]
    assert torch.allclose(taps, torch.tensor(expected, dtype=torch.float64), atol=1e-12)
    squared = torch.arange(-14, 15, dtype=torch.float64) ** 2
    assert taps.sum().item() == pytest.approx(1, abs=1e-14)
    assert (taps * squared).sum().item() == pytest.approx(variance, abs=1e-10)


@pytest.mark.parametrize("channels", [1, 3])
def test_a_new_part_is_the_identity_and_can_leave_it(channels):
    part, image = ready(), noise(channels=channels)
    assert torch.allclose(part(image, FRAME), image, rtol=0, atol=1e-7)
    blurred = ready(0.3)(image, FRAME)
    (part(image, FRAME) - blurred).square().sum().backward()
    assert part.raw_spread.grad < -1e-2  # a descent makes it wider


@pytest.mark.parametrize("shape", [(9, 7, 1), (5, 12, 3)])
@pytest.mark.parametrize("raw", [0.05, 0.4])
def test_gradients_are_those_of_finite_differences(shape, raw):
    part = ready(raw, width_max=1.0).double()
    image = noise(*shape).double().requires_grad_()
    weights = noise(*shape, seed=1).double()

    def blurred(image, raw_spread):
        return torch.func.functional_call(part, {"raw_spread": raw_spread}, (image, FRAME)) * weights

    assert torch.autograd.gradcheck(blurred, (image, torch.tensor(raw, dtype=torch.float64, requires_grad=True)))


def test_an_even_image_stays_even_and_blurs_add_in_variance():
    part = ready(0.4)
    assert torch.allclose(part(torch.full((HEIGHT, WIDTH, 1), 0.7), FRAME), torch.tensor(0.7), atol=1e-6)
    point = torch.zeros(41, 41, 1)
    point[20, 20] = 1.0
    part.trained_width.fill_(41)
    spot = part(point, FRAME)[..., 0]
    offsets = torch.arange(41) - 20.0
    assert spot.sum().item() == pytest.approx(1, abs=1e-5)
    assert (spot.sum(0) * offsets**2).sum().item() == pytest.approx(part.variance().item(), rel=1e-4)


def test_the_width_counts_in_pixels_of_a_training_image():
    part = ready(0.3)
    coarse, fine = noise(4, 5), 4
    image = coarse.repeat_interleave(8, 0).repeat_interleave(8, 1)[:HEIGHT, :WIDTH]
    finer = image.repeat_interleave(fine, 0).repeat_interleave(fine, 1)
    means = part(finer, FRAME).unfold(0, fine, fine).unfold(1, fine, fine).mean((-1, -2))
    assert (means - part(image, FRAME)).abs().max() < 0.05 < 0.1 < (image - part(image, FRAME)).abs().max()


def test_the_width_is_bounded_and_never_negative():
    assert ready(-3.0).variance().item() == 0.0
    assert torch.allclose(ready(-3.0)(noise(), FRAME), noise(), rtol=0, atol=1e-7)
    assert ready(50.0).variance().item() == pytest.approx(4.0)
    part = ready(-0.5)
    part.variance().backward()
    assert part.raw_spread.grad > 0  # it can come back


def test_a_known_width_is_found():
    sharp = noise()
    target = ready(0.25)(sharp, FRAME).detach()
    part = ready()
    optimizer = torch.optim.Adam(part.parameters(), lr=0.02)
    for _ in range(80):
        optimizer.zero_grad()
        ((part(sharp, FRAME) - target).square().mean() + part.regulariser()).backward()
        optimizer.step()
    assert part.variance().item() == pytest.approx(ready(0.25).variance().item(), rel=0.1)
    assert part.effects()["point_spread"]["width_px"] == pytest.approx(part.variance().item() ** 0.5)


def test_a_bound_of_nothing_is_refused():
    with pytest.raises(ValueError, match="width_max is a width in pixels"):
        PointSpread(width_max=0)
