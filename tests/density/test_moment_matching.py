"""One Gaussian in the place of two, against integrals over a grid and closed forms, in float64."""

import mpmath
import pytest
import torch

from heatsplat.density.moment_matching import Shapes, merged
from heatsplat.geometry.rotations import quats_to_matrices
from heatsplat.splats import Splats

F = torch.float64
AXES = torch.tensor([0.7, 0.4, 0.1], dtype=F)
KEPT = ((1, 2), (0, 2), (0, 1))  # axes that are left of a shape seen along each axis


def shapes(means, axes, rotation, opacities):
    """n Gaussians of one rotation [3, 3]."""
    axes = torch.as_tensor(axes, dtype=F).expand(len(means), 3)
    return Shapes(torch.as_tensor(means, dtype=F), rotation * axes[:, None], torch.as_tensor(opacities, dtype=F))


def covariances(shapes):
    return shapes.axes @ shapes.axes.mT


def on_grid(mean, covariance):
    """A Gaussian of peak 1 over a plane [400, 400], and the area of a pixel."""
    line = torch.linspace(-5, 5, 400, dtype=F)
    grid = torch.stack(torch.meshgrid(line, line, indexing="ij"), dim=-1) - mean
    inverse = torch.linalg.inv(covariance)
    return torch.exp(-torch.einsum("xyi,ij,xyj->xy", grid, inverse, grid) / 2), (line[1] - line[0]) ** 2


def rotation():
    return quats_to_matrices(torch.tensor([0.8, 0.3, -0.4, 0.33], dtype=F))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_two_halves_of_a_split_gaussian_give_back_the_parent(axis):
    turn, opacity = rotation(), 0.35
    offset = 0.6 * AXES[axis] * turn[:, axis]
    axes = AXES.clone()
    axes[axis] *= 0.8  # 0.6² + 0.8² = 1
    center = torch.tensor([0.3, -0.2, 0.5], dtype=F)
    halves = shapes(torch.stack([center - offset, center + offset]), axes, turn, [[opacity], [opacity]])
    found = merged(halves[:1], halves[1:])

    torch.testing.assert_close(found.shapes.means[0], center)
    torch.testing.assert_close(covariances(found.shapes)[0], turn @ torch.diag(AXES.square()) @ turn.T)
    # What is seen of the halves along the three axes, summed over a grid, is what is seen of the parent.
    seen = whole = 0.0
    for kept in KEPT:
        kept = torch.tensor(kept)
        place = torch.zeros(3, dtype=F)
        place[axis] = 0.6 * AXES[axis]
        one, pixel = on_grid(place[kept], torch.diag(axes[kept].square()))
        other, _ = on_grid(-place[kept], torch.diag(axes[kept].square()))
        a, b = opacity * one, opacity * other
        seen += ((a + b - a * b) * pixel).sum()
        whole += (on_grid(torch.zeros(2, dtype=F), torch.diag(AXES[kept].square()))[0] * pixel).sum()
    assert found.shapes.opacities[0, 0].item() == pytest.approx((seen / whole).item(), rel=1e-6)
    assert found.distances.item() < 0.02


def test_moments_are_those_of_the_pair_by_mass():
    turn = rotation()
    both = shapes([[0.0, 0.1, 0.2], [0.5, -0.3, 0.1]], [AXES.tolist(), [0.2, 0.3, 0.6]], turn, [[0.9, 0.3], [0.2, 0.4]])
    found = merged(both[:1], both[1:])
    weights = both.masses / both.masses.sum()
    mean = (weights[:, None] * both.means).sum(0)
    second = (weights[:, None, None] * (covariances(both) + both.means[:, :, None] * both.means[:, None])).sum(0)
    torch.testing.assert_close(found.shares[0], weights[0])
    torch.testing.assert_close(found.shapes.means[0], mean)
    torch.testing.assert_close(covariances(found.shapes)[0] + mean[:, None] * mean, second)


def test_the_raw_tensors_describe_the_same_shapes():
    both = shapes([[0.0, 0.1, 0.2], [0.5, -0.3, 0.1]], AXES, rotation(), [[0.5], [0.2]])
    found = merged(both[:1], both[1:])
    raw = found.raw()
    axes = quats_to_matrices(raw["quats"]) * raw["log_scales"].exp()[:, None]
    torch.testing.assert_close(axes @ axes.mT, covariances(found.shapes))
    torch.testing.assert_close(raw["opacity_logits"].sigmoid(), found.shapes.opacities)


def test_alphas_on_top_of_each_other_do_not_add_up():
    """∫ (a + b - ab) of two equal Gaussians is (2 o - o² / 2) times the area of one."""
    both = shapes(torch.zeros(2, 3), AXES, rotation(), [[0.4, 0.1], [0.4, 0.1]])
    found = merged(both[:1], both[1:])
    torch.testing.assert_close(found.shapes.opacities[0], torch.tensor([0.72, 0.195], dtype=F))


def test_a_transparent_partner_changes_nothing():
    both = shapes([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]], AXES, rotation(), [[0.6], [1e-12]])
    found = merged(both[:1], both[1:])
    torch.testing.assert_close(found.shapes.opacities[0, 0], torch.tensor(0.6, dtype=F))
    assert found.distances.item() < 1e-9


def minors(covariance):
    """Sum of the 2 x 2 principal minors of an mpmath matrix."""
    return sum(covariance[i, i] * covariance[j, j] - covariance[i, j] ** 2 for i, j in KEPT)


@pytest.mark.parametrize("ratio", [1e-2, 1e-5, 1e-8, 1e-11])
def test_thin_gaussians_keep_their_masses(ratio):
    """Of needles that lie in each other and of crossed ones, against covariances in 80 digits."""
    turns = quats_to_matrices(torch.tensor([[0.8, 0.3, -0.4, 0.33], [0.7, 0.1, 0.5, -0.2]], dtype=F))
    needle, opacity = torch.tensor([ratio, 1.0, 2 * ratio], dtype=F), torch.tensor([[0.5]], dtype=F)
    one, other = (Shapes(torch.zeros(1, 3, dtype=F), (turn * needle)[None], opacity) for turn in turns)
    rel = 1e-14 / ratio  # principal axes are right to 1e-16 of a turn, which lifts the width by so much of the length
    for second in (one, other):
        found = merged(one, second)
        with mpmath.workdps(80):
            parts = [mpmath.matrix(shape.axes[0].tolist()) for shape in (one, second)]
            parts = [axes * axes.T for axes in parts]
            masses = [mpmath.sqrt(minors(part)) / 2 for part in parts]
            share = masses[0] / sum(masses)
            variances = sorted(map(float, mpmath.eigsy(share * parts[0] + (1 - share) * parts[1], eigvals_only=True)))
            masses = list(map(float, masses))
        assert one.masses.item() == pytest.approx(masses[0], rel=1e-12)
        assert second.masses.item() == pytest.approx(masses[1], rel=1e-12)
        assert found.shares.item() == pytest.approx(float(share), rel=1e-12)
        assert found.variances[0].sort().values.tolist() == pytest.approx(variances, rel=rel)
        assert found.distances.item() < 1.0 and found.distances.isfinite()
        if second is one:  # o - o² / 4 of two alphas that are the same
            assert found.shapes.opacities.item() == pytest.approx(0.875, rel=rel)
            assert found.shapes.masses.item() == pytest.approx(1.75 * masses[0], rel=rel)
            assert found.distances.item() == pytest.approx(1 / 64, rel=10 * rel)


def test_a_zero_quaternion_which_no_renderer_shows_is_in_no_pair():
    rows = {"means": torch.zeros(2, 3), "log_scales": torch.zeros(2, 3), "opacity_logits": torch.zeros(2, 1)}
    hidden = Shapes.of(Splats(rows | {"quats": torch.tensor([[0.0, 0, 0, 0], [1.0, 0, 0, 0]])}))
    assert hidden.masses[0] == 0 and hidden.masses[1] > 0
    for first, second in ((0, 1), (1, 0), (0, 0)):
        assert merged(hidden[[first]], hidden[[second]]).distances.item() == torch.inf
