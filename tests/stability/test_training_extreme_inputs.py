"""Every method on scenes built to break it: it converges, or stops with an error that names the cause."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from extreme_inputs import SPAN_S, STEPS, camera, checkpoints, everywhere, plain_config, sound, train, with_views
from helpers import ALL_METHODS

from heatsplat.contracts import SceneData, SceneError, ThermalRange
from heatsplat.training.machine import prepare_machine

pytestmark = pytest.mark.slow  # until every method has passed on an idle machine; 60 runs of about a second

# Error of images with which a scene may begin as it ends, half a step of 8 bits: points of one value tell an even one at once.
NOTHING_LEFT = 0.5 / 255
CAUSE = (FloatingPointError, SceneError, RuntimeError)


@dataclass(frozen=True)
class Case:
    """What breaks a training, and how it may end.

    Args:
        scene: what is trained on.
        change: function from the resolved configuration to the one that is run.
        error: how a run may stop: a pattern of the message; None: it must reach its end.
        must_stop: it has to.
        learns: the error of the images at the end is below this share of what it was.
    """

    scene: Callable[[], SceneData] = sound
    change: Callable[[dict[str, Any]], dict[str, Any]] = lambda plain: plain
    error: str | None = None
    must_stop: bool = False
    learns: float | None = 0.6


def at_times(*times: float) -> SceneData:
    def moved(position, view):
        return replace(view, frame=replace(view.frame, time_s=times[position]))

    return with_views(sound(len(times)), moved)


def flat() -> SceneData:
    def even(_, view):
        return replace(view, thermal=torch.full_like(view.thermal, 0.4), rgb=torch.full_like(view.rgb, 0.4))

    return with_views(sound(), even)


def one_frame(value: float, masked: bool = False) -> SceneData:
    def filled(position, view):
        if position != 2:
            return view
        mask = torch.zeros(view.thermal.shape[:2], dtype=torch.bool) if masked else None
        return replace(view, thermal=torch.full_like(view.thermal, value), mask=mask)

    return with_views(sound(), filled)


def one_view_of_nothing() -> SceneData:
    def turned(position, view):
        return replace(view, frame=replace(view.frame, camera=camera(0.3, away=True))) if position % 2 else view

    return with_views(sound(), turned)


def one_gaussian(plain: dict[str, Any]) -> dict[str, Any]:
    if "source" not in plain["module"]["init"]:
        pytest.skip("it does not begin with Gaussians")
    plain["module"]["init"] |= {"source": "random", "count": 1}
    return plain


def hundredfold(plain: dict[str, Any]) -> dict[str, Any]:
    def faster(key, number):
        return number * 100 if key.startswith("lr") and not key.endswith(("_end", "_held")) else number

    module = everywhere(plain["module"], faster)
    rates = {name: 100 * module["optim"][name] for name in ("means", "log_scales", "quats", "opacity_logits")}
    return plain | {"module": module | {"optim": module["optim"] | rates}}


def resets(plain: dict[str, Any]) -> dict[str, Any]:
    return everywhere(plain, lambda key, number: {"reset_every": 60, "every": 30}.get(key, number))


CASES = {
    "nothing wrong": Case(),
    "constant temperature": Case(flat),
    "two frames": Case(lambda: sound(2)),
    "duplicate timestamps": Case(lambda: at_times(0.0, 0.0, 500.0, 500.0, SPAN_S, SPAN_S)),
    "one moment": Case(lambda: at_times(0.0, 0.0, 0.0)),
    "one saturated frame": Case(lambda: one_frame(1.0), learns=1.0),  # no cloud explains it beside the others
    "a masked frame of NaN": Case(lambda: one_frame(math.nan, masked=True)),
    "a frame of NaN": Case(lambda: one_frame(math.nan), error=r"NaN.*frame_2\.png", must_stop=True),
    "a single Gaussian": Case(change=one_gaussian, learns=None),
    "learning rates a hundred times too high": Case(
        change=hundredfold, learns=None, error="would remove all|NaN|infinite"
    ),
    "opacity resets with views of nothing": Case(one_view_of_nothing, resets, learns=None),
    "a range of a nanokelvin": Case(
        lambda: replace(sound(), thermal_range=ThermalRange(15.0, 15.0 + 1e-9)),
        error="is 1e-09 K wide.*computes in kelvin",
    ),
    "a range of a hundredth of a kelvin": Case(
        lambda: replace(sound(), thermal_range=ThermalRange(15.0, 15.01001)), learns=0.8
    ),
}


@pytest.fixture(autouse=True)
def threads():
    before = torch.get_num_threads()
    yield
    prepare_machine(before)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("method", ALL_METHODS)
def test_a_run_learns_or_says_what_is_wrong(method, name, tmp_path):
    case = CASES[name]
    plain = case.change(plain_config(tmp_path, method))
    try:
        module, shown = train(case.scene(), plain, tmp_path)
    except CAUSE as error:
        assert case.error is not None and re.search(case.error, str(error)), repr(error)
    else:
        assert not case.must_stop
        assert len(shown.losses) == STEPS and all(map(math.isfinite, shown.losses))
        assert all(bool(p.isfinite().all()) for p in module.parameters())
        assert all(bool(module.predict(frame).isfinite().all()) for frame in module.scene.train.frames)
        if case.learns is not None:
            assert shown.after < max(case.learns * shown.before, NOTHING_LEFT)
        assert "last.ckpt" in checkpoints(tmp_path)
    for file, tensors in checkpoints(tmp_path).items():
        assert [key for key, value in tensors.items() if not value.isfinite().all()] == [], file


def test_equal_bounds_are_refused_by_name():
    with pytest.raises(SceneError, match=r"thermal range 20.0 .. 20.0 °C is not a range"):
        ThermalRange(20.0, 20.0)
