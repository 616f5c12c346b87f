"""Frames that observations look at: evenly spread where points are seen again, else runs of frames that follow each other; each
is decoded once, and only what is shown at points is kept of photos."""

import weakref
from dataclasses import replace

import pytest
import torch
from torch.nn import functional

from heatsplat.contracts import Camera, Frame, SceneData, View, ViewSet
from heatsplat.doctor.base import material_of
from heatsplat.doctor.examination import examine
from heatsplat.effects.catalogue import decide
from heatsplat.effects.observations import _steepest, between, frames_to_follow, observe, slopes
from heatsplat.effects.physical.point_spread import CLEAR, REACH, _widths
from heatsplat.effects.physical.thermal_opacity import _votes
from heatsplat.effects.swept_points import swept_points

WIDTH, HEIGHT, FOCAL = 48, 36, 40.0
AHEAD = 0.1 * WIDTH / FOCAL  # of a flight at height 1: nine tenths of an image are in the next one


def flight(count: int) -> SceneData:
    """A straight flight over flat, patterned ground; each point lies in the view of about ten frames."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    frames = []
    for i in range(count):
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, 3] = torch.tensor([-i * AHEAD, 0.0, 1.0])
        K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
        frames.append(Frame(f"{i:04d}", i, Camera(viewmat, K, WIDTH, HEIGHT), float(i)))

    def decode(i: int) -> View:
        along, across = (x - WIDTH / 2) / FOCAL + i * AHEAD, (y - HEIGHT / 2) / FOCAL
        image = 0.5 + 0.2 * torch.sin(9 * along + 2 * torch.sin(7 * across)) + 0.1 * torch.sin(23 * along * across)
        return View(frames[i], image[..., None].float())

    generator = torch.Generator().manual_seed(0)
    points = torch.rand(10 * count, 3, generator=generator) * torch.tensor([count * AHEAD, HEIGHT / FOCAL, 0.0])
    nothing = ViewSet([], decode)
    return SceneData(
        "flight", ViewSet(frames, decode), nothing, nothing, points - torch.tensor([0, HEIGHT / FOCAL / 2, 0])
    )


def test_a_long_flight_is_followed_in_runs_and_a_short_one_or_an_orbit_is_not():
    long, short = flight(300), flight(40)
    chosen = frames_to_follow(long.train.frames, long.points, 64)
    assert len(chosen) == 64 and chosen == sorted(set(chosen)) and chosen[0] == 0 and chosen[-1] == 299
    assert chosen[:16] == list(range(16)) and chosen[16] > 16
    assert frames_to_follow(short.train.frames, short.points, 64) == list(range(40))
    around = [long.train.frames[i % 5] for i in range(300)]  # whose points all frames see
    assert frames_to_follow(around, long.points[:200], 64)[:3] == [0, 5, 9]
    assert frames_to_follow(long.train.frames, long.points[:0], 64)[:3] == [0, 5, 9]


def test_images_of_the_size_that_most_have_are_looked_at_wherever_the_others_are():
    """The first image is twice as large, as one of another camera: all others are compared, and it is not."""
    scene = flight(20)
    first = scene.train.frames[0]
    K = torch.diag(torch.tensor([2.0, 2.0, 1.0], dtype=torch.float64)) @ first.camera.K
    large = replace(first, camera=Camera(first.camera.viewmat, K, 2 * WIDTH, 2 * HEIGHT))

    def decode(i: int) -> View:
        view = scene.train[i]
        if i:
            return view
        twice = functional.interpolate(view.thermal[None, ..., 0][None], scale_factor=2.0, mode="bilinear")
        return replace(view, frame=large, thermal=twice[0, 0, ..., None])

    mixed = replace(scene, train=ViewSet((large, *scene.train.frames[1:]), decode))
    assert frames_to_follow(mixed.train.frames, mixed.points, 64) == list(range(1, 20))
    assert frames_to_follow(mixed.train.frames, mixed.points, 5) == [1, 5, 10, 15, 19]
    seen = observe(mixed)
    assert len(seen.frames) == 19 and seen.tracks is not None
    assert material_of(mixed).chosen == list(range(1, 20))


def test_points_of_a_long_flight_are_tracked_and_all_of_its_frames_count():
    scene = flight(300)
    tracks = observe(scene).tracks
    assert tracks is not None and (tracks.weights > 0).sum(1).median() >= 6
    assert not [one for one in examine(material_of(scene)) if one.check == "views"]


def test_images_of_nothing_have_no_effects():
    scene = flight(12)
    black = ViewSet(scene.train.frames, lambda i: View(scene.train.frames[i], torch.zeros(HEIGHT, WIDTH, 1)))
    dark = SceneData("dark", black, scene.val, scene.test, scene.points)
    assert not [name for name, verdict in decide(dark).items() if verdict.on and verdict.statistic is not None]


@pytest.mark.parametrize(("look", "frames"), [(observe, 64), (material_of, 32), (_votes, 64), (swept_points, 64)])
def test_views_are_decoded_once_and_one_after_the_other(look, frames, monkeypatch):
    """What is held of photos, the largest part of a view, does not grow with the number of views."""
    monkeypatch.setattr("heatsplat.effects.swept_points.REFERENCES", 1)  # views that are swept, once all are decoded
    scene, photos, held = flight(80), [], []

    def decode(i: int) -> View:
        held.append(sum(photo() is not None for photo in photos))
        view = scene.train[i]
        view = replace(view, rgb=view.thermal.repeat(1, 1, 3), mask=torch.ones(HEIGHT, WIDTH, dtype=torch.bool))
        photos.append(weakref.ref(view.rgb))
        return view

    look(replace(scene, train=ViewSet(scene.train.frames, decode)))
    assert len(held) == frames
    assert max(held) <= 1  # the one before, until the next takes its name


def test_images_are_held_as_they_were_decoded():
    scene = flight(12)
    images = observe(scene).images
    assert images.dtype == material_of(scene).images.dtype == torch.float32
    assert torch.equal(images[3], scene.train[3].thermal[..., 0])


def test_the_steepest_slope_is_looked_for_at_the_points_alone():
    image = torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    line, column = (grid.flatten() for grid in torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij"))
    wide = functional.pad(image[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    across, down = 0.5 * (wide[1:-1, 2:] - wide[1:-1, :-2]), 0.5 * (wide[2:, 1:-1] - wide[:-2, 1:-1])
    steep = (across**2 + down**2 - 0.1**2).clamp_min(0.0).sqrt()
    steepest = functional.max_pool2d(steep[None, None], 3, stride=1, padding=1)[0, 0]
    torch.testing.assert_close(_steepest(image, line, column, 0.1).reshape(HEIGHT, WIDTH), steepest)

    everywhere = torch.rand(500, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 2.2 - 1.1
    expected = between(torch.stack([across, down], 2), everywhere)
    torch.testing.assert_close(slopes(image, everywhere), expected)


def test_edges_are_those_of_all_windows():
    image = torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 0.01
    image[:, 20:] += 0.5
    image[10:, 33:] += 0.3
    image[20, 22] = torch.nan
    noise, expected = 0.01, []
    for row in image:
        for window in row.diff().unfold(0, 2 * REACH + 1, 1):
            step, sizes = window.sum(), window.abs()
            if step.abs() > max(CLEAR * noise, 0.9 * sizes.sum() - 2 * noise) and sizes[REACH] == sizes.max():
                share, at = window / step, torch.arange(-REACH, REACH + 1)
                expected.append((share * (at - (share * at).sum()) ** 2).sum().clamp_min(0.0).sqrt())
    assert len(expected) == 2 * HEIGHT - 10 - 1
    torch.testing.assert_close(_widths(image, noise), torch.stack(expected))
