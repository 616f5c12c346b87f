"""The renderer benchmark: its peers compute the same, its clocks and floors are plausible, its tables are complete."""

import csv

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from running import compose_run

from benchmarks.renderer import fused, on_cuda, peers
from benchmarks.renderer.floors import Machine, Work
from benchmarks.renderer.scenes import Case, build
from heatsplat import cli
from heatsplat.contracts import SceneError
from heatsplat.kernels.scheduling import thread_count, use_threads
from heatsplat.renderers import rasterization

ARRAYS = ("means", "quats", "scales", "opacities", "features")


@pytest.fixture(autouse=True)
def keep_threads():
    kernels, torchs = thread_count(), torch.get_num_threads()
    yield
    use_threads(kernels)
    torch.set_num_threads(torchs)


def test_the_torch_tiles_draw_what_the_renderer_draws():
    scene, _ = build(Case(500, 48, 40, channels=3))
    arguments = {key: scene[key] for key in ARRAYS} | scene["camera"]
    expected = rasterization(**arguments, backend="reference").features
    found = peers.render_torch_tiles(**arguments)
    assert (found - expected).abs().mean() < 1e-4  # it does not stop at a transmittance of 1e-4


def test_the_losses_compared_are_one_loss():
    prediction, target = torch.rand(2, 30, 41, 2, generator=torch.Generator().manual_seed(0))
    full, separable = peers.full_window_loss(prediction, target), peers.separable_loss(prediction, target)
    assert full.item() == pytest.approx(separable.item(), rel=1e-5)


def test_work_counts_what_was_rendered():
    scene, _ = build(Case(300, 64, 48))
    scene["means"].requires_grad_()
    output = rasterization(
        **{key: scene[key] for key in ARRAYS}, **scene["camera"], backend="cpu", depth=False
    )  # fmt: skip
    work = Work.of(output.features)
    assert (work.gaussians, work.pixels, work.channels, work.modalities) == (300, 64 * 48, 1, 1)
    assert work.visible == len(output.meta["visible_ids"])
    # A 64x48 image has 2 x 2 tiles, 16 x 12 blocks; every instance that mattered reaches at least one block.
    assert work.visible <= work.instances <= 4 * work.visible
    assert work.visible * 0.5 < work.blocks <= work.visible * 16 * 12
    floors = work.floors(Machine(1e9, 1e10))
    assert set(floors) == {"projection", "binning", "forward", "backward", "gradients"}
    assert work.floors(Machine(2e9, 2e10))["forward"] == pytest.approx(floors["forward"] / 2)


def test_pairs_of_what_is_fused_run():
    case = Case(200, 32, 24)
    for pair in (fused.adam_pair, fused.group_pair, fused.maps_pair):
        times = {name: timed()[0] for name, timed in pair(case).items()}
        assert len(times) == 2 and min(times.values()) > 0


def test_the_study_of_cuda_times_steps_and_refuses_a_machine_without(tmp_path, monkeypatch):
    tables = on_cuda.run(tmp_path, [(300, 32, 24)], 2, {"etgs": ["method=etgs", "preset=fast"]}, device="cpu")
    (row,) = tables["steps"]
    assert row["method"] == "etgs" and row["ms"] > 0 and row["plain torch ms"] > 0 and tables["renderer"] == []
    assert "etgs" in (tmp_path / "cuda.md").read_text()
    with pytest.raises(SceneError, match="study.device must be one of cuda, cpu, got 'gpu'"):
        on_cuda.run(tmp_path, [(300, 32, 24)], 2, {}, device="gpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SceneError, match="study=cuda times steps on CUDA.*study=steps is for the CPU"):
        on_cuda.run(tmp_path, [(300, 32, 24)], 2, {})


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"cases": []}, r"study.cases=\[\] has nothing in it"),
        ({"cases": [500, 64, 48]}, "each of study.cases must be a list of 3 numbers, got 500"),
        ({"methods": {}}, r"study.methods=\[\] has nothing in it"),
        ({"threads": []}, r"study.threads=\[\] has nothing in it"),
        ({"rounds": 0}, "study.rounds must be a whole number, 1 or more, got 0"),
        ({"steps": "abc"}, "study.steps must be a whole number, 1 or more, got abc"),
        ({"views": [1, 0]}, "study.views must be a whole number, 1 or more, got 0"),
    ],
)
def test_the_study_of_steps_refuses_what_times_nothing(wrong, message, tmp_path):
    options = {"cases": [[500, 64, 48]], "steps": 8, "rounds": 1, "threads": [1], "methods": {"etgs": ["method=etgs"]}}
    with pytest.raises(SceneError, match=message):
        fused.run(tmp_path, **options | wrong)


@pytest.mark.slow
def test_the_study_of_steps_tells_ratios(tmp_path):
    overrides = ["study=steps", "study.cases=[[500,64,48]]", "study.steps=8", "study.rounds=1", "study.threads=[1]"]
    config = compose_run(*overrides, config_name="study")
    tables = cli.build(OmegaConf.to_container(config.study, resolve=True), output_dir=tmp_path)
    found = [(row["method"], row["views"]) for row in tables["training"]]
    assert found == [("3dgs", 1), ("etgs", 1), ("3dgs", 8), ("etgs", 8)]
    assert tables["training"][0]["ratio"] == tables["training"][2]["ratio"] == 1
    assert [row["ratio"] > 0 for row in tables["fused"]] == [True] * 3
    assert "etgs" in (tmp_path / "steps.md").read_text()


@pytest.mark.slow
def test_the_quick_study_writes_complete_and_plausible_tables(tmp_path):
    config = compose_run("study=renderer_quick", config_name="study")
    tables = cli.build(OmegaConf.to_container(config.study, resolve=True), output_dir=tmp_path)
    assert [len(tables[name]) for name in ("renderer", "modalities", "loss", "memory")] == [7, 1, 4, 1]
    for row in tables["renderer"]:
        assert row["floor_forward_ms"] > 0 and row["share_forward"] > 0
        assert row["threads"] > 1 or row["share_forward"] < 1.5  # two threads may never have had both cores
    assert tables["peers"][0]["ratio, 1 thread(s)"] > 1
    for row in tables["training"]:
        parts = [value for key, value in row.items() if key.endswith("_ms") and not key.startswith("floor_")]
        assert sum(parts) == pytest.approx(2 * row["step_ms"], rel=1e-6)  # the step, and its parts once more
        assert min(parts) >= 0
    static, etgs = tables["training"]
    assert static["thermal_ms"] == 0 < etgs["thermal_ms"]
    for name, rows in tables.items():
        with open(tmp_path / f"{name}.csv", newline="") as file:
            assert len(list(csv.DictReader(file))) == len(rows)
    text = (tmp_path / "renderer.md").read_text()
    assert "reached" in text and "Lightning" in text and "nan" not in text
    assert (tmp_path / "renderer.png").stat().st_size > 10_000
    assert np.isfinite(tables["memory"][0]["megabytes"])
