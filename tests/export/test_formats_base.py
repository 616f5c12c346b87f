"""What all formats share."""

from dataclasses import replace

import numpy as np
import pytest
from plyfile import PlyData

from heatsplat.export.formats.base import extra_columns, optional
from heatsplat.export.formats.ply import Ply


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
