"""Evidence counts only pixels that count, and takes a scene the right way round."""

import pytest
import torch

from heatsplat.contracts import Camera, Frame, SceneData, View, ViewSet
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.observations import observe
from heatsplat.effects.physical.conduction import _kept
from heatsplat.effects.physical.point_spread import evidence as point_spread
from heatsplat.effects.physical.thermal_opacity import _nearer
from heatsplat.physics.noise import noise_of, noise_of_repeats

HEIGHT, WIDTH, NOISE = 48, 64, 0.01


def noisy(frames, seed=0):
    generator = torch.Generator().manual_seed(seed)
    slope = torch.linspace(0.2, 0.6, WIDTH).expand(HEIGHT, WIDTH)
    return (slope + NOISE * torch.randn(frames, HEIGHT, WIDTH, generator=generator)).double()


def filled(frames, share=0.4):
    """Images whose left part is a constant that a loader put where nothing was measured, and where they count."""
    images, masks = noisy(frames), torch.ones(frames, HEIGHT, WIDTH, dtype=torch.bool)
    masks[:, :, : int(share * WIDTH)] = False
    return torch.where(masks, images, 0.0), masks


@pytest.mark.parametrize("estimate", [noise_of, noise_of_repeats])
def test_a_constant_under_the_mask_is_not_taken_for_a_quiet_sensor(estimate):
    images, masks = filled(8, share=0.6)
    assert estimate(images, masks=masks) == pytest.approx(NOISE, rel=0.2)
    assert estimate(images) < 0.5 * NOISE  # what it would have been


def test_images_of_which_no_pixel_counts_have_the_noise_of_rounding():
    images, masks = filled(4, share=1.0)
    assert noise_of(images, step=0.12, masks=masks) == pytest.approx(0.12 / 12**0.5)
    assert noise_of_repeats(images, masks) == 0.0


def scene(viewmats, images, masks=None, points=None):
    K = torch.tensor([[60.0, 0, WIDTH / 2], [0, 60.0, HEIGHT / 2], [0, 0, 1]])
    frames = [Frame(f"{i}.png", i, Camera(viewmat, K, WIDTH, HEIGHT), 10.0 * i) for i, viewmat in enumerate(viewmats)]
    views = ViewSet(
        frames, lambda i: View(frames[i], images[i].float()[..., None], mask=None if masks is None else masks[i])
    )
    nothing = torch.zeros(0, 3) if points is None else points
    return SceneData("made", views, views.subset([]), views.subset([]), nothing)


def test_observations_leave_out_what_does_not_count():
    images, masks = filled(6)
    seen = observe(scene([torch.eye(4)] * 6, images, masks))
    assert seen.noise == pytest.approx(NOISE, rel=0.2) and seen.masks is not None
    counted = seen.tracks.weights.sum(1) > 0
    assert (seen.tracks.positions[counted, 0, 0] > -0.25).all() and not counted.all()


def test_a_point_beside_a_pixel_that_does_not_count_takes_no_share_of_it():
    masks = torch.ones(6, HEIGHT, WIDTH, dtype=torch.bool)
    masks[:, ::4, ::4] = False
    images = torch.where(masks, 0.5, -9.0).double()
    viewmats = torch.eye(4).repeat(6, 1, 1)
    viewmats[:, 0, 3] = torch.linspace(-0.5, 0.5, 6)
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([4.0, 3.0, 0.5])
    tracks = observe(scene(list(viewmats), images, masks, points - torch.tensor([2.0, 1.5, -5.0]))).tracks
    seen = tracks.weights > 0
    assert 100 < int(seen.sum()) < seen.numel() and float((tracks.values[seen] - 0.5).abs().max()) < 1e-9


def test_the_border_of_a_mask_is_no_edge_of_the_scene():
    images, masks = filled(6)
    evidence = point_spread(Inspection(scene([torch.eye(4)] * 6, images, masks)))
    assert evidence.statistic is None and "only 0 edges" in evidence.reason and not evidence.told
    assert "only 0 edges" not in point_spread(Inspection(scene([torch.eye(4)] * 6, images))).reason


def test_a_tripod_that_a_reconstruction_shakes_a_little_stands_still():
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(200, 3, generator=generator) * torch.tensor([4.0, 3.0, 4.0]) + torch.tensor([-2.0, -1.5, 4.0])

    def shaken(size):
        viewmats = torch.eye(4).repeat(6, 1, 1)
        viewmats[1:, :3, 3] += size * torch.randn(5, 3, generator=generator)
        return list(viewmats)

    assert observe(scene(shaken(1e-3), noisy(6), points=points)).still
    assert not observe(scene(shaken(0.3), noisy(6), points=points)).still


def test_levels_that_warm_keep_as_much_of_their_distance_as_levels_that_cool():
    excess = torch.linspace(0.05, 0.4, 50)
    for sign in (1.0, -1.0):
        before, after = 0.5 + sign * excess, 0.5 + sign * 0.6 * excess
        assert float(_kept(before, after, 0.5)) == pytest.approx(0.6)
        assert 0.3 < float(_kept(before, after, None)) < 0.7


def test_of_points_on_one_line_of_sight_the_nearest_hides_the_others():
    pixels = torch.tensor([[10.2, 10.2], [10.4, 10.6], [10.8, 10.1], [30.0, 30.0]])
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [1, 3, 0, 2]):
        depths = torch.tensor([5.0, 1.0, 3.0, 9.0])[order]
        found = _nearer(pixels[order], depths, torch.ones(4, dtype=torch.bool), 40)
        nearest = order.index(1)
        expected = [nearest if point in (0, 2) else -1 for point in order]
        assert found.tolist() == expected
    assert _nearer(pixels, torch.ones(4), torch.zeros(4, dtype=torch.bool), 40).tolist() == [-1] * 4
