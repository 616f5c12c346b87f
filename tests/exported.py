"""Trained modules at their first step, and what an export takes of them."""

from running import TINY

from heatsplat.composition import compose
from heatsplat.export.moment import Moment, moments
from heatsplat.export.snapshot import snapshot
from heatsplat.runs.run import begin


def started(folder, *overrides):
    """A module at its first step, on a tiny scene."""
    run = begin(compose([*TINY, "max_steps=10", *overrides]), folder)
    run.module.attach(run.data.scene)
    return run.module


def at(module, time_s: float | None = None, layer: str = "auto") -> Moment:
    """The Gaussians of a module at a moment."""
    (moment,) = moments(module, snapshot(module), time_s, layer)
    return moment
