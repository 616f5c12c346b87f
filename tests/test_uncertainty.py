"""Intervals of what a trained scene shows: against closed forms, and against the truth of a synthetic scene."""

from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from running import BARE, run
from weathered import CAMERA

from heatsplat import uncertainty
from heatsplat.composition import build
from heatsplat.contracts import Camera, Frame, SceneError, View, ViewSet
from heatsplat.renderers.base import rasterization
from heatsplat.uncertainty import (
    WITHIN,
    Uncertainty,
    _across_gap,
    _calibrated,
    _pixels,
    _shares,
    _stride,
    evidence,
    redundancy,
    shown,
)

FRAME = Frame("a", 0, CAMERA, 0.0)


def opaque(count: int) -> SimpleNamespace:
    """A module of ``count`` round Gaussians in one place before the camera; they show 0.25."""
    at = torch.linalg.inv(CAMERA.viewmat) @ torch.tensor([0.0, 0.0, 2.0, 1.0], dtype=torch.float64)
    shape = (
        at[:3].float().expand(count, 3),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(count, 4),
        torch.full((count, 3), 0.2),
        torch.full((count,), 0.6),
    )

    def composited(frame, values):
        camera = frame.camera
        return rasterization(*shape, values, camera.viewmat, camera.K, camera.width, camera.height)

    image = torch.full((CAMERA.height, CAMERA.width, 1), 0.25)
    return SimpleNamespace(
        splats=range(count), device="cpu", modality="thermal", composited=composited, predict=lambda frame: image
    )


@pytest.mark.parametrize("count", [1, 2])
def test_evidence_is_that_of_least_squares(count):
    module, views = opaque(count), 5
    seen = View(FRAME, thermal=torch.full((CAMERA.height, CAMERA.width, 1), 0.75))
    found = evidence(module, [seen] * views)
    weights = module.composited(FRAME, torch.eye(count)).features.reshape(-1, count).double()
    normal = views * weights.T @ weights
    assert torch.allclose(found.weight, normal.sum(1), rtol=1e-5)
    assert torch.allclose(found.misfit, torch.full((count,), 0.25, dtype=torch.float64))
    assert torch.equal(shown(module, [seen] * views), found.weight)
    # What the camera sees of a temperature that all share has the variance of least squares, α² / Σ α², with noise of 1.
    alpha = weights.sum(1)
    exact = alpha / (views * alpha.square().sum()).sqrt()
    told = weights @ found.weight.rsqrt()
    high = 1.02 * count**0.5 if count > 1 else 1 + 1e-5  # shares of the two differ between pixels
    assert (told >= exact * (1 - 1e-5)).all() and (told <= high * exact).all()
    masked = evidence(module, [replace(seen, mask=torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool))])
    assert (masked.weight == 0).all()


def test_what_hides_behind_others_is_not_shown_however_large():
    camera = Camera(torch.eye(4), torch.tensor([[20.0, 0.0, 4.0], [0.0, 20.0, 4.0], [0.0, 0.0, 1.0]]), 8, 8)
    means = torch.tensor([[0.0, 0.0, depth] for depth in (20.0, 25.0, 500.0)])
    quats, opacities = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(3, 1), torch.full((3,), 0.99)
    scales = torch.tensor([[15.0, 15.0, 0.1], [15.0, 15.0, 0.1], [2000.0, 2000.0, 0.1]])

    def composited(frame, values):
        return rasterization(
            means, quats, scales, opacities, values, camera.viewmat, camera.K, camera.width, camera.height
        )

    module = SimpleNamespace(splats=range(3), device="cpu", composited=composited)
    first, *others = shown(module, [View(replace(FRAME, camera=camera), thermal=torch.zeros(8, 8, 1))])
    assert 0.9 * 64 < first <= 64 and max(others) < 0.05 * first


def test_what_stands_under_a_mask_says_nothing_of_the_scene():
    image = torch.rand(CAMERA.height, CAMERA.width, 1, generator=torch.Generator().manual_seed(0))
    mask = torch.arange(CAMERA.width).expand(CAMERA.height, -1) >= 4
    filled = image.where(mask[..., None], 9.0)
    assert torch.equal(_pixels(View(FRAME, filled, mask=mask), "thermal"), image[mask].flatten())
    assert len(_pixels(View(FRAME, filled), "thermal")) == image.numel()


@pytest.mark.parametrize(
    ("time_s", "others_s", "share"),
    [
        (1.0, [], 1.0),  # images follow each other
        (60.0, [], 1.0),
        (100.0, [160.0, 40.0], 0.5),
        (70.0, [100.0, 40.0], 0.75),
        (230.0, [200.0, 200.0], 1.0),
    ],
)
def test_a_gap_of_the_record_is_compared_with_what_was_recorded(time_s, others_s, share):
    night = [*range(0, 41, 4), *range(160, 201, 5)]  # 20 images in 200 s
    frames = [replace(FRAME, time_s=float(taken_s)) for taken_s in night]
    scene = SimpleNamespace(train=ViewSet(frames, list), record=(0.0, 200.0))
    assert _across_gap(scene, time_s) == (others_s, share)


def test_what_no_held_out_pixel_has_counts_as_it_is():
    rows, _ = recorded(noise=0.05)
    shares, told = _calibrated([torch.cat([rows, torch.zeros(len(rows), 1).double()], dim=1)], 0.05)
    assert torch.equal(shares[:-1], _calibrated([rows], 0.05)[0]) and shares[-1] == 1 and told


def test_it_needs_training_views():
    nothing = SimpleNamespace(scene=SimpleNamespace(train=ViewSet([], list), name="empty"))
    with pytest.raises(SceneError, match="'empty' has no training views"):
        Uncertainty(nothing)


def test_images_of_another_weather_tell_nothing():
    scene = SimpleNamespace(train=[None], notes={"weather_replaced_by": "gale.csv"})
    with pytest.raises(
        SceneError, match="weather=gale.csv: .* recorded in another weather. Leave out weather, or uncertainty"
    ):
        Uncertainty(SimpleNamespace(scene=scene))


def test_intervals_hold_the_truth_and_grow_where_no_camera_looked(tmp_path, monkeypatch, caplog):
    settings = ("method=3dgs", "data.scene=static", "max_steps=150", *BARE)
    module, trainer = run(tmp_path, *settings)
    told = Uncertainty(module)
    clean = build({**module.config["data"], "noise_k": 0.0}).scene
    inside = []
    for frame, truth in zip(module.scene.test.frames, clean.test, strict=True):
        told.calibrate(without=[frame.name])
        error = module.scene.thermal_range.to_celsius(module.predict(frame)) - clean.thermal_range.to_celsius(
            truth.thermal
        )
        inside.append(error[..., 0].abs() <= told.deviation(frame))
    assert 0.6 < torch.cat(inside).float().mean() < 0.75
    told.calibrate()
    assert 0.6 < told.coverage() < 0.75
    seen = told.deviation(module.scene.train.frames[0]).median()
    behind = (
        torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
        @ module.scene.train.frames[0].camera.viewmat
    )
    turned = replace(module.scene.train.frames[0], camera=replace(module.scene.train.frames[0].camera, viewmat=behind))
    assert told.deviation(turned).median() > max(5 * seen, 0.9 * told.prior * told.unit)
    assert "is hidden" not in caplog.text
    monkeypatch.setattr(uncertainty, "noise_of_views", lambda views, modality: 5.0 * told.prior)
    hidden = Uncertainty(module)
    assert "is hidden in the camera's noise" in caplog.text
    assert told.usual < hidden.usual < hidden.noise * hidden.unit


def test_held_out_images_of_which_no_pixel_counts_are_passed_over(tmp_path, caplog):
    module, _ = run(tmp_path, "method=3dgs", "data.scene=static", "max_steps=20", *BARE)
    scene, views = module.scene, list(module.scene.val)

    def masked(*which):
        nothing = torch.zeros(views[0].thermal.shape[:2], dtype=torch.bool)
        seen = [replace(view, mask=nothing) if i in which else view for i, view in enumerate(views)]
        return replace(scene, val=ViewSet([view.frame for view in seen], lambda i: seen[i]))

    module.scene = replace(scene, val=scene.val.subset([2]))
    alone = Uncertainty(module).coverage()
    module.scene = masked(0, 1)
    assert len(views) == 3 and Uncertainty(module).coverage() == alone
    assert "too narrow" not in caplog.text
    module.scene = masked(0, 1, 2)
    assert 0.5 < Uncertainty(module).coverage() < 0.9 and "holds no images out of which pixels count" in caplog.text


def test_of_many_held_out_images_only_the_pixels_that_calibrate_are_kept(tmp_path, monkeypatch):
    module, _ = run(tmp_path, "method=3dgs", "data.scene=static", "max_steps=20", *BARE)
    frames = module.scene.val.frames
    camera = frames[0].camera
    rows = sum(frame.camera.height for frame in frames)
    monkeypatch.setattr(uncertainty, "PIXELS", rows)  # one of each row
    found = Uncertainty(module)._parts(module.scene.val, uncertainty.STRETCHES)
    assert all(part.untyped_storage().nbytes() == part.numel() * part.itemsize for part in found)
    assert 0.9 * rows < sum(map(len, found)) <= rows
    # Those of one column alone would calibrate what all columns have.
    assert _stride(camera.width, camera.width) == camera.width + 1


@pytest.mark.parametrize(
    ("every", "width", "expected"),
    [(0, 160, 1), (4, 160, 4), (65, 640, 65), (160, 160, 161), (80, 160, 81), (7, 5, 7), (5, 5, 6)],
)
def test_pixels_are_taken_of_many_columns(every, width, expected):
    found = _stride(every, width)
    assert found == expected and len({place % width for place in range(0, found * width, found)}) >= min(16, width)


def recorded(noise, error=0.10, count=40_000):
    """Rows of pixels that are off by ``error`` beside a ``noise``, with variances that vary from place to place; the errors."""
    generator = torch.Generator().manual_seed(0)
    wide = 2 * error**2 * torch.rand(count, 1, generator=generator, dtype=torch.float64) + 1e-4
    errors = error * torch.randn(count, generator=generator, dtype=torch.float64)
    squares = (errors + noise * torch.randn(count, generator=generator, dtype=torch.float64)).square()
    return torch.cat([squares[:, None], wide, torch.full_like(wide, noise**2), 3 * wide], dim=1), errors


@pytest.mark.parametrize("too_much", [0.02, 0.05, 0.1])
def test_errors_that_the_noise_hides_are_not_taken_for_none(too_much):
    """What is left of the squared residuals is nothing, or less, where the noise is held for more than it is."""
    rows, errors = recorded(noise=0.5)
    shares, told = _calibrated(rows.chunk(8), 0.5 * (1 + too_much))
    deviations = (rows[:, 1:] @ shares).sqrt()
    assert not told
    assert 0.6 < (errors.abs() <= deviations).double().mean() < 0.95 and deviations.median() < 0.25


def test_errors_that_stand_out_of_the_noise_are_found_as_they_are():
    rows, errors = recorded(noise=0.05)
    shares, told = _calibrated(rows.chunk(8), 0.05)
    plain, _ = _shares(rows, 0.05)
    assert told
    torch.testing.assert_close(shares, plain * ((rows[:, 0] - 0.05**2) / (rows[:, 1:] @ plain)).quantile(WITHIN))
    assert (errors.abs() <= (rows[:, 1:] @ shares).sqrt()).double().mean() == pytest.approx(WITHIN, abs=0.02)


def test_pixels_that_err_together_tell_no_more_than_one_of_them(monkeypatch):
    monkeypatch.setattr(uncertainty, "NOISE_ERROR", 0.0)
    rows, _ = recorded(noise=0.5, error=0.01, count=2000)
    least = [
        (each[:, 1:] @ _calibrated([each], 0.5)[0]).median().item()
        for each in (rows, rows.repeat_interleave(20, 0), recorded(noise=0.5, error=0.01)[0])
    ]
    assert least[1] == pytest.approx(least[0], rel=0.3) and least[2] < 0.5 * least[0]


@contextmanager
def off(module, by):
    """While it lasts, what the camera gets beside the levels is so much more than is taken for granted."""
    module.thermal.beside = by
    try:
        yield
    finally:
        module.thermal.beside = 0.0


def levels(values, views=5, doubt=None):
    """``Uncertainty`` about one level for each of some Gaussians, seen by least squares with noise of 0.1; told is its double."""

    class Levels(dict):
        names = ("level",)

        def __init__(self, tensors):
            super().__init__({name: tensor.clone().requires_grad_() for name, tensor in tensors.items()})

        def __len__(self) -> int:
            return len(self["level"])

    module = opaque(len(values))
    module.splats, module.constants = Levels({"level": torch.tensor(values)}), frozenset()
    module.thermal = SimpleNamespace(
        beside=0.0,
        inseparable="",
        features=lambda splats, query: splats["level"][:, None] + module.thermal.beside,
        attributes=lambda splats, query: {"double": 2 * splats["level"], "of all": torch.ones(len(splats))},
        doubts=lambda: {} if doubt is None else {"beside": partial(off, module, doubt)},
    )
    module.attributes = lambda frame: module.thermal.attributes(module.splats, None)
    # Residuals of turning signs tell as much as independent ones.
    images = [torch.full((CAMERA.height, CAMERA.width, 1), 0.25 + 0.01 * (-1) ** view) for view in range(views)]
    seen = [View(FRAME, thermal=image) for image in images]
    module.scene = SimpleNamespace(train=ViewSet([view.frame for view in seen], seen.__getitem__))
    told = object.__new__(Uncertainty)
    told.module, told.stretch, told.noise, told.evidence = module, 1.0, 0.1, evidence(module, seen)
    return told


def of_least_squares(told):
    """Standard deviations of the doubles of ``levels`` 0.2 and 0.4, whose variance over the scene is 0.02."""
    each = told.evidence.weight / len(told.module.scene.train)
    tells = each / (0.1**2 + each * told.evidence.misfit)
    return 2 / (tells * len(told.module.scene.train) + 1 / (4 * 0.02)).sqrt()


def test_what_no_gaussian_tells_is_not_said_to_be_certain():
    told = levels([0.2, 0.4])
    assert "of all" in told.module.attributes(FRAME)
    assert list(told.of_attributes(FRAME)) == list(told.attribute_deviations(FRAME)) == ["double"]


def test_what_is_learned_is_as_certain_as_what_it_does_to_images():
    told = levels([0.2, 0.4])
    torch.testing.assert_close(told.of_attributes(FRAME)["double"], of_least_squares(told).float())


def test_what_is_taken_for_granted_is_as_uncertain_as_the_model_says():
    """Levels that views see with something beside them that may be 0.5 larger are 0.5 lower then, as far as views tell them."""
    sure, doubted = levels([0.2, 0.4]), levels([0.2, 0.4], doubt=0.5)
    alone = of_least_squares(sure)
    share = 1 - alone.square() / (4 * 4 * 0.02)  # of the prior, that views leave
    expected = (alone.square() + (2 * 0.5 * share).square()).sqrt()
    torch.testing.assert_close(doubted.of_attributes(FRAME)["double"], expected.float())


@pytest.mark.parametrize("inseparable", ["", "they are not"])
def test_gaussians_are_as_certain_a_few_at_a_time(monkeypatch, inseparable):
    told = levels([0.2, 0.4, 0.1, 0.35, 0.3], doubt=0.5)
    whole = told.of_attributes(FRAME)["double"]
    monkeypatch.setattr(uncertainty, "BLOCK", 2)
    told.module.thermal.inseparable = inseparable
    asked, features = [], told.module.thermal.features
    told.module.thermal.features = lambda splats, query: asked.append(len(splats)) or features(splats, query)
    torch.testing.assert_close(told.of_attributes(FRAME)["double"], whole, rtol=1e-6, atol=0)
    assert set(asked) == ({5} if inseparable else {2, 1})


def test_gaussians_of_a_pixel_that_disagree_make_it_less_certain():
    frame = replace(FRAME, frame_id=1)
    told, apart = (levels([0.2 + by, 0.4 - by]) for by in (0.1, -0.2))
    agree, disagree = (one.attribute_deviations(frame)["double"] for one in (told, apart))
    own = told.of_attributes(frame)["double"]
    seen = agree.isfinite()
    torch.testing.assert_close(agree[seen], own.mean().expand(int(seen.sum())), rtol=0.05, atol=1e-6)  # both are 0.3
    weights = apart.module.composited(FRAME, torch.eye(2)).features[seen].double()
    weights = weights / weights.sum(1, keepdim=True)
    doubles = torch.tensor([0.0, 1.2], dtype=torch.float64)
    spread = (weights.square() * (doubles - (weights @ doubles)[:, None]).square()).sum(1)
    exact = (spread + apart.of_attributes(frame)["double"].double().mean() ** 2).sqrt()
    assert (disagree[seen].double() / exact - 1).abs().max() < 0.35  # 32 draws


@pytest.mark.parametrize("known", [0, 1])
def test_gaussians_without_a_value_make_others_neither_more_nor_less_certain(known):
    """Of two, the first of which has most of the pixels that show both."""
    frame, told = replace(FRAME, frame_id=1), levels([0.2, 0.4])
    expected, seen = told.of_attributes(frame)["double"][known], told.attribute_deviations(frame)["double"].isfinite()
    one = torch.arange(2) == known
    told.module.thermal.attributes = lambda splats, query: {"double": torch.where(one, 2 * splats["level"], torch.nan)}
    each, pixels = (found["double"] for found in (told.of_attributes(frame), told.attribute_deviations(frame)))
    assert each[known] == expected and each[1 - known].isnan()
    if known == 1:
        assert pixels.isnan().all()
    else:
        torch.testing.assert_close(pixels[seen], expected.expand(int(seen.sum())))


@pytest.mark.parametrize("kept, expected", [(0.0, 1.0), (0.5, 3.0), (0.8, 9.0)])
def test_views_whose_errors_are_alike_count_as_fewer(kept, expected):
    """Of a chain in which each keeps a share of the one before the autocorrelation time is (1 + share) / (1 - share)."""
    draws = torch.randn(200, 400, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    chain = [draws[0]]
    for draw in draws[1:]:
        chain.append(kept * chain[-1] + (1 - kept**2) ** 0.5 * draw)
    assert redundancy(torch.stack(chain), torch.ones_like(draws)) == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize("seen", [1.0, 0.4, "once", "never"])
@pytest.mark.parametrize("block", [1, uncertainty.BLOCK])
def test_views_are_alike_as_products_of_one_lag_after_another_tell(monkeypatch, seen, block):
    monkeypatch.setattr(uncertainty, "BLOCK", block)
    views, count = 41, 60
    draws = torch.randn(2, views, count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    residuals = 0.3 * draws[0] + draws[0, :1]
    if seen == "once":
        weights = (torch.arange(views)[:, None] == torch.arange(count) % views).double()
    else:
        weights = 5 * draws[1].abs() * (draws[1].abs() < (0.0 if seen == "never" else seen)).double()
    expected, alone, scaled = 1.0, 0.0, residuals * weights.sqrt()
    for lag in range(views // 2):
        both = (weights[lag:] * weights[: views - lag]).sqrt().sum().clamp(min=1e-12)
        alike = float((scaled[lag:] * scaled[: views - lag]).sum() / both)
        if lag == 0:
            alone = max(alike, 1e-12)
        elif alike <= 0:
            break
        else:
            expected += 2 * alike / alone
    assert (expected > 3) == (seen in (1.0, 0.4))
    assert redundancy(residuals, weights) == pytest.approx(expected, rel=1e-12)


def test_a_pixel_that_is_met_exactly_leaves_the_others_their_intervals():
    """Where image and rendering are both at an end of the scene's range, a residual is 0: no gradient may be NaN there."""
    generator = torch.Generator().manual_seed(0)
    variances = torch.rand(4000, 3, generator=generator, dtype=torch.float64) + 0.1
    squares = (variances.sum(1, keepdim=True).sqrt() * torch.randn(4000, 1, generator=generator)).square()
    expected, _ = _shares(torch.cat([squares, variances], dim=1), 0.01)
    squares[0] = 0.0
    found, loss = _shares(torch.cat([squares, variances], dim=1), 0.01)
    assert found.isfinite().all() and abs(loss) < 10.0
    assert found == pytest.approx(expected, rel=0.02)
