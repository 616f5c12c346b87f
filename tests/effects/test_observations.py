"""Frames that observations look at: evenly spread where points are seen again, else runs of frames that follow each other."""

import torch

from heatsplat.contracts import Camera, Frame, SceneData, View, ViewSet
from heatsplat.doctor.base import material_of
from heatsplat.doctor.examination import examine
from heatsplat.effects.catalogue import decide
from heatsplat.effects.observations import frames_to_follow, observe

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
