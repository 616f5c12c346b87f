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


def test_smooth_slopes_on_which_pixels_are_their_own_median_are_no_dead_pixels():
    generator = torch.Generator().manual_seed(0)
    waves = torch.fft.fft2(torch.randn(512, 512, generator=generator))
    rate = torch.fft.fftfreq(512)
    waves *= torch.exp(-700.0 * (rate[:, None] ** 2 + rate[None] ** 2))
    scene = torch.fft.ifft2(waves).real
    shown = [torch.roll(4.0 * scene / scene.std(), (61 * f, 83 * f), (0, 1)) for f in range(8)]
    images = torch.stack(shown) + 0.05 * torch.randn(8, 512, 512, generator=generator)
    images[:, 40, 50] += 5.0
    assert dead_pixels((100 * images).round() / 100).nonzero().tolist() == [[40, 50]]  # as a camera stores them


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
