"""Dead pixels among noise and edges."""

import torch

from heatsplat.physics.defects import dead_pixels


def recording(frames: int = 8) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    ramp = torch.arange(32.0)[None, :] / 32
    return torch.stack(
        [torch.roll((ramp > 0.5).float().expand(24, 32), 2 * f, 1) for f in range(frames)]
    ) + 0.01 * torch.randn(frames, 24, 32, generator=generator)


def test_dead_pixels_are_found_beside_each_other_too_and_edges_that_move_are_none():
    images = recording()
    assert not dead_pixels(images).any()
    images[:, 5, 6] = images[:, 5, 7] = 3.0
    images[:, 20, 11] = -2.0
    found = dead_pixels(images)
    assert found[5, 6] and found[5, 7] and found[20, 11] and int(found.sum()) == 3


def test_few_frames_say_nothing():
    assert not dead_pixels(recording(3)).any()


def test_an_image_that_stands_still_has_no_dead_pixels():
    generator = torch.Generator().manual_seed(1)
    scene = 0.04 * torch.randn(24, 32, generator=generator)
    scene[4:20:5, 3:30:6] = 1.0  # specks that differ from what is around them
    still = scene + 0.02 * torch.randn(8, 24, 32, generator=generator)
    assert not dead_pixels(still).any()
    moving = torch.stack([torch.roll(image, 3 * f, 1) for f, image in enumerate(still)])
    moving[:, 10, 10] = 5.0
    assert dead_pixels(moving).nonzero().tolist() == [[10, 10]]
