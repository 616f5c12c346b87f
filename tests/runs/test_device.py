"""On which device a run trains, whichever the machine has."""

import logging

import pytest
import torch
from pytorch_lightning.plugins.environments import LightningEnvironment

from heatsplat.composition import compose
from heatsplat.contracts import SceneError
from heatsplat.renderers import gsplat
from heatsplat.runs import device
from heatsplat.runs.device import device_of
from heatsplat.runs.run import build_trainer
from heatsplat.training.checkpoints import CheckpointFiles

MISSING = "the CUDA renderer needs gsplat (No module named 'gsplat'). Install it"


@pytest.fixture
def machine(monkeypatch):
    """A function that makes this a machine with or without CUDA and gsplat."""

    def make(cuda, has_gsplat):
        def load():
            if not has_gsplat:
                raise ImportError(MISSING)

        monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
        monkeypatch.setattr(gsplat, "load", load)
        gsplat.why_not.cache_clear()
        device._warn.cache_clear()

    yield make
    gsplat.why_not.cache_clear()
    device._warn.cache_clear()


@pytest.mark.parametrize(
    ("accelerator", "backend", "cuda", "has_gsplat", "expected"),
    [
        ("auto", "auto", False, False, "cpu"),
        ("auto", "auto", True, True, "cuda"),
        ("auto", "auto", True, False, "cpu"),
        ("auto", "cpu", True, True, "cpu"),
        ("auto", "reference", True, False, "cuda"),
        ("auto", "gsplat", True, True, "cuda"),
        ("auto", None, True, False, "cuda"),  # a field: plain torch
        ("cpu", "auto", True, True, "cpu"),
        ("gpu", "auto", True, True, "cuda"),
        ("cuda", "gsplat", True, True, "cuda"),
    ],
)
def test_what_can_be_used_is_taken(machine, accelerator, backend, cuda, has_gsplat, expected):
    machine(cuda, has_gsplat)
    assert device_of(accelerator, {} if backend is None else {"backend": backend}) == expected


def test_a_device_that_is_left_alone_is_told_once_with_the_reason(machine, caplog):
    machine(cuda=True, has_gsplat=False)
    with caplog.at_level(logging.WARNING, logger="heatsplat"):
        assert [device_of("auto", {"backend": "auto"}) for _ in range(3)] == ["cpu"] * 3
    assert [record.message for record in caplog.records] == [
        f"PyTorch sees a CUDA device, but this runs on the CPU: {MISSING}"
    ]


@pytest.mark.parametrize(
    ("accelerator", "backend", "cuda", "has_gsplat", "error", "message"),
    [
        ("gpu", "auto", False, True, SceneError, "trainer.accelerator=gpu: PyTorch sees no CUDA device"),
        ("gpu", "cpu", True, True, SceneError, "renderer=cpu renders on the CPU only"),
        ("gpu", "auto", True, False, ImportError, "needs gsplat"),
        ("auto", "gsplat", True, False, ImportError, "needs gsplat"),
        ("cpu", "gsplat", True, True, SceneError, "renderer=gsplat renders on CUDA only"),
        ("auto", "gsplat", False, True, SceneError, "renderer=gsplat renders on CUDA only"),
        ("cdua", "auto", True, True, SceneError, "cdua"),
        ("mps", "auto", False, False, SceneError, "mps"),
    ],
)
def test_what_cannot_be_had_is_refused(machine, accelerator, backend, cuda, has_gsplat, error, message):
    machine(cuda, has_gsplat)
    with pytest.raises(error, match=message):
        device_of(accelerator, {"backend": backend})


def test_in_a_job_of_slurm_it_is_our_launcher_that_starts_a_run_again(monkeypatch, tmp_path):
    """Lightning's handling of SLURM goes on with any hpc_ckpt_*.ckpt that it finds, whatever run wrote it."""
    for name, value in {"SLURM_NTASKS": "1", "SLURM_JOB_NAME": "sweep", "SLURM_JOB_ID": "7"}.items():
        monkeypatch.setenv(name, value)
    config = compose(["method=3dgs", "trainer.accelerator=cpu"])
    trainer = build_trainer(config["trainer"], {"callbacks": {}}, tmp_path)
    assert isinstance(trainer._accelerator_connector.cluster_environment, LightningEnvironment)
    assert isinstance(trainer.strategy.checkpoint_io, CheckpointFiles)
