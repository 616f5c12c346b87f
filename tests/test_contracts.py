"""Nouns that all packages share: positions evenly spread, and points seen by a camera."""

import numpy as np
import pytest
import torch
from few_sorted import with_few_sorted

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, ThermalRange, ViewSet, evenly_spread, quantile


@pytest.mark.parametrize(
    ("count", "limit", "found"),
    [(10, 4, [0, 3, 6, 9]), (10, 3, [0, 4, 9]), (2, 5, [0, 1]), (5, 1, [0]), (5, 0, []), (0, 3, [])],
)
def test_positions_are_spread_from_the_first_to_the_last(count, limit, found):
    assert evenly_spread(count, limit) == found


def test_positions_are_as_many_as_asked_for_and_all_different():
    for count, limit in ((1000, 64), (65, 64), (100_000, 1500), (20_001, 20_000)):
        found = evenly_spread(count, limit)
        gaps = {later - earlier for earlier, later in zip(found, found[1:], strict=False)}
        assert len(found) == limit and found[0] == 0 and found[-1] == count - 1
        assert min(gaps) > 0 and max(gaps) - min(gaps) <= 1


def test_a_camera_projects_points_of_the_world():
    K = torch.tensor([[100.0, 0.0, 30.0], [0.0, 50.0, 20.0], [0.0, 0.0, 1.0]])
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([0.0, 1.0, 2.0])
    pixels, depths = Camera(viewmat, K, 60, 40).project(torch.tensor([[1.0, 1.0, 2.0], [0.0, 0.0, -3.0]]))
    assert pixels[0].tolist() == [100 / 4 + 30, 50 * 2 / 4 + 20]
    assert depths.tolist() == [4.0, -1.0] and pixels.dtype == depths.dtype == torch.float64


def test_a_camera_takes_arrays_and_keeps_its_gradients():
    viewmat = torch.eye(4, dtype=torch.float64).requires_grad_()
    camera = Camera(viewmat, np.diag([9, 8, 1]), np.int64(8), 6)
    assert camera.viewmat is viewmat and camera.K.dtype == torch.float64 and camera.resized(4, 3).width == 4


def test_a_camera_keeps_all_digits_of_lists():
    rows = [[0.1, 0.0, 1 / 3], [0.0, 0.1, 0.7], [0.0, 0.0, 1.0]]
    assert Camera(torch.eye(4), rows, 8, 6).K.tolist() == rows


def changed(matrix, row, column, value):
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("what", "value", "told"),
    [
        ("viewmat", torch.eye(3), r"camera needs viewmat \[4, 4\] and K \[3, 3\], got viewmat \[3, 3\]"),
        ("viewmat", changed(torch.eye(4), 0, 3, float("nan")), "viewmat of a camera has NaN or infinite values"),
        ("K", changed(torch.eye(3), 0, 0, float("inf")), "K of a camera has NaN or infinite values"),
        ("K", changed(torch.eye(3), 0, 1, 0.5), "without skew"),
        ("K", 2 * torch.eye(3), "K of a camera must be"),
        ("width", 8.0, "whole numbers of pixels, got 8.0 x 6"),
        ("height", 0, "camera has no pixels: 8 x 0"),
    ],
)
def test_what_is_no_pinhole_camera_is_refused(what, value, told):
    given = {"viewmat": torch.eye(4), "K": torch.eye(3), "width": 8, "height": 6}
    with pytest.raises(SceneError, match=told):
        Camera(**given | {what: value})


def scene(times_s, test_times_s=()) -> SceneData:
    """Training frames, and test frames of which validation has the first as well."""
    at = Camera(torch.eye(4), torch.eye(3), 8, 6)
    frames = [Frame(f"{i}.png", i, at, time_s) for i, time_s in enumerate((*times_s, *test_times_s))]
    parts = frames[: len(times_s)], frames[len(times_s) :][:1], frames[len(times_s) :]
    return SceneData(
        "a", *(ViewSet(part, list) for part in parts), torch.zeros(1, 3), thermal_range=ThermalRange(10, 50)
    )


def test_the_frames_of_a_scene_are_those_of_all_splits_once():
    assert [frame.frame_id for frame in scene([0.0, 8.0], [3.0, 9.0]).frames] == [0, 1, 2, 3]


@pytest.mark.parametrize(("times_s", "middle_s"), [([2.0, 12.0, 4.0], 4.0), ([None, 3.0], 3.0), ([None], None)])
def test_the_middle_of_a_record_is_a_moment_that_was_recorded(times_s, middle_s):
    assert scene(times_s, [100.0]).middle_s == middle_s


def test_a_long_record_is_looked_through_once_however_many_moments_are_asked(monkeypatch):
    known, asked = scene([2.0, 12.0, 4.0]), []
    times_s = ViewSet.times_s.fget
    monkeypatch.setattr(ViewSet, "times_s", property(lambda views: asked.append(1) or times_s(views)))
    assert [known.beyond_record(time_s) for time_s in (None, 0.5, 3.0, 15.0)] == [0.0, 1.5, 0.0, 3.0]
    before = len(asked)
    assert known.record == (2.0, 10.0) and known.beyond_record(20.0) == 8.0 and len(asked) == before
    assert scene([None, 3.0]).beyond_record(9.0) == 0.0


def test_thermal_images_alone_have_a_range():
    known = scene([0.0])
    assert known.range_of("thermal") is known.range_of("clean") is known.thermal_range
    assert known.range_of("rgb") is None


SHARES = (0.3, 0.0, 1.0, torch.tensor([0.01, 0.5, 0.99]))


@pytest.mark.parametrize("shares", SHARES, ids=str)
@pytest.mark.parametrize("shape", [(17,), (400,), (401, 3)])
def test_quantiles_of_many_values_are_those_that_torch_would_find(monkeypatch, shares, shape):
    values = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    known, unknown = torch.quantile(values, shares, dim=0), values.clone()
    unknown[3] = torch.nan
    assert torch.equal(quantile(values, shares), known)
    with_few_sorted(monkeypatch, 16)
    assert torch.allclose(quantile(values, shares), known, rtol=1e-6, atol=0)
    assert quantile(values, shares).dtype == values.dtype and quantile(unknown, shares).isnan().all()
    if not isinstance(shares, float):
        shares = shares.double()
    assert torch.allclose(quantile(values.double(), shares).float(), known, rtol=1e-5)


def test_a_scene_of_very_many_points_has_a_box(monkeypatch):
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0))
    many = SceneData("scan", *[ViewSet([], list)] * 3, points)
    known = many.box
    with_few_sorted(monkeypatch, 100)
    assert all(torch.allclose(one, other) for one, other in zip(many.box, known, strict=True))


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_the_length_unit_of_a_scene_is_one_of_its_own_wherever_its_cameras_stand(unit):
    def extent(centres) -> float:
        matrices = torch.eye(4, dtype=torch.float64).repeat(len(centres), 1, 1)
        matrices[:, :3, 3] = -unit * torch.tensor(centres, dtype=torch.float64)
        frames = [Frame(f"{i}.png", i, Camera(one, torch.eye(3), 8, 6)) for i, one in enumerate(matrices)]
        views = ViewSet(frames, list)
        return SceneData("a", views, views, views, unit * torch.tensor([[0.0, 0.0, 4.0]]).repeat(9, 1)).extent / unit

    assert extent([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]) == pytest.approx(1.1)
    assert extent([[0.0, 0.0, 0.0]] * 3) == pytest.approx(4.0)
    assert extent([[0.1, 0.1, 0.0], [0.1, 0.1 + 1e-15, 0.0]]) == pytest.approx(
        4.0, rel=1e-2
    )  # a turning camera, rounded
    assert extent([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]) == pytest.approx(0.055)
