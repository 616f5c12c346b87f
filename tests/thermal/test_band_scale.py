"""Roots of radiance over image values: against Planck's law itself, over narrow and wide ranges, and back."""

import pytest
import torch

from heatsplat.contracts import SceneError, ThermalRange
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.physics.planck import Band
from heatsplat.physics.units import kelvin
from heatsplat.thermal.band_scale import BandScale


class Known:
    def __init__(self, low, high, ambient=None):
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


@pytest.mark.parametrize(
    ("low", "high", "margin", "band", "degree"),
    [
        (23.0, 63.0, 0.25, (7.5, 13.5), 12),
        (0.0, 100.0, 0.25, (3.0, 5.0), 12),
        (-40.0, 560.0, 0.25, (7.5, 13.5), 16),
        (-20.0, 350.0, 0.25, (3.0, 5.0), 16),
        (0.0, 2000.0, 0.25, (3.0, 5.0), 20),
        (0.0, 2000.0, 0.25, (7.5, 14.0), 16),
        (300.0, 1500.0, 0.25, (0.9, 1.7), 16),
    ],
)
def test_curves_are_as_exact_and_of_as_low_a_degree_in_any_band_and_range(low, high, margin, band, degree):
    scale, law = BandScale(*band, margin=margin), Band(*band)
    scale.prepare(Known(low, high))
    assert max(len(scale.of_values), len(scale.of_roots)) == degree + 1
    values = torch.linspace(*scale.values.tolist(), 2003, dtype=torch.float64, requires_grad=True)
    temperatures = kelvin(low + (high - low) * values)
    exact = (law.radiance(temperatures) / law.radiance(torch.tensor([kelvin(high)], dtype=torch.float64))) ** 0.25
    (slopes,) = torch.autograd.grad(exact.sum(), values)
    roots = scale.root_of(values)
    assert ((roots - exact) / slopes).abs().max() < 1e-7
    assert (scale.value_of(exact) - values).abs().max() < 1e-7
    (own,) = torch.autograd.grad(roots.sum(), values)
    assert ((own - slopes) / slopes).abs().max() < 1e-4
    single = values.detach().float()
    assert (scale.value_of(scale.root_of(single)) - single).abs().max() < 5e-6


@pytest.mark.parametrize(("low", "high", "band"), [(0.0, 2000.0, (0.9, 1.7)), (0.0, 100.0, (0.01, 0.02))])
def test_a_range_that_no_curve_follows_is_refused_by_name(low, high, band):
    with pytest.raises(
        SceneError, match=rf"band of {band[0]} to {band[1]} µm from .* to .* °C, the range of scene 'known'"
    ):
        BandScale(*band, margin=0.25).prepare(Known(low, high))


def test_float32_loses_no_more_than_its_digits():
    scale = BandScale()
    scale.prepare(Known(23.0, 63.0, 22.0))
    values = torch.linspace(0.0, 1.0, 200)
    assert (scale.value_of(scale.root_of(values)) - values).abs().max() < 5e-6


def test_a_scene_without_temperatures_is_told_what_to_do():
    with pytest.raises(SceneError, match=r"thermal.law=grey"):
        BandScale().prepare(Known(None, None, None))


@pytest.mark.parametrize("wide", [False, True])
def test_curves_travel_with_the_model(wide):
    fitted, other = BandScale(), BandScale()
    fitted.prepare(Known(-100.0, 2000.0) if wide else Synthetic(scene="static", size="tiny", frames=3).scene)
    other.load_state_dict(fitted.state_dict())
    values = torch.rand(9, dtype=torch.float64)
    assert torch.equal(fitted.root_of(values), other.root_of(values))
    assert torch.equal(fitted.value_of(values), other.value_of(values))
