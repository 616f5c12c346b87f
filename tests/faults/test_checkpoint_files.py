"""Checkpoint files when the process is killed, the disk is full or the bytes change."""

import os
import random
import resource
import signal
import time
from contextlib import contextmanager

import pytest
import torch

from heatsplat.contracts import SceneError
from heatsplat.training.checkpoints import CheckpointFiles, load_checkpoint

FILES = CheckpointFiles()


def content(step, size=100_000):
    return {"global_step": step, "state_dict": {"a": torch.full((size,), float(step)), "b": torch.arange(50)}}


@contextmanager
def disk_of(size):
    """No file may grow beyond ``size`` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("left", [0, 1000, 200_000])
def test_a_full_disk_ends_in_a_sentence_and_leaves_the_last_good_checkpoint(tmp_path, left):
    path = tmp_path / "last.ckpt"
    FILES.save_checkpoint(content(1), path)
    with (
        disk_of(left),
        pytest.raises(SceneError, match=r"checkpoint of step 2 \(0\.4 MB\) could not be written to .*last\.ckpt"),
    ):
        FILES.save_checkpoint(content(2), path)
    assert load_checkpoint(path)["global_step"] == 1
    assert [file.name for file in tmp_path.iterdir()] == ["last.ckpt"]


def test_a_temporary_folder_that_is_full_is_nobodys_business(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.mkstemp", lambda *_, **__: pytest.fail("another folder was written to"))
    FILES.save_checkpoint(content(1), tmp_path / "last.ckpt")
    assert load_checkpoint(tmp_path / "last.ckpt")["global_step"] == 1


def test_what_has_a_checkpoints_name_is_whole_whenever_its_writer_is_killed(tmp_path):
    path, draws = tmp_path / "last.ckpt", random.Random(0)
    FILES.save_checkpoint(content(0), path)
    for _ in range(12):
        child = os.fork()
        if child == 0:
            for step in range(1, 100_000):
                FILES.save_checkpoint(content(step), path)
            os._exit(0)
        time.sleep(draws.uniform(0.01, 0.06))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        found = load_checkpoint(path)
        assert bool((found["state_dict"]["a"] == found["global_step"]).all())
    FILES.save_checkpoint(content(7), path)
    assert [file.name for file in tmp_path.iterdir()] == ["last.ckpt"], "what killed writers left lies about"


@pytest.mark.parametrize("place", [0.1, 0.5, 0.9])
def test_a_zeroed_block_is_noticed_and_other_checkpoints_are_named(tmp_path, place):
    path = tmp_path / "last.ckpt"
    FILES.save_checkpoint(content(3), path)
    FILES.save_checkpoint(content(2), tmp_path / "step_000002.ckpt")
    data = bytearray(path.read_bytes())
    start = int(place * len(data))
    data[start : start + 512] = bytes(512)
    path.write_bytes(data)
    with pytest.raises(
        SceneError, match=r"last\.ckpt is not a checkpoint .*checksum differs.*there are: .*step_000002\.ckpt"
    ):
        load_checkpoint(path)
