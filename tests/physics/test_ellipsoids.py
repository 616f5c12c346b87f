"""Areas of ellipsoids over their volumes, against independent derivations."""

import math

import pytest
import torch

from heatsplat.physics import ellipsoids
from heatsplat.training.rng import generator_for

AXES = torch.tensor([[1.0, 1.0, 1.0], [2.0, 1.0, 0.5], [1.0, 1.0, 0.01], [0.3, 5.0, 0.05]], dtype=torch.float64)


def volumes(axes):
    return 4 / 3 * math.pi * axes.prod(-1)


def directions(count: int) -> torch.Tensor:
    return torch.nn.functional.normalize(
        torch.randn(count, 3, generator=generator_for(0, 0, "directions"), dtype=torch.float64), dim=-1
    )


def plane(direction):
    """Two unit vectors [2, 3] that span the plane across a direction."""
    return torch.linalg.svd(direction[None]).Vh[1:]


def test_exact_projection_is_the_area_of_the_shadow():
    for direction in directions(8):
        basis = plane(direction)
        shadow = math.pi * torch.linalg.det(basis @ torch.diag_embed(AXES.square()) @ basis.T).sqrt()
        ours = ellipsoids.projected_area_ratio(AXES, direction) * volumes(AXES)
        torch.testing.assert_close(ours, shadow, rtol=1e-10, atol=0)


def test_printed_projection_is_the_central_section():
    for direction in directions(8):
        basis = plane(direction)
        section = math.pi / torch.linalg.det(basis @ torch.diag_embed(AXES.square().reciprocal()) @ basis.T).sqrt()
        ours = ellipsoids.projected_area_ratio(AXES, direction, "printed") * volumes(AXES)
        torch.testing.assert_close(ours, section, rtol=1e-10, atol=0)


def test_both_projections_agree_along_the_axes_only():
    for direction in torch.eye(3, dtype=torch.float64):
        exact, printed = (ellipsoids.projected_area_ratio(AXES, direction, option) for option in ("exact", "printed"))
        torch.testing.assert_close(exact, printed)
    slanted = torch.tensor([math.sqrt(0.5), 0.0, math.sqrt(0.5)], dtype=torch.float64)
    disc = AXES[2]
    exact, printed = (ellipsoids.projected_area_ratio(disc, slanted, option) for option in ("exact", "printed"))
    assert (exact * volumes(disc)).item() == pytest.approx(2.2216, abs=1e-3)
    assert (printed / exact).item() == pytest.approx(0.02, abs=1e-3)


def test_radiating_area_is_the_surface_within_thomsens_error():
    steps = 400
    theta = (torch.arange(steps, dtype=torch.float64) + 0.5) * math.pi / steps
    phi = (torch.arange(2 * steps, dtype=torch.float64) + 0.5) * math.pi / steps
    theta, phi = torch.meshgrid(theta, phi, indexing="ij")
    normal = torch.stack((theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()), dim=-1)
    for axes in AXES:
        # The surface element of an ellipsoid is abc |n / axes| over that of the unit sphere.
        element = axes.prod() * (normal / axes).norm(dim=-1) * theta.sin()
        area = element.sum() * (math.pi / steps) ** 2
        ours = ellipsoids.radiating_area_ratio(axes) * volumes(axes)
        assert abs(ours / area - 1) < 0.0107


def test_printed_convection_is_a_quarter_of_a_spheres_surface():
    sphere = torch.full((3,), 0.2, dtype=torch.float64)
    assert ellipsoids.radiating_area_ratio(sphere).item() == pytest.approx(3 / 0.2)
    assert ellipsoids.convecting_area_ratio(sphere).item() == pytest.approx(3 / 0.2)
    assert ellipsoids.convecting_area_ratio(sphere, "printed").item() == pytest.approx(3 / 0.2 / 4)
    printed = math.pi / 3 * (2 * 1 + 2 * 0.5 + 1 * 0.5) / volumes(AXES[1])
    torch.testing.assert_close(ellipsoids.convecting_area_ratio(AXES[1], "printed"), printed)


def test_ratios_of_tiny_splats_stay_finite_in_float32():
    axes = torch.tensor([[1e-13, 1e-14, 1e-20], [1e-7, 1e-7, 1e-19]])
    assert volumes(axes)[0] == 0  # why area and volume are never formed apart
    direction = torch.nn.functional.normalize(torch.tensor([1.0, 1.0, 1.0]), dim=0)
    for ratio in (
        ellipsoids.radiating_area_ratio(axes),
        ellipsoids.convecting_area_ratio(axes, "printed"),
        ellipsoids.projected_area_ratio(axes, direction),
    ):
        assert ratio.isfinite().all()
        assert (ratio > 0).all()


def test_axes_are_floored_in_metres():
    scales = torch.tensor([[0.001, 0.5, 2.0]])
    torch.testing.assert_close(ellipsoids.floored_axes(scales, 0.1), torch.tensor([[0.01, 0.05, 0.2]]))
    with pytest.raises(ValueError, match="metres_per_unit and smallest_m must be positive"):
        ellipsoids.floored_axes(scales, 0.0)


def test_unknown_options_are_named():
    with pytest.raises(ValueError, match="surface_area must be one of consistent, printed, got 'half'"):
        ellipsoids.convecting_area_ratio(AXES, "half")
    with pytest.raises(ValueError, match="projected_area must be one of exact, printed, got 'half'"):
        ellipsoids.projected_area_ratio(AXES, AXES, "half")
