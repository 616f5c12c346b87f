"""Intervals of what a trained scene shows: against closed forms, and against the truth of a synthetic scene."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from running import TINY, run
from weathered import CAMERA

from heatsplat.composition import build
from heatsplat.contracts import Frame, SceneError, View, ViewSet
from heatsplat.renderers.base import rasterization
from heatsplat.uncertainty import Uncertainty, evidence

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
    # What the camera sees of a temperature that all share has the variance of least squares, α² / Σ α², with noise of 1.
    alpha = weights.sum(1)
    exact = alpha / (views * alpha.square().sum()).sqrt()
    told = weights @ found.weight.rsqrt()
    high = 1.02 * count**0.5 if count > 1 else 1 + 1e-5  # shares of the two differ between pixels
    assert (told >= exact * (1 - 1e-5)).all() and (told <= high * exact).all()
    masked = evidence(module, [replace(seen, mask=torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool))])
    assert (masked.weight == 0).all()


def test_it_needs_training_views():
    nothing = SimpleNamespace(scene=SimpleNamespace(train=ViewSet([], list), name="empty"))
    with pytest.raises(SceneError, match="'empty' has no training views"):
        Uncertainty(nothing)


def test_intervals_hold_the_truth_and_grow_where_no_camera_looked(tmp_path):
    settings = ("method=3dgs", "data.scene=static", "max_steps=300", "test=false", *TINY)
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
    assert told.of_gaussians().max() < told.prior * told.unit
    seen = told.deviation(module.scene.train.frames[0]).median()
    behind = (
        torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
        @ module.scene.train.frames[0].camera.viewmat
    )
    turned = replace(module.scene.train.frames[0], camera=replace(module.scene.train.frames[0].camera, viewmat=behind))
    assert told.deviation(turned).median() > max(5 * seen, 0.9 * told.prior * told.unit)


def test_what_is_learned_is_as_certain_as_what_it_does_to_images():
    """Of one level for each of two Gaussians, seen by least squares with noise; what is told is twice the level."""

    class Levels(dict):
        names = ("level",)

        def __len__(self) -> int:
            return 2

    module, views = opaque(2), 5
    module.splats, module.constants = Levels(level=torch.tensor([0.2, 0.4], requires_grad=True)), frozenset()
    module.thermal = SimpleNamespace(
        features=lambda splats, query: splats["level"][:, None],
        attributes=lambda splats, query: {"double": 2 * splats["level"]},
    )
    module.attributes = lambda frame: module.thermal.attributes(module.splats, None)
    seen = View(FRAME, thermal=torch.full((CAMERA.height, CAMERA.width, 1), 0.25))
    module.scene = SimpleNamespace(train=[seen] * views)
    told = object.__new__(Uncertainty)
    told.module, told.stretch, told.noise, told.evidence = module, 1.0, 0.1, evidence(module, [seen] * views)
    exact = 2 / (told.evidence.weight / 0.1**2 + 1 / (4 * 0.02)).sqrt()  # their variance over the scene is 0.02
    torch.testing.assert_close(told.of_attributes(FRAME)["double"], exact.float())
