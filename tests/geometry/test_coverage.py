"""What training cameras have seen, on a wall whose answers are known without a renderer."""

import pytest
import torch

from heatsplat.contracts import Camera
from heatsplat.geometry.coverage import FAR, Sighting, _sees, covered, gap_free, seen_means, surface_depth
from heatsplat.geometry.projection import look_at

K = torch.tensor([[20.0, 0.0, 16.0], [0.0, 20.0, 12.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def camera(x: float, z: float = 0.0) -> Camera:
    """At (x, 0, z), looking along z with y downwards; 32 x 24 pixels see 1.6 x 1.2 of a wall at distance 1."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = torch.tensor([-x, 0.0, -z])
    return Camera(viewmat, K, 32, 24)


def wall(distance: float = 2.0) -> torch.Tensor:
    return torch.full((24, 32), distance, dtype=torch.float64)


def test_a_camera_covers_what_it_has_seen_itself():
    assert covered(camera(0.0), wall(), [Sighting(camera(0.0), wall())]).all()


def test_what_lies_beyond_the_training_image_is_not_covered():
    # At distance 2 a pixel is 0.1 wide: moved by 1 to the right, the ten rightmost columns are new.
    seen = covered(camera(1.0), wall(), [Sighting(camera(0.0), wall())])
    assert seen[:, :22].all() and not seen[:, 22:].any()
    both = covered(camera(1.0), wall(), [Sighting(camera(0.0), wall()), Sighting(camera(2.0), wall())])
    assert both.all()


def test_what_was_hidden_behind_a_surface_is_not_covered():
    behind = covered(camera(0.0), wall(2.0), [Sighting(camera(0.0), wall(1.0))])
    assert not behind.any()
    assert covered(camera(0.0), wall(1.0), [Sighting(camera(0.0), wall(2.0))]).all()  # in front it would have been seen
    assert covered(camera(0.0), wall(2.08), [Sighting(camera(0.0), wall(2.0))]).all()  # within the tolerance


def test_behind_a_camera_nothing_is_covered():
    viewmat = look_at(torch.zeros(3), torch.tensor([0.0, 0.0, -1.0]), torch.tensor([0.0, -1.0, 0.0])).double()
    assert not covered(Camera(viewmat, K, 32, 24), wall(), [Sighting(camera(0.0), wall())]).any()


def test_pixels_without_a_surface_are_directions():
    open_sky = torch.full((24, 32), torch.inf, dtype=torch.float64)
    assert covered(camera(5.0), open_sky, [Sighting(camera(0.0), open_sky)]).all()
    assert not covered(camera(5.0), open_sky, [Sighting(camera(0.0), wall())]).any()


def test_a_hole_in_a_surface_is_no_sky():
    hole = wall()
    hole[12, 16] = torch.inf
    open_sky = torch.full((24, 32), torch.inf, dtype=torch.float64)
    assert not covered(camera(0.0), open_sky, [Sighting(camera(0.0), hole)]).any()
    half = wall()
    half[:12] = torch.inf  # above the horizon
    seen = covered(camera(0.0), open_sky, [Sighting(camera(0.0), half)])
    assert seen[:11].all() and not seen[11:].any()


def test_masked_pixels_of_training_images_cover_nothing():
    mask = torch.ones(24, 32, dtype=torch.bool)
    mask[:, :16] = False
    seen = covered(camera(0.0), wall(), [Sighting(camera(0.0), wall(), mask)])
    assert not seen[:, :16].any() and seen[:, 16:].all()


def test_depth_maps_may_be_coarser_than_the_image():
    fine = camera(0.0)
    assert covered(fine, wall(), [Sighting(fine.resized(8, 6), wall()[:6, :8])]).all()


@pytest.mark.parametrize("seed", range(4))
def test_no_pixel_is_missed_where_tiles_are_looked_for_first(seed):
    """Against all pixels in all images: cameras of other sizes all around, depths with jumps and holes, and masks."""
    generator = torch.Generator().manual_seed(seed)

    def seen_from(width: int, height: int) -> tuple[Camera, torch.Tensor]:
        eye, target = torch.randn(2, 3, generator=generator, dtype=torch.float64) * torch.tensor([[4.0], [1.0]])
        focal = 10.0 + 60.0 * torch.rand(1, generator=generator).item()
        K = torch.tensor([[focal, 0, 0.4 * width], [0, 1.1 * focal, 0.6 * height], [0, 0, 1]], dtype=torch.float64)
        depth = 1.0 + 6.0 * torch.rand(height // 8 + 1, width // 8 + 1, generator=generator)
        depth = depth.repeat_interleave(8, 0).repeat_interleave(8, 1)[:height, :width].contiguous()
        depth[depth > 5.5] = torch.inf
        viewmat = look_at(eye, target, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
        return Camera(viewmat, K, width, height), depth

    sightings = []
    for width in range(20, 44, 2):
        taken, depth = seen_from(width, 30)
        mask = torch.rand(30, width, generator=generator) > 0.2 if width % 4 else None
        sightings.append(Sighting(taken, depth, mask))
    new, depth = seen_from(101, 67)
    rows, columns = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) + 0.5 for n in (67, 101)), indexing="ij")
    rays = torch.stack([columns, rows, torch.ones_like(rows)], 2).reshape(-1, 3) @ torch.linalg.inv(new.K).T
    apart = max((one.camera.center - new.center).norm() for one in sightings)
    far = torch.where(depth.isinf(), FAR * max(apart, 1.0), depth.double()).reshape(-1, 1)
    points = (rays * far - new.viewmat[:3, 3]) @ new.viewmat[:3, :3]
    truth = torch.stack([_sees(one, points, depth.isinf().reshape(-1)) for one in sightings]).any(0).reshape(67, 101)
    found = covered(new, depth, sightings)
    assert torch.equal(found, truth) and 0.05 < found.double().mean() < 0.95


def test_surface_depth_is_infinite_where_a_pixel_is_open():
    depth = surface_depth(torch.tensor([[1.8, 0.2]]), torch.tensor([[0.9, 0.1]]))
    assert torch.equal(depth, torch.tensor([[2.0, torch.inf]]))


def test_a_mean_leaves_out_what_is_not_known():
    """Three Gaussians of a pixel by weight 0.4, 0.3 and 0.1; of the second column only some are known."""
    columns = torch.tensor([[1.0, 4.0], [2.0, torch.nan], [3.0, 8.0]])
    weights = torch.tensor([0.4, 0.3, 0.1])
    alpha = weights.sum().view(1, 1)
    found = seen_means((weights @ gap_free(columns)).view(1, 1, -1), alpha, 2)[0, 0]
    assert found.tolist() == pytest.approx([1.3 / 0.8, 2.4 / 0.5])
    columns[0, 1] = torch.nan  # now most of what the pixel shows has none
    found = seen_means((weights @ gap_free(columns)).view(1, 1, -1), alpha, 2)[0, 0]
    assert found[0].item() == pytest.approx(1.3 / 0.8) and found[1].isnan()
    assert gap_free(columns[:, :1]).shape == (3, 1)  # without gaps nothing is added
    assert seen_means(torch.zeros(1, 1, 2), torch.zeros(1, 1), 2).isnan().all()
