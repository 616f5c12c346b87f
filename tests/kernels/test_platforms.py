"""Other machines, in processes of their own: no AVX-512, no OpenMP, and data loaders that fork."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import succeeds

SOURCE = Path(__file__).resolve().parents[2] / "src"

# A training step in small: renderer, loss and heat, forward and backward; prints the threading layer, saves the numbers.
STEP = """
import sys
import numba, numpy as np, torch
numba.config.THREADING_LAYER = sys.argv[2] if sys.argv[2:] else numba.config.THREADING_LAYER
from heatsplat.losses.compose import LossInputs
from heatsplat.losses.photometric import Photometric
from heatsplat.physics.fused import visible_temperature
from heatsplat.renderers import rasterization

def step():
    generator = torch.Generator().manual_seed(0)
    count = 400
    means = torch.rand(count, 3, generator=generator) * 4 - torch.tensor([2.0, 2.0, -1.0])
    quats, scales = torch.randn(count, 4, generator=generator), torch.rand(count, 3, generator=generator) * 0.2
    opacities, initial = torch.rand(1, count, generator=generator), torch.rand(count, generator=generator)
    rate, gains = torch.rand(count, generator=generator) * 3, torch.randn(count, 2, 5, generator=generator) * 0.1
    leaves = [leaf.requires_grad_() for leaf in (means, quats, scales, opacities, initial, rate, gains)]
    omega = torch.linspace(1, 9, 5, dtype=torch.float64)
    time, ambient = torch.tensor(0.7, dtype=torch.float64), torch.tensor(0.3)
    K = torch.tensor([[60.0, 0, 36], [0, 60, 28], [0, 0, 1]])
    emit = lambda ids: visible_temperature(time, ambient, initial, rate, omega, gains, None, ids)[:, None]
    image = rasterization(means, quats, scales, opacities, emit, torch.eye(4), K, 70, 57, backend="cpu", depth=False)
    target = torch.rand(57, 70, 1, generator=generator)
    sum(Photometric()(LossInputs(image.features, target, None, None, None)).values()).backward()
    return [image.features.detach(), *(leaf.grad for leaf in leaves)]

numbers = [tensor.numpy() for tensor in step()]
"""
SAVE = "np.savez(sys.argv[1], *numbers); print(numba.threading_layer())\n"


def forked(folder: Path, script: str, *arguments: str) -> str:
    """What a script prints in a fork of a process that has loaded the libraries and started no thread."""
    file = folder / "script.py"
    file.write_text(script)
    return succeeds([str(file), *arguments], SOURCE.parent).strip()


def run(script: str, *arguments: str, **variables: str) -> str:
    """What a script prints in a fresh interpreter with further environment variables."""
    environment = os.environ | {"PYTHONPATH": str(SOURCE)} | variables
    result = subprocess.run(
        [sys.executable, "-c", script, *arguments], env=environment, capture_output=True, text=True, timeout=600
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


LOADER = """
from torch.utils.data import DataLoader
from heatsplat.datamodules.synthetic import Synthetic

views = Synthetic(scene="static", size="tiny").scene.train
loader = DataLoader(views, batch_size=None, num_workers=2, multiprocessing_context="fork")
views = [float(view.thermal.mean()) for view in loader]
again = [tensor.numpy() for tensor in step()]
assert all(np.array_equal(a, b) for a, b in zip(numbers, again, strict=True))
assert len(views) > 2 and all(np.isfinite(views))
"""


@pytest.fixture(scope="module")
def numbers(tmp_path_factory) -> list[np.ndarray]:
    """What this machine computes as it is; then its data loaders fork, and it computes the same again.

    A forked child of OpenMP threads dies in its first parallel region; views are decoded without any kernel.
    """
    folder = tmp_path_factory.mktemp("step")
    forked(folder, STEP + SAVE + LOADER, str(folder / "here.npz"))
    return list(np.load(folder / "here.npz").values())


def test_data_loaders_may_fork_after_kernels_have_run(numbers):
    assert len(numbers) == 8  # the image and seven gradients, told by the process that forked


def test_the_fallback_threading_layer_gives_the_same_bits(numbers, tmp_path):
    # OpenMP is not everywhere (macOS, some containers); workqueue comes with Numba.
    path = tmp_path / "workqueue.npz"
    assert forked(tmp_path, STEP + SAVE, str(path), "workqueue") == "workqueue"
    for found, expected in zip(np.load(path).values(), numbers, strict=True):
        assert np.array_equal(found, expected)


@pytest.mark.slow  # it compiles every kernel of a training step anew
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="haswell is an x86 processor")
def test_a_processor_without_avx512_computes_the_same(numbers, tmp_path):
    # Sixteen lanes are then two registers; sums over lanes keep their order, but not what fuses into a multiply-add.
    path = tmp_path / "haswell.npz"
    run(
        STEP + SAVE, str(path), NUMBA_CPU_NAME="haswell", NUMBA_CPU_FEATURES="+avx,+avx2,+fma,+bmi,+bmi2,+lzcnt,+popcnt"
    )
    for found, expected in zip(np.load(path).values(), numbers, strict=True):
        difference = np.abs(found - expected)
        assert np.quantile(difference, 0.99) < 2e-5 * np.abs(expected).max()
        # A pixel at a threshold of alpha or transmittance may fall to the other side.
        assert np.linalg.norm(difference) < 2e-3 * np.linalg.norm(expected)
