"""A result names the code and the machine that it was measured with."""

import os
import subprocess

import torch

import heatsplat
from heatsplat.io.versions import collect_versions, processor


def test_versions_name_the_commit():
    found = collect_versions()
    assert found["heatsplat"] == heatsplat.__version__
    assert found["torch"] == torch.__version__
    folder = heatsplat.__path__[0]
    head = subprocess.run(["git", "-C", folder, "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    assert found["git_commit"] == (head.stdout.strip() if head.returncode == 0 else None)
    assert isinstance(found["git_dirty"], bool) == (head.returncode == 0)


def test_the_processor_has_a_name_and_cores():
    name, _, cores = processor().rpartition(", ")
    assert name and cores == f"{os.cpu_count()} cores"
