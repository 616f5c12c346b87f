"""Images of media of which the answer is known, and gradients through them."""

import math

import pytest
import torch

from heatsplat.contracts import Camera
from heatsplat.geometry.sight_lines import rays
from heatsplat.renderers.volume import VolumeRenderer

LENS = torch.tensor([[10.0, 0, 4], [0, 10.0, 3], [0, 0, 1]])
BEHIND = torch.tensor([0.2, 0.7], dtype=torch.float64)


def camera(turned: float = 0.0) -> Camera:
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 0] = viewmat[2, 2] = math.cos(turned)
    viewmat[0, 2], viewmat[2, 0] = -math.sin(turned), math.sin(turned)
    return Camera(viewmat, LENS, 8, 6)


def slab(density, low=2.0, high=3.0):
    """A medium between two planes of z that sends its x and 0.5."""

    def at(points):
        inside = (points[:, 2] >= low) & (points[:, 2] < high)
        return torch.where(inside, density, 0.0), points[:, :1]

    return at


def sent(known, directions):
    return torch.cat((torch.zeros_like(known), torch.full_like(known, 0.5)), dim=1)


def test_a_slab_hides_what_lies_behind_it_as_beer_and_lambert_say():
    renderer = VolumeRenderer(coarse=400, fine=400)
    found = renderer.of_field(slab(torch.tensor(0.9).double()), sent, 5.0, camera(), BEHIND)
    slant = rays(camera()).norm(dim=-1)  # a ray aside goes a longer way through it
    alpha = 1 - torch.exp(-0.9 * slant)
    assert torch.allclose(found.alpha[0], alpha, atol=3e-3) and alpha.max() - alpha.min() > 0.01
    assert torch.allclose(found.features[..., 0], 0.2 * (1 - found.alpha[0]))
    assert torch.allclose(found.features[..., 1], 0.7 * (1 - found.alpha[0]) + 0.5 * found.alpha[0])


def test_a_wall_is_found_by_few_samples_and_its_depth_is_the_camera_z():
    renderer = VolumeRenderer(coarse=64, fine=32)
    found = renderer.of_field(slab(torch.tensor(1e4).double(), 2.0, 2.6), sent, 5.0, camera(0.1), BEHIND)
    assert (found.alpha > 0.999).all()
    # In the world the wall is at z = 2; in the turned camera's frame at z (n · r) = 2 of the ray r.
    expected = 2.0 / (rays(camera(0.1)) @ camera(0.1).viewmat[:3, :3])[..., 2]
    assert torch.allclose(found.depth, expected, atol=0.02) and found.depth.std() > 0.03


def test_chunks_and_jitter_change_nothing_but_samples(monkeypatch):
    renderer = VolumeRenderer(coarse=16, fine=8)
    arguments = slab(torch.tensor(0.9).double()), sent, 5.0, camera(), BEHIND
    with torch.no_grad():
        whole = renderer.of_field(*arguments)
        monkeypatch.setattr("heatsplat.renderers.volume.CHUNK", 7)
        assert torch.equal(renderer.of_field(*arguments).features, whole.features)
        drawn = [renderer.of_field(*arguments, torch.Generator().manual_seed(i)).alpha for i in (0, 0, 1)]
    assert torch.equal(drawn[0], drawn[1]) and not torch.equal(drawn[0], drawn[2])


def test_the_gradient_of_the_image_by_a_density_is_that_of_the_closed_form():
    density = torch.tensor(0.9, dtype=torch.float64, requires_grad=True)
    found = VolumeRenderer(coarse=200, fine=200).of_field(slab(density), sent, 5.0, camera(), BEHIND)
    (slope,) = torch.autograd.grad(found.alpha.sum(), density)
    slant = rays(camera()).norm(dim=-1)
    assert slope.item() == pytest.approx((slant * torch.exp(-0.9 * slant)).sum().item(), rel=0.02)
    with pytest.raises(ValueError, match="must be at least 2, got 1 and 24"):
        VolumeRenderer(coarse=1)
