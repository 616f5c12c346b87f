"""The imaging chain of PhysIR-Splat: against integrals of Planck's law, its priors' rest, and what a run finds."""

import math

import pytest
import torch
from running import TINY, run
from scipy import constants, integrate, optimize

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, ThermalRange, View, ViewSet
from heatsplat.splats import Splats
from heatsplat.thermal.attenuation import Attenuation
from heatsplat.thermal.base import Query, Seeds
from heatsplat.thermal.radiative_transfer import RadiativeTransfer
from heatsplat.thermal.static import Static

LOW, HIGH, AMBIENT = 10.0, 60.0, 20.0
CAMERA = Camera(torch.eye(4), torch.eye(3), 8, 8)


def band_radiance(kelvin):
    """Planck's law between 7.5 and 13.5 µm by quadrature."""

    def spectral(micrometres):
        wavelength = 1e-6 * micrometres
        exponent = constants.h * constants.c / (wavelength * constants.k * kelvin)
        return 2 * constants.h * constants.c**2 / wavelength**5 / math.expm1(exponent) * 1e-6

    return integrate.quad(spectral, 7.5, 13.5, epsrel=1e-12)[0]


def seen_through(surface, emissivity, surroundings, air, transmission):
    """Temperature of the black body that sends what arrives; all in °C."""
    sent = emissivity * band_radiance(surface + 273.15) + (1 - emissivity) * band_radiance(surroundings + 273.15)
    arrives = transmission * sent + (1 - transmission) * band_radiance(air + 273.15)
    return optimize.brentq(lambda t: band_radiance(t + 273.15) - arrives, -50, 150, xtol=1e-10)


def make_model(count=6, air=True, ambient=AMBIENT):
    generator = torch.Generator().manual_seed(0)
    frames = [Frame("0.png", 0, CAMERA)]
    image = torch.full((8, 8, 1), 0.5)
    views = ViewSet(frames, lambda i: View(frames[i], image))
    points = torch.randn(30, 3, generator=generator)
    scene = SceneData("yard", views, views, views, points, None, ThermalRange(LOW, HIGH), ambient)
    model = RadiativeTransfer(Static(floor=False), Attenuation(depth=0.4, moments=0) if air else None)
    model.check(scene)
    model.prepare(scene)
    means = torch.randn(count, 3, generator=generator) + torch.tensor([0.0, 0.0, 4.0])
    values = torch.linspace(0.05, 0.95, count)[:, None]
    tensors = model.per_gaussian(Seeds(means, values, generator))
    shape = {
        "log_scales": torch.zeros(count, 3),
        "quats": torch.ones(count, 4),
        "opacity_logits": torch.zeros(count, 1),
    }
    return model, Splats({name: part.initial for name, part in tensors.items()} | {"means": means} | shape), tensors


def test_the_chain_is_that_of_plancks_law():
    model, splats, _ = make_model()
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        splats["emissivity_offset"].copy_(2.0 * torch.randn(6, generator=generator))
        splats["surroundings_offset"].copy_(0.1 * torch.randn(6, generator=generator))
    query = Query(None, CAMERA)
    told = model.attributes(splats, query)
    surfaces = model.temperature(splats, 0.0) - 273.15
    transmission = model.air.transmission(splats, query)[:, 0]
    expected = [
        seen_through(
            surfaces[i].item(), told["emissivity"][i].item(), LOW + 50 * told["surroundings"][i].item(), AMBIENT, t
        )
        for i, t in enumerate(transmission.tolist())
    ]
    assert told["emissivity"].min() > 0.85 and told["emissivity"].max() < 0.99
    found = LOW + (HIGH - LOW) * model.features(splats, query)[:, 0].detach()
    assert torch.allclose(found, torch.tensor(expected, dtype=found.dtype), atol=2e-3)


def test_it_rests_at_its_priors_and_pulls_nothing_else():
    model, splats, tensors = make_model(air=False)
    told = model.attributes(splats, Query(None, CAMERA))
    assert torch.allclose(told["emissivity"], torch.tensor(0.95), atol=1e-6)
    assert torch.allclose(told["surroundings"], torch.tensor((AMBIENT - LOW) / (HIGH - LOW)), atol=1e-6)
    assert {name for name, part in tensors.items() if part.l2 > 0} == {"emissivity_offset", "surroundings_offset"}
    assert list(model.parameters()) == []  # no air: nothing of the scene is learned
    unknown, splats, _ = make_model(ambient=None)
    assert unknown.attributes(splats, Query(None, CAMERA))["surroundings"][0].item() == pytest.approx(0.14, abs=1e-3)


def test_values_far_outside_the_range_stay_finite_and_come_back():
    model, splats, _ = make_model()
    with torch.no_grad():
        splats["sh0"].copy_(torch.tensor([-40.0, -3.0, 0.0, 3.0, 40.0, 1e6])[:, None, None])
    seen = model.features(splats, Query(None, CAMERA))
    (gradient,) = torch.autograd.grad(seen.sum(), splats["sh0"])
    assert torch.isfinite(seen).all() and torch.isfinite(gradient).all() and (gradient > 0).all()


@pytest.mark.parametrize(
    "bad",
    [{"emissivity": 1.2}, {"bounds": (0.96, 0.99)}, {"clip": "soft"}, {"band": []}, {"band": [7.5]}, {"bounds": []}],
)
def test_what_cannot_be_is_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        RadiativeTransfer(Static(), **bad)


def test_a_run_learns_and_its_response_never_falls(tmp_path):
    module, _ = run(tmp_path, *TINY, "method=physir", "data.scene=fog", "max_steps=60", "test=false")
    assert (module.sensor.parts["response"].rises.softmax(0) > 0).all()
    assert module.thermal.air.extinction() > 0


def test_a_range_that_kelvin_in_float32_do_not_resolve_is_refused():
    views = ViewSet([Frame("0.png", 0, CAMERA)], lambda i: None)
    narrow = SceneData("yard", views, views, views, torch.zeros(1, 3), None, ThermalRange(15.0, 15.0 + 1e-9))
    with pytest.raises(SceneError, match=r"RadiativeTransfer\s+computes in kelvin"):
        RadiativeTransfer(Static(floor=False)).check(narrow)
