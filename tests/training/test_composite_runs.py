"""What is blended where splats overlap: temperature, or what surfaces of these temperatures send."""

import mpmath
import pytest
import torch
from physics.planck_reference import band_radiance
from running import TINY, compose_run, run

from heatsplat.composition import build
from heatsplat.contracts import SceneError, ThermalRange
from heatsplat.sensors.band_composite import BandComposite
from heatsplat.sensors.base import Composite
from heatsplat.sensors.total_composite import TotalComposite

RADIANCES = {"band_radiance": BandComposite, "stefan_boltzmann": TotalComposite}
SCENE_RANGE = ThermalRange(0.0, 130.0)
SHORT = (*TINY, "max_steps=5", "method=etgs", "test=false")


class Scene:
    name = "edge"
    thermal_range = SCENE_RANGE


def prepared(name: str):
    composite = RADIANCES[name]()
    composite.prepare(Scene, "thermal")
    return composite


@pytest.mark.parametrize(
    ("name", "sent", "expected_k"),
    [("band_radiance", band_radiance, 352.16), ("stefan_boltzmann", lambda t: t**4, 354.95)],
    ids=list(RADIANCES),
)
def test_an_edge_pixel_shows_the_temperature_of_the_mean_radiance(name, sent, expected_k):
    """Half 280 K, half 400 K: 340 K where temperatures are blended."""
    edges = torch.tensor([[280.0], [400.0]], dtype=torch.float64)
    composite = prepared(name)
    carried = composite.encode(SCENE_RANGE.to_unit(edges - 273.15), 1)
    shown = SCENE_RANGE.to_celsius(composite.decode(carried.mean(0, keepdim=True), 1)).item() + 273.15
    assert shown == pytest.approx(expected_k, abs=0.01)
    with mpmath.workdps(30):
        mean = (sent(mpmath.mpf(280)) + sent(mpmath.mpf(400))) / 2
        assert abs(sent(mpmath.mpf(shown)) / mean - 1) < 1e-12


@pytest.mark.parametrize("name", RADIANCES)
def test_what_is_not_blended_comes_back_with_its_slope(name):
    values = torch.linspace(-0.2, 1.2, 29, requires_grad=True)[:, None]
    shown = prepared(name).decode(prepared(name).encode(values, 1), 1)
    assert (shown - values).abs().max() < 1e-6
    (slope,) = torch.autograd.grad(shown.sum(), values)
    assert (slope - 1).abs().max() < 1e-5


@pytest.mark.parametrize("name", RADIANCES)
def test_other_channels_pass_as_they_are(name):
    values = torch.rand(5, 4)
    composite = prepared(name)
    carried = composite.encode(values, 1)
    assert torch.equal(carried[:, 1:], values[:, 1:]) and not torch.equal(carried[:, :1], values[:, :1])
    assert torch.equal(composite.decode(carried, 1)[:, 1:], values[:, 1:])


@pytest.mark.parametrize("name", RADIANCES)
def test_values_far_outside_the_range_are_finite(name):
    values = torch.tensor([[-1e6], [-3.0], [1e6]], requires_grad=True)
    shown = prepared(name).decode(prepared(name).encode(values, 1), 1)
    shown.sum().backward()
    assert shown.isfinite().all() and values.grad.isfinite().all()


def test_blending_temperatures_returns_the_very_tensors():
    values = torch.rand(3, 1)
    assert Composite().encode(values, 1) is values and Composite().decode(values, 1) is values


@pytest.mark.parametrize("name", RADIANCES)
def test_a_scene_without_temperatures_is_refused(name):
    scene = Scene()
    scene.thermal_range = None
    with pytest.raises(SceneError, match="does not say which temperatures.*composite=temperature"):
        RADIANCES[name]().prepare(scene, "thermal")
    with pytest.raises(SceneError, match="explains rgb images"):
        RADIANCES[name]().prepare(Scene, "rgb")


def test_a_run_blends_what_it_is_told(tmp_path):
    module, _ = run(tmp_path, *SHORT, "composite=band_radiance")
    assert type(module.composite) is BandComposite
    frame = module.scene.train.frames[0]
    found = module.predict(frame)
    # The same splats blended as temperatures: pixels that a single surface fills hardly change, edges get colder.
    module.background.copy_(module.composite.decode(module.background, 1))
    module.composite = Composite()
    change = found - module.predict(frame)
    assert found.isfinite().all() and change.min() > -1e-4 and 1e-4 < change.max() < 0.5


def test_the_default_is_that_of_a_module_without_one():
    config = compose_run("method=etgs")
    assert type(build(config.composite)) is Composite
