"""What all formats share."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from plyfile import PlyData

from heatsplat.contracts import SceneError
from heatsplat.export.formats.base import extra_columns, optional
from heatsplat.export.formats.gltf import Gltf
from heatsplat.export.formats.las import Las
from heatsplat.export.formats.mesh import Mesh
from heatsplat.export.formats.ply import Ply
from heatsplat.export.formats.spz import Spz


def test_a_missing_package_names_the_extra():
    with pytest.raises(ImportError, match=r"what=las needs nopackage: pip install 'heatsplat\[export\]'"):
        optional("nopackage.inner", "las")


def test_an_attribute_called_as_a_column_of_the_file_takes_another_name(cooling, tmp_path):
    told = {"temperature": cooling.values + 1000.0, "time constant": cooling.values}
    clashing = replace(cooling, seen=replace(cooling.seen, attributes=told))
    assert set(extra_columns(clashing)) == {"model_temperature", "time_constant"}
    Ply().write(clashing, tmp_path / "a.ply")
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    assert np.allclose(vertex["temperature"] - 273.15, cooling.values, atol=1e-3)
    assert np.allclose(vertex["model_temperature"] - vertex["temperature"], 1000.0 - 273.15, atol=1e-2)


@pytest.mark.parametrize("form", [Gltf, Las, partial(Mesh, "given.obj"), Ply, Spz])
def test_a_range_that_is_none_is_refused_before_anything_is_loaded(form):
    assert form(range_c=[10, 30]).range_c == (10.0, 30.0) and form().range_c is None
    with pytest.raises(SceneError, match="what.range_c must be a list of 2 numbers, got 30"):
        form(range_c=30)
    with pytest.raises(SceneError, match=r"what.range_c must be two increasing numbers, got \[30, 10\]"):
        form(range_c=[30, 10])


def test_an_opacity_that_is_no_number_is_named():
    with pytest.raises(SceneError, match="what.least_opacity must be a number, got abc"):
        Las(least_opacity="abc")
