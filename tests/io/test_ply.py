"""Splats in PLY: the layout that viewers of 3DGS read, and nothing lost on the way."""

import numpy as np
import pytest
import torch
from plyfile import PlyData

from heatsplat.geometry.spherical_harmonics import C0
from heatsplat.io.ply import read_splats, write_splats
from heatsplat.training.rng import generator_for

STANDARD = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
SHAPE = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def splats(count=7, channels=1, rest=None):
    g = generator_for(0, 0, "ply")
    made = {
        "means": torch.randn(count, 3, generator=g),
        "log_scales": torch.randn(count, 3, generator=g),
        "quats": torch.randn(count, 4, generator=g),
        "opacity_logits": torch.randn(count, 1, generator=g),
        "values": torch.rand(count, channels, generator=g),
    }
    if rest:
        made["sh_rest"] = torch.randn(count, rest, channels, generator=g)
    return made


def test_layout_is_that_of_3dgs(tmp_path):
    made = splats(rest=15)
    assert write_splats(tmp_path / "s.ply", **made) == 7
    vertex = PlyData.read(str(tmp_path / "s.ply"))["vertex"]
    names = [prop.name for prop in vertex.properties]
    assert names == [*STANDARD, *(f"f_rest_{i}" for i in range(45)), *SHAPE]
    assert {prop.val_dtype for prop in vertex.properties} == {"f4"}
    for i in range(3):
        assert np.allclose(0.5 + C0 * vertex[f"f_dc_{i}"], made["values"][:, 0], atol=1e-6)
        assert np.array_equal(vertex[f"f_rest_{15 * i + 4}"], made["sh_rest"][:, 4, 0])  # channel by channel
    assert np.array_equal(vertex["opacity"], made["opacity_logits"][:, 0])
    assert np.array_equal(vertex["rot_0"], made["quats"][:, 0])
    assert np.array_equal(vertex["scale_2"], made["log_scales"][:, 2])


@pytest.mark.parametrize("channels", [1, 3])
def test_round_trip(tmp_path, channels):
    made = splats(channels=channels, rest=3)
    kelvin = torch.linspace(280, 330, 7)
    write_splats(tmp_path / "s.ply", **made, temperature_k=kelvin)
    back = read_splats(tmp_path / "s.ply")
    for name in ("means", "log_scales", "quats", "opacity_logits"):
        assert np.array_equal(back[name], made[name]), name
    assert np.array_equal(back["temperature_k"], kelvin)
    assert np.allclose(back["values"], made["values"].expand(7, 3), atol=1e-6)
    assert np.array_equal(back["sh_rest"], made["sh_rest"].expand(7, 3, 3))
    assert "temperature_k" not in read_splats_of(tmp_path, splats())


def read_splats_of(folder, made):
    write_splats(folder / "plain.ply", **made)
    return read_splats(folder / "plain.ply")


def test_colour_map_is_baked(tmp_path):
    from heatsplat.io.pictures import colorize

    made = splats(rest=3)
    write_splats(tmp_path / "s.ply", **made, colormap="inferno")
    back = read_splats(tmp_path / "s.ply")
    expected = colorize(made["values"], 0, 1, "inferno")[:, 0] / 255
    assert np.allclose(back["values"], expected, atol=1e-6)
    assert "sh_rest" not in back


def test_unseen_gaussians_are_left_out(tmp_path):
    made = splats()
    made["quats"][2] = 0
    assert write_splats(tmp_path / "s.ply", **made) == 6
    assert np.array_equal(read_splats(tmp_path / "s.ply")["means"][2], made["means"][3])


def test_bad_input_is_named(tmp_path):
    made = splats()
    made["log_scales"][1, 1] = float("inf")
    with pytest.raises(ValueError, match="log_scales has values that are NaN or infinite"):
        write_splats(tmp_path / "s.ply", **made)
    with pytest.raises(ValueError, match=r"quats must have shape \[7, 4\], got \[6, 4\]"):
        write_splats(tmp_path / "s.ply", **{**splats(), "quats": torch.ones(6, 4)})
    (tmp_path / "bad.ply").write_text("no ply")
    with pytest.raises(ValueError, match=r"bad\.ply is not a PLY file"):
        read_splats(tmp_path / "bad.ply")
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat ascii 1.0\nelement vertex 1\n{axes}end_header\n0 0 0\n"
    (tmp_path / "points.ply").write_text(header)
    with pytest.raises(ValueError, match="has no property scale_0, scale_1, scale_2"):
        read_splats(tmp_path / "points.ply")
