"""Roots of radiance over image values: against Planck's law itself, over narrow and wide ranges, and back."""

import pytest
import torch

from heatsplat.contracts import SceneError, ThermalRange
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.physics.planck import Band
from heatsplat.physics.units import kelvin
from heatsplat.thermal.band_scale import BandScale


class Known:
    def __init__(self, low, high, ambient):
        self.name, self.ambient_c = "known", ambient
        self.thermal_range = None if low is None else ThermalRange(low, high)


@pytest.mark.parametrize(("low", "high", "ambient"), [(20.0, 21.0, None), (23.0, 63.0, 22.0), (-40.0, 560.0, 20.0)])
def test_roots_are_those_of_plancks_radiance_and_come_back(low, high, ambient):
    scale, band = BandScale(), Band()
    scale.prepare(Known(low, high, ambient))
    values = torch.linspace(0.0, 1.0, 501, dtype=torch.float64)
    sent = band.radiance(kelvin(low + (high - low) * values))
    roots = scale.root_of(values)
    assert torch.allclose(roots, (sent / sent[-1]) ** 0.25, atol=2e-7, rtol=0)
    assert torch.allclose(scale.value_of(roots), values, atol=5e-7, rtol=0)
    if ambient is not None:
        there = torch.tensor((ambient - low) / (high - low), dtype=torch.float64)
        exact = (band.radiance(torch.tensor(kelvin(ambient), dtype=torch.float64)) / sent[-1]) ** 0.25
        assert scale.root_of(there).item() == pytest.approx(exact.item(), abs=2e-7)


def test_float32_loses_no_more_than_its_digits():
    scale = BandScale()
    scale.prepare(Known(23.0, 63.0, 22.0))
    values = torch.linspace(0.0, 1.0, 200)
    assert (scale.value_of(scale.root_of(values)) - values).abs().max() < 5e-6


def test_a_scene_without_temperatures_is_told_what_to_do():
    with pytest.raises(SceneError, match=r"thermal.law=grey"):
        BandScale().prepare(Known(None, None, None))


def test_curves_travel_with_the_model():
    fitted, other = BandScale(), BandScale()
    fitted.prepare(Synthetic(scene="static", size="tiny", frames=3).scene)
    other.load_state_dict(fitted.state_dict())
    values = torch.rand(9, dtype=torch.float64)
    assert torch.equal(fitted.root_of(values), other.root_of(values))
