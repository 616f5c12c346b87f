"""Levels of detail of a run as files, and a run that merges its Gaussians itself."""

import inspect
import json
from functools import partial

import pytest
import torch
from running import TINY, run

from heatsplat import cli
from heatsplat.composition import compose
from heatsplat.contracts import SceneError
from heatsplat.density.merging import FlatMerging
from heatsplat.export.files import write_file
from heatsplat.export.formats.ply import Ply
from heatsplat.io.ply import read_splats
from heatsplat.runs.levels import write_levels
from heatsplat.runs.run import load

SHORT = (
    "method=etgs",
    *TINY,
    "data.scene=cooling",
    "data.downscale=2",
    "callbacks.costs=null",
    "trainer.limit_val_batches=0",
    "logger=none",
    "max_steps=20",
    "merge=flat",
    "merge.tolerance_c=0.2",
    "merge.views=4",
    "test=false",
)


@pytest.fixture(scope="module")
def merged(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    module, _ = run(folder, *SHORT)
    return folder, module


def test_a_run_ends_with_its_gaussians_merged_and_says_so(merged):
    folder, module = merged
    found = module.results.run["merging"]
    assert found["after"] == len(module.splats) < found["before"]
    assert found["rms_c"] <= found["tolerance_c"] == 0.2
    last = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    every = torch.load(folder / "checkpoints" / "step_000020.ckpt", weights_only=True)
    assert len(last["state_dict"]["splats.raw.means"]) == found["after"]
    assert len(every["state_dict"]["splats.raw.means"]) == found["before"]
    moments = last["optimizer_states"][0]["state"]
    assert {len(state["exp_avg"]) for state in moments.values() if state["exp_avg"].ndim} <= {found["after"]}


def test_levels_are_checkpoints_and_splats_for_viewers(merged, tmp_path):
    folder, _ = merged
    trained = load(folder / "checkpoints" / "step_000020.ckpt")
    write_levels(trained, FlatMerging(views=4), [0.1, 0.3], tmp_path, partial(write_file, trained.module, Ply()))
    told = json.loads((tmp_path / "levels.json").read_text())
    frame = trained.scene.train.frames[0]
    for number, level in enumerate(told):
        shown = load(tmp_path / f"lod_{number}.ckpt")
        assert len(shown.module.splats) == level["after"] < len(trained.module.splats)
        change = (shown.render(frame, unseen="keep") - trained.render(frame, unseen="keep")).square().mean().sqrt()
        assert change <= 5 * level["tolerance_c"]
        vertices = read_splats(tmp_path / f"lod_{number}.ply")
        assert len(vertices["means"]) == level["after"] and "temperature_k" in vertices
        write_file(shown.module, Ply(), tmp_path / "exported.ply")
        assert (tmp_path / "exported.ply").read_bytes() == (tmp_path / f"lod_{number}.ply").read_bytes()


def simplified(ckpt, folder, *overrides):
    inspect.unwrap(cli.simplify)(compose([f"ckpt={ckpt}", "threads=1", *overrides], "simplify"), folder)


@pytest.mark.parametrize(("time", "told"), [("99999", "outside the record"), ("nan", "must be a number, got nan")])
def test_a_time_that_the_record_lacks_is_refused_before_the_search(merged, tmp_path, time, told):
    folder, _ = merged
    with pytest.raises(SceneError, match=f"time.* {told}"):
        simplified(folder / "checkpoints" / "step_000020.ckpt", tmp_path, f"time={time}")
    assert not list(tmp_path.iterdir())


def test_levels_have_temperatures_where_the_model_tells_those_of_no_surface(tmp_path):
    run(tmp_path / "run", *TINY, "method=ravigs", "max_steps=2", "init.count=200", "test=false")
    simplified(tmp_path / "run" / "checkpoints" / "last.ckpt", tmp_path, "levels_c=0.5", "merge.views=4")
    kelvins = read_splats(tmp_path / "lod_0.ply")["temperature_k"]
    assert 250 < kelvins.min() < kelvins.max() < 350


def test_levels_that_do_not_increase_are_refused(tmp_path):
    for levels in ([], [0.1, 0.1], [0.0], 0.0, "far", [0.1, "a"]):
        with pytest.raises(SceneError, match="levels_c"):
            write_levels(None, FlatMerging(), levels, tmp_path)
