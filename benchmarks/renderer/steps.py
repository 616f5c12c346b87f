"""Where the time of a training step goes, from the data loader to the optimiser, and how little it could take.

The steps are those of a run: Lightning's loop, the training module, the callbacks. The scene holds still, because learning
rates of zero change no time, so every step costs the same but for those in which density control looks at pixels. Parts are
timed by standing a clock before the kernels that they call.
"""

from __future__ import annotations

import itertools
import logging
import os
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch.utils.data import DataLoader

from benchmarks.renderer.clocks import set_threads
from benchmarks.renderer.floors import Machine, Work, step_floors
from benchmarks.renderer.peers import backend
from benchmarks.renderer.scenes import Case, build
from heatsplat.composition import compose
from heatsplat.contracts import Camera, Frame, SceneData, ThermalRange, View, ViewSet
from heatsplat.kernels import adam, binning, compositing, projection, relaxation, ssim
from heatsplat.runs.run import build_module, build_trainer

log = logging.getLogger("heatsplat")

VIEWS = 60  # enough moments for 24 harmonics
TURN = 0.002  # radians between neighbouring views, so that no view is the one before

# Part of a step -> what does its work: pairs of an object and the name of a function in it.
PARTS: dict[str, list[tuple[Any, str]]] = {
    "projection": [(projection, "project")],
    "binning": [(binning, "sort_by_depth"), (binning, "find_instances"), (binning, "deal_to_tiles")],
    "forward": [(compositing, "composite")],
    "loss": [(ssim, "forward"), (ssim, "backward")],
    "backward": [(compositing, "composite_backward")],
    "gradients": [(projection, "project_backward")],
    "thermal": [(relaxation, name) for name in ("fill_table", "forward", "backward", "write_gains")],
    "optimiser": [(adam, "square_columns"), (adam, "step"), (relaxation, "step_gains")],
}
# What the module does in a step, its kernels included; the rest of a step is Lightning's.
MODULE = ("training_step", "backward", "on_after_backward")
# Of every run: rates of zero, as many Gaussians as there are, nothing beside training.
STILL = (
    "optim.means=0", "optim.log_scales=0", "optim.quats=0", "optim.opacity_logits=0", "density.multiple=1",
    "density.remove_at=[]", "density.prune_opacity=0", "test=false", "logger=none", "trainer.limit_val_batches=0",
    "callbacks.checkpoint=null", "callbacks.checkpoint_end=null", "callbacks.report=null", "callbacks.progress.enabled=false",
)  # fmt: skip
WARM_UP = 5  # steps in which kernels are compiled and memory is found


def still_scene(scene: dict[str, Any]) -> SceneData:
    """Views of the benchmark's Gaussians (``scenes.build``), all from about the same place.

    Targets are smooth noise: what they show costs no time.
    """
    camera = scene["camera"]
    width, height = camera["width"], camera["height"]
    generator = torch.Generator().manual_seed(1)
    coarse = torch.rand(1, 1, 8, 8, generator=generator)
    target = torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic")[0, 0, :, :, None].clamp(0, 1)
    frames = []
    for k in range(VIEWS):
        angle = torch.tensor(TURN * (k - VIEWS / 2) / VIEWS, dtype=torch.float64)
        turn = torch.eye(4, dtype=torch.float64)
        turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = angle.cos(), angle.sin(), -angle.sin(), angle.cos()
        turn[0, 3] = 0.01 * k / VIEWS  # cameras apart, or the scene would have no extent
        seen_by = Camera(turn @ camera["viewmats"].double(), camera["Ks"], width, height)
        frames.append(Frame(f"{k:03d}", k, seen_by, time_s=10.0 * k))
    views = ViewSet(frames, lambda k: View(frames[k], thermal=target))
    nothing = ViewSet([], lambda k: View(frames[k]))
    return SceneData(
        "benchmark", views, nothing, nothing, scene["means"], thermal_range=ThermalRange(0.0, 100.0), ambient_c=20.0
    )


@torch.no_grad()
def at_home(module: Any, scene: dict[str, Any]) -> None:
    """Gives the Gaussians of a module the places and shapes of those of ``scenes.build``."""
    module.splats["means"].copy_(scene["means"])
    module.splats["log_scales"].copy_(scene["scales"].log())
    module.splats["quats"].copy_(scene["quats"])
    module.splats["opacity_logits"].copy_(scene["opacities"].reshape(-1, len(scene["means"])).T.logit())


class StepClock:
    """Seconds of the parts of each step: of the functions it stands before, while it is entered.

    A step lasts from one call of ``training_step`` to the next. Where an update follows several steps (``optim.accumulate``),
    those of one update are taken together.
    """

    def __init__(self, module: Any) -> None:
        self.module, self.together = module, module.optim.accumulate
        self.steps: list[dict[str, float]] = []
        self._patches = ExitStack()

    def __enter__(self) -> StepClock:
        for part, functions in PARTS.items():
            for owner, name in functions:
                self._stand_before(owner, name, part)
        for name in MODULE:
            self._stand_before(self.module, name, f"module.{name}")
        return self

    def __exit__(self, *_: Any) -> None:
        self._patches.close()

    def _stand_before(self, owner: Any, name: str, part: str) -> None:
        function = getattr(owner, name)

        def timed(*arguments: Any, **options: Any) -> Any:
            start = time.perf_counter()
            if part == "module.training_step":
                self.steps.append({"start": start, "processor": time.process_time()})
            try:
                return function(*arguments, **options)
            finally:
                if self.steps:
                    step = self.steps[-1]
                    step[part] = step.get(part, 0.0) + time.perf_counter() - start

        self._patches.enter_context(patch.object(owner, name, timed))

    def milliseconds(self) -> dict[str, float]:
        """Of the whole step and its parts, which add up to it: means over the quickest quarter of the updates.

        "torch" is what the module does besides its kernels: activations, autograd, statistics. "Lightning" is what is
        left: the loop, its hooks and guards, the data loader, the schedule of learning rates.
        """
        steps = []
        for step, after in zip(self.steps[WARM_UP:-1], self.steps[WARM_UP + 1 :], strict=True):
            parts = {part: step.get(part, 0.0) for part in PARTS}
            kernels = sum(parts.values()) - parts["optimiser"]
            parts["torch"] = sum(step.get(f"module.{name}", 0.0) for name in MODULE) - kernels
            whole = after["start"] - step["start"]
            steps.append({"step": whole} | parts | {"Lightning": whole - sum(parts.values())})
        return {name: 1e3 * value for name, value in self._quick(steps).items()}

    def processor(self) -> float:
        """Milliseconds that all threads together took of the processor for a step, mean over the quickest quarter."""
        starts = [step["processor"] for step in self.steps[WARM_UP:]]
        took = [{"step": after - before} for before, after in itertools.pairwise(starts)]
        return 1e3 * self._quick(took)["step"]

    def _quick(self, steps: Sequence[dict[str, float]]) -> dict[str, float]:
        """Means over the steps of the quickest quarter of the updates; steps that wait for one at the end are left out."""
        each = self.together
        updates = [steps[k : k + each] for k in range(0, len(steps) - each + 1, each)] or [steps]
        means = [{name: sum(step[name] for step in these) / len(these) for name in these[0]} for these in updates]
        means.sort(key=lambda parts: parts["step"])
        quick = means[: max(1, len(means) // 4)]
        return {name: sum(parts[name] for parts in quick) / len(quick) for name in quick[0]}


@dataclass(frozen=True)
class Steps:
    """What training steps took (``StepClock``), and what they had to do besides rendering."""

    milliseconds: dict[str, float]
    processor: float
    frequencies: int
    parameters: int
    together: int


def time_steps(overrides: Sequence[str], scene: dict[str, Any], steps: int, output_dir: Path) -> Steps:
    """What a training step takes, and its parts.

    Args:
        overrides: of a run, whose training module, trainer and callbacks are those of the command line.
        scene: Gaussians and camera, as ``scenes.build`` gives them.
        steps: how many are timed, besides those that warm up.
        output_dir: folder for what a run writes.
    """
    config = compose([*STILL, f"max_steps={steps + WARM_UP + 1}", *overrides])
    module, views = build_module(config, output_dir), still_scene(scene)
    module.attach(views)
    at_home(module, scene)
    trainer = build_trainer(config["trainer"], config, output_dir)
    with StepClock(module) as clock:
        trainer.fit(module, train_dataloaders=DataLoader(views.train, batch_size=None, num_workers=0))
    frequencies = module.splats["source_gains"].shape[2] if "source_gains" in module.splats else 0
    return Steps(
        clock.milliseconds(),
        clock.processor(),
        frequencies,
        sum(parameter.numel() for parameter in module.parameters()),
        clock.together,
    )


def work_of(case: Case) -> Work:
    """What rendering a case takes."""
    scene, _ = build(case)
    scene["means"].requires_grad_()
    names = ("means", "quats", "scales", "opacities", "features")
    return Work.of(backend("cpu")(**{name: scene[name] for name in names}, **scene["camera"]))


def training_rows(
    machine: Machine,
    threads: int,
    cases: Sequence[Sequence[int]],
    steps: int,
    rounds: int,
    methods: dict[str, Sequence[str]],
    output_dir: Path,
) -> list[dict[str, Any]]:
    """Whole training steps through Lightning, part by part; methods take turns.

    Args:
        machine: rates of ``threads`` threads.
        threads: of kernels and of torch.
        cases: [N, width, height].
        steps: how many are timed in each round.
        rounds: how often methods take turns; the quickest round counts.
        methods: name -> overrides of a run; the first is what others are compared with.
        output_dir: folder for what runs write.
    """
    set_threads(threads)
    rows = []
    for n, w, h in cases:
        case = Case(n, w, h, threads=threads)
        scene, _ = build(case)
        runs: dict[str, list[Steps]] = {name: [] for name in methods}
        for _ in range(rounds):
            for name, overrides in methods.items():
                runs[name].append(time_steps([*overrides, f"cap_max={n}"], scene, steps, output_dir))
        work, baseline = work_of(case), {}
        for name, results in runs.items():
            best = min(results, key=lambda result: result.milliseconds["step"])
            found = {"wall": best.milliseconds["step"], "processor": min(result.processor for result in results)}
            baseline = baseline or found
            floors = step_floors(work, machine, best.frequencies, best.parameters, best.together)
            row = {"case": case.name, "method": name, "threads": threads, "views": best.together}
            row |= {"ratio": found["wall"] / baseline["wall"], "processor": found["processor"]}
            row |= {"processor_ratio": found["processor"] / baseline["processor"]}
            row |= {f"{part}_ms": value for part, value in best.milliseconds.items()}
            row |= {f"floor_{part}_ms": floors.get(part) for part in best.milliseconds}
            row["floor_step_ms"] = sum(floors.values())
            rows.append(row | {"load": os.getloadavg()[0]})
            log.info("%s, %s, %d thread(s): %.1f ms a step", case.name, name, threads, row["step_ms"])
    return rows
