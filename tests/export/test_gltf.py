"""glTF as pygltflib and trimesh read it: what stands in it, and that it lies as the scene does, with y up."""

import numpy as np
import pytest
import torch

from heatsplat.export.formats.gltf import Gltf
from heatsplat.export.place import place_of
from heatsplat.geometry.rotations import quats_to_matrices
from heatsplat.geometry.spherical_harmonics import C0
from heatsplat.io.pictures import colorize

pygltflib = pytest.importorskip("pygltflib")
EXTENSION = "KHR_gaussian_splatting"


def read(path):
    """Arrays of the only primitive by name, as pygltflib finds them."""
    document = pygltflib.GLTF2().load(str(path))
    primitive, blob = document.meshes[0].primitives[0], document.binary_blob()
    found = {}
    for name, number in vars(primitive.attributes).items():
        if number is None:
            continue
        accessor = document.accessors[number]
        view = document.bufferViews[accessor.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        array = np.frombuffer(blob, "<f4", accessor.count * width, view.byteOffset)
        found[name] = array.reshape(accessor.count, width)
    return document, primitive, found


def test_another_library_reads_what_was_written(cooling, tmp_path, caplog):
    Gltf(range_c=[20.0, 40.0]).write(cooling, tmp_path / "a.glb")
    document, primitive, found = read(tmp_path / "a.glb")
    seen, scene = cooling.seen, cooling.module.scene
    assert document.extensionsUsed == [EXTENSION] and primitive.mode == 0
    assert primitive.extensions[EXTENSION] == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    assert np.allclose(found["_TEMPERATURE"][:, 0], cooling.values, atol=1e-5)
    assert document.meshes[0].extras["unit"] == "°C" and document.meshes[0].extras["time_s"] == 600.0
    assert np.allclose(found[f"{EXTENSION}:OPACITY"][:, 0], seen.opacities)
    shown = 0.5 + C0 * found[f"{EXTENSION}:SH_DEGREE_0_COEF_0"]
    assert np.allclose(shown * 255, colorize(cooling.values[:, None], 20.0, 40.0)[:, 0], atol=1e-3)
    assert "_TIME_CONSTANT" not in found and "time_constant is not known of every Gaussian" in caplog.text
    assert all(np.isfinite(values).all() for values in found.values())
    place = place_of(scene)
    east, north, up = place(seen.means).numpy().T
    assert np.allclose(found["POSITION"], np.stack([east, up, -north], axis=1), atol=1e-5)
    assert np.allclose(document.accessors[0].min, found["POSITION"].min(0))
    quats = torch.from_numpy(np.roll(found[f"{EXTENSION}:ROTATION"], 1, axis=1)).double()
    assert np.allclose(quats.norm(dim=1), 1, atol=1e-6)
    # covariances are those of the scene, turned
    half = quats_to_matrices(quats) * torch.from_numpy(found[f"{EXTENSION}:SCALE"].astype(float))[:, None]
    own = quats_to_matrices(seen.quats.double()) * seen.scales.double()[:, None] * place.scale
    axes = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64) @ place.similarity.rotation
    assert torch.allclose(half @ half.mT, axes @ own @ own.mT @ axes.T, rtol=1e-4, atol=1e-9)


def test_programs_that_know_points_only_show_points(cooling, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    Gltf().write(cooling, tmp_path / "a.glb")
    (cloud,) = trimesh.load(str(tmp_path / "a.glb")).geometry.values()
    assert np.allclose(cloud.vertices, read(tmp_path / "a.glb")[2]["POSITION"])
    assert cloud.colors.shape == (len(cooling.values), 4) and len(np.unique(cloud.colors, axis=0)) > 10
