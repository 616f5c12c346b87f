"""PLY as plyfile reads it, and as a run starts from it."""

import numpy as np
import pytest
import torch
from plyfile import PlyData
from running import TINY

from heatsplat.composition import compose
from heatsplat.contracts import SceneError
from heatsplat.export.formats.mesh import Mesh
from heatsplat.export.formats.ply import Ply
from heatsplat.geometry.spherical_harmonics import C0
from heatsplat.io.pictures import colorize
from heatsplat.runs.run import begin


def test_another_library_reads_what_was_written(cooling, tmp_path):
    Ply(range_c=[20.0, 40.0]).write(cooling, tmp_path / "a.ply")
    vertex, seen = PlyData.read(tmp_path / "a.ply")["vertex"], cooling.seen
    assert np.array_equal(np.stack([vertex[axis] for axis in "xyz"], axis=1), seen.means.numpy())
    assert np.allclose(1 / (1 + np.exp(-vertex["opacity"])), seen.opacities, atol=1e-6)
    assert np.allclose(np.exp(np.stack([vertex[f"scale_{i}"] for i in range(3)], axis=1)), seen.scales, rtol=1e-5)
    assert np.allclose(vertex["temperature"] - 273.15, cooling.values, atol=1e-3)
    shown = 0.5 + C0 * np.stack([vertex[f"f_dc_{i}"] for i in range(3)], axis=1)
    assert np.allclose(shown * 255, colorize(cooling.values[:, None], 20.0, 40.0, "inferno")[:, 0], atol=1e-3)
    assert np.array_equal(vertex["time_constant"], seen.attributes["time constant"], equal_nan=True)


@pytest.mark.parametrize("method", ["3dgs", "thermogs"])
def test_a_run_starts_from_it(cooling, tmp_path, method):
    Ply().write(cooling, tmp_path / "a.ply")
    run = begin(
        compose([*TINY, f"method={method}", "max_steps=10", "init=pretrained", f"init.path={tmp_path}/a.ply"]), tmp_path
    )
    run.module.attach(run.data.scene)
    splats = run.module.splats
    assert torch.equal(splats.means.detach(), cooling.seen.means)
    assert torch.allclose(splats.scales.detach(), cooling.seen.scales, rtol=1e-5)
    assert torch.allclose(splats.opacities.detach()[0], cooling.seen.opacities, atol=1e-6)


def test_what_cannot_be_coloured_is_said(cooling, tmp_path):
    with pytest.raises(SceneError, match=r"what.colormap=rgb: this method has no colours"):
        Ply(colormap="rgb").write(cooling, tmp_path / "a.ply")
    with pytest.raises(SceneError, match=r"what.colormap=infrno is no map of matplotlib"):
        Ply(colormap="infrno").write(cooling, tmp_path / "a.ply")
    with pytest.raises(
        SceneError, match=r"what.colormap=rgb is no map of matplotlib"
    ):  # of a mesh, which has no Gaussians
        Mesh(mesh="a.ply", colormap="rgb")
    with pytest.raises(SceneError, match=r"what.range_c must be two increasing numbers"):
        Ply(range_c=[40.0, 20.0]).write(cooling, tmp_path / "a.ply")
