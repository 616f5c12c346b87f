"""Scenes built to break a training, 24 x 20 pixels, and the run of any method on one of them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from torch import Tensor

from heatsplat.composition import build, compose
from heatsplat.contracts import Camera, Frame, SceneData, ThermalRange, View, ViewSet, Weather
from heatsplat.datamodules.base import SceneDataModule
from heatsplat.geometry.projection import look_at
from heatsplat.runs.run import build_callbacks
from heatsplat.training.checkpoints import load_checkpoint
from heatsplat.training.machine import prepare_machine
from heatsplat.training.rng import generator_for
from heatsplat.training.session import fit

WIDTH, HEIGHT, FRAMES, POINTS, STEPS = 24, 20, 6, 80, 300
SPAN_S = 1000.0


class Given(SceneDataModule):
    """A data module of a scene that is there already."""

    def __init__(self, scene: SceneData) -> None:
        super().__init__()
        self._scene = scene

    def load(self) -> SceneData:
        return self._scene


def camera(turn: float, away: bool = False) -> Camera:
    """A camera two units from the middle of the scene, which it looks at or turns its back to."""
    eye = torch.tensor([2.0 * math.sin(turn), -0.4, -2.0 * math.cos(turn)], dtype=torch.float64)
    target = 2.0 * eye if away else torch.zeros(3, dtype=torch.float64)
    viewmat = look_at(eye, target, torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    K = torch.tensor([[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(viewmat, K, WIDTH, HEIGHT)


def sound(frames: int = FRAMES) -> SceneData:
    """A scene without a flaw and with all metadata: a warm patch that cools, before a cool wall."""
    times = [SPAN_S * i / max(frames - 1, 1) for i in range(frames)]
    weather = Weather(
        times_s=torch.tensor([-SPAN_S, 3 * SPAN_S], dtype=torch.float64),
        **{
            name: torch.full((2,), value, dtype=torch.float64)
            for name, value in (
                ("air_c", 15.0), ("wind_m_s", 1.0), ("humidity_percent", 50.0), ("irradiance_w_m2", 300.0),
                ("pressure_hpa", 1000.0), ("direct_w_m2", 300.0), ("diffuse_w_m2", 80.0),
            )
        },
        sun=torch.tensor([[0.0, 0.6, 0.8]] * 2, dtype=torch.float64),
    )  # fmt: skip
    names = [
        Frame(f"frame_{i}.png", i, camera(0.15 * (i - frames / 2)), time, weather.at(time))
        for i, time in enumerate(times)
    ]
    views = [View(frame, picture(frame.time_s), picture(0.0).expand(-1, -1, 3).clone()) for frame in names]
    points = torch.rand(POINTS, 3, generator=generator_for(0, 0, "points")) * 1.6 - 0.8
    return SceneData(
        name="extreme", train=view_set(views), val=view_set(views[:1]), test=view_set(views[-1:]), points=points,
        point_colors=torch.full((POINTS, 3), 0.5), thermal_range=ThermalRange(10.0, 30.0), ambient_c=15.0,
        metres_per_unit=1.0, weather=weather, labels=torch.arange(POINTS) % 3, point_features=torch.rand(
            POINTS, 4, generator=generator_for(0, 0, "features")
        ),
    )  # fmt: skip


def picture(time_s: float) -> Tensor:
    """A warm patch that cools, [H, W, 1]."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, HEIGHT), torch.linspace(-1, 1, WIDTH), indexing="ij")
    return (0.2 + 0.6 * math.exp(-time_s / SPAN_S) * torch.exp(-4 * (x**2 + y**2)))[..., None]


def view_set(views: list[View]) -> ViewSet:
    return ViewSet([view.frame for view in views], views.__getitem__)


def with_views(scene: SceneData, change) -> SceneData:
    """The scene whose training views went through ``change(position, view)``."""
    return replace(scene, train=view_set([change(i, view) for i, view in enumerate(scene.train)]))


def plain_config(output_dir: Path, method: str, **overrides: Any) -> dict[str, Any]:
    """The resolved configuration of a run of ``method`` over STEPS steps, as nested dicts."""
    arguments = [f"{name}={value}" for name, value in overrides.items()]
    return compose([f"method={method}", f"max_steps={STEPS}", "threads=1", *arguments])


def everywhere(tree: Any, change) -> Any:
    """The nested dict with every number replaced by ``change(key, number)``."""
    if not isinstance(tree, dict):
        return tree
    plain = {key: everywhere(value, change) for key, value in tree.items()}
    return {
        key: change(key, value) if isinstance(value, int | float) and not isinstance(value, bool) else value
        for key, value in plain.items()
    }


def train(scene: SceneData, plain: dict[str, Any], output_dir: Path):
    """(module, what a run with the product's guard and checkpoints has shown); raises what the run raises."""
    prepare_machine(plain["threads"])
    shown = Shown()
    kept = {name: plain["callbacks"][name] for name in ("interrupt", "finite", "checkpoint", "checkpoint_end")}
    trainer = pl.Trainer(
        accelerator="cpu", devices=1, max_steps=plain["max_steps"], logger=False, enable_progress_bar=False,
        enable_model_summary=False, num_sanity_val_steps=0, limit_val_batches=0, use_distributed_sampler=False,
        callbacks=[*build_callbacks(kept, output_dir), shown],
    )  # fmt: skip
    module = build(plain["module"], output_dir=str(output_dir))
    module.config = plain
    fit(module, Given(scene), trainer, test=False)
    return module, shown


class Shown(pl.Callback):
    """The loss of every step, and the error of the training images before the first and after the last.

    Errors tell more of learning than losses, whose terms come and go with the stages of a method.
    """

    def __init__(self) -> None:
        self.losses: list[float] = []
        self.before = self.after = math.nan

    def on_train_start(self, trainer, module) -> None:
        self.before = image_error(module)

    def on_train_batch_end(self, trainer, module, outputs, *_) -> None:
        self.losses.append(outputs["loss"].item())

    def on_train_end(self, trainer, module) -> None:
        self.after = image_error(module)


def image_error(module) -> float:
    """Mean absolute error of the images that a module predicts of its training views, where they count."""
    errors = []
    for view in module.scene.train:
        error = (module.predict(view.frame) - view.image(module.modality)).abs().mean(-1)
        errors.append(error if view.mask is None else error[view.mask])
    return torch.cat([error.flatten() for error in errors]).mean().item()


def checkpoints(output_dir: Path) -> dict[str, dict[str, Tensor]]:
    """Every float tensor of every checkpoint of a run, by file and name."""
    found = {}
    for path in sorted(output_dir.rglob("*.ckpt")):
        stored = load_checkpoint(path)
        tensors = dict(stored["state_dict"])
        for number, state in enumerate(s for o in stored["optimizer_states"] for s in o["state"].values()):
            tensors |= {f"moment {number} {key}": value for key, value in state.items() if isinstance(value, Tensor)}
        found[path.name] = {name: value for name, value in tensors.items() if value.is_floating_point()}
    return found
