"""Grey bodies with a colour: start, formula against high precision, gradients, toggles, and what is absent when off."""

from dataclasses import replace

import mpmath
import pytest
import torch

from heatsplat.contracts import Camera, SceneError, ThermalRange
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.geometry.spherical_harmonics import C0
from heatsplat.physics.grey_body import radiance, temperature_of
from heatsplat.physics.planck import Band
from heatsplat.physics.units import KELVIN_AT_0_C, kelvin
from heatsplat.splats import Splats
from heatsplat.thermal.base import Query, Seeds
from heatsplat.thermal.radiative import ATTRIBUTES, Radiative
from heatsplat.thermal.static import Static


def model(**options):
    return Radiative(Static(sh_degree=2, channels=3, modality="rgb", sh_degree_interval=0), **options)


def seeds(count=60):
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=generator)
    return Seeds(means, 0.03 + 0.7 * torch.rand(count, 4, generator=generator), generator)


def splats_of(thermal, start, disturb=0.0, dtype=torch.float32):
    count, generator = len(start.means), torch.Generator().manual_seed(1)
    tensors = {name: part.initial for name, part in thermal.per_gaussian(start).items()}
    tensors = {name: value + disturb * torch.randn(value.shape, generator=generator) for name, value in tensors.items()}
    tensors |= {
        "means": start.means,
        "log_scales": torch.zeros(count, 3),
        "quats": torch.ones(count, 4),
        "opacity_logits": torch.zeros(count, len(thermal.opacity_channels)),
    }
    return Splats({name: tensor.to(dtype) for name, tensor in tensors.items()})


def query(ids=None):
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = torch.tensor([0.2, -0.1, 3.0])
    return Query(ids, Camera(viewmat, torch.eye(3), 8, 8))


# The formula ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_radiance_and_its_slope_against_high_precision(dtype):
    with mpmath.workdps(40):
        for value in (1e-12, 1e-6, 0.05, 0.5, 0.98, 1.0):
            temperature = torch.tensor(value, dtype=dtype, requires_grad=True)
            others = [torch.tensor(x, dtype=dtype) for x in (0.9, 1.3, 0.1, 0.2)]
            emissivity, gain, reflectance, surroundings = (mpmath.mpf(x.item()) for x in others)
            exact = mpmath.mpf(temperature.item())
            sent = radiance(others[0], temperature, *others[1:])
            sent.backward()
            eps = torch.finfo(dtype).eps
            assert sent.item() == pytest.approx(
                float(emissivity * gain * exact**4 + reflectance * surroundings), rel=8 * eps
            )
            assert temperature.grad.item() == pytest.approx(float(4 * emissivity * gain * exact**3), rel=8 * eps)


def test_temperature_is_the_inverse_and_zero_below_what_is_reflected():
    others = [torch.tensor(x, dtype=torch.float64) for x in (0.9, 1.3, 0.1, 0.2)]
    sent = torch.linspace(0.0, 1.0, 50, dtype=torch.float64)
    found = temperature_of(sent, others[0], *others[1:])
    assert torch.allclose(radiance(others[0], found, *others[1:]), sent.clamp(min=0.02), atol=1e-12)
    assert found[0] == 0


def test_emission_is_the_printed_one():
    thermal = model()
    splats = splats_of(thermal, seeds(), disturb=0.3, dtype=torch.float64)
    found = thermal.features(splats, query())
    told = thermal.attributes(splats, query())
    ahead = torch.nn.functional.normalize(splats.means - query().camera.center, dim=1)
    harmonics = torch.stack([-ahead[:, 1], ahead[:, 2], -ahead[:, 0]], dim=1)
    raw = C0 * splats["temperature"][:, 0, 0] + 0.4886025119029199 * (
        harmonics * splats["temperature_rest"][..., 0]
    ).sum(1)
    assert torch.allclose(told["relative_temperature"], raw.sigmoid())
    assert torch.allclose(told["reflectance"], (C0 * splats["reflectance"][:, 0, 0]).sigmoid())  # degree 0
    expected = (
        told["emissivity"] * thermal.gain * told["relative_temperature"] ** 4
        + told["reflectance"] * thermal.surroundings
    )
    assert torch.allclose(found[:, 0], expected.clamp(0, 1))
    assert torch.equal(found[:, 1:], thermal.color.features(splats, query()))


# Start ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, {"three_parameter": False}, {"reflectance": "kirchhoff"}])
def test_emission_starts_at_the_seed_values(options):
    thermal, start = model(**options), seeds()
    emitted = thermal.features(splats_of(thermal, start), query())
    assert torch.allclose(emitted, start.values, atol=2e-5)


@pytest.mark.parametrize("reflectance", ["free", "kirchhoff"])
def test_bright_seeds_start_as_bright_as_they_are(reflectance):
    """With a gain of 1 nothing could start above 0.85, as T stays below 0.98."""
    start = Seeds(torch.randn(5, 3), torch.linspace(0.8, 1.0, 5)[:, None].expand(5, 4), torch.Generator())
    for gain, brightest in ((None, 1.0), (1.0, 0.8 + 0.1)):
        thermal = model(gain=gain, reflectance=reflectance)
        splats = splats_of(thermal, start)
        emitted = thermal.features(splats, query())[:, 0]
        assert emitted.max() <= brightest + 1e-5
        assert torch.allclose(emitted, start.values[:, 0], atol=1e-5) == (gain is None)
        assert thermal.attributes(splats, query())["relative_temperature"].max() <= 0.98 + 1e-5


def test_a_dark_seed_starts_warm_enough_to_learn():
    """T⁴ has no slope at T = 0: a black seed that started there would never light up."""
    thermal = model()
    start = Seeds(torch.randn(5, 3), torch.zeros(5, 4), torch.Generator())
    splats = splats_of(thermal, start)
    thermal.features(splats, query())[:, 0].sum().backward()
    assert thermal.attributes(splats, query())["relative_temperature"].min() > 0.049
    assert splats["temperature"].grad.abs().min() > 1e-6


@pytest.mark.parametrize("logit", [-400.0, -80.0, 0.0, 80.0, 400.0])
def test_saturated_attributes_stay_finite(logit):
    thermal = model()
    splats = splats_of(thermal, seeds())
    with torch.no_grad():
        for name in ATTRIBUTES:
            splats.raw[name].fill_(logit)
    emitted = thermal.features(splats, query())
    emitted.sum().backward()
    assert emitted.isfinite().all() and emitted[:, 0].min() >= 0 and emitted[:, 0].max() <= 1
    assert all(parameter.grad is None or parameter.grad.isfinite().all() for parameter in splats.parameters())


# Gradients and the Gaussians in view ----------------------------------------------------------------


@pytest.mark.parametrize("some", [False, True])
def test_float32_agrees_with_float64(some):
    """float32 takes the fused kernel, float64 plain torch."""
    start, results = seeds(200), []
    ids = torch.arange(0, 200, 3) if some else None
    for dtype in (torch.float32, torch.float64):
        thermal = model().to(dtype)
        splats = splats_of(thermal, start, disturb=0.3, dtype=dtype)
        emitted = thermal.features(splats, query(ids))
        (emitted * torch.linspace(-1, 1, emitted.numel(), dtype=dtype).view_as(emitted)).sum().backward()
        tensors = {name: splats[name].grad for name in splats.names if splats[name].grad is not None}
        tensors |= {name: parameter.grad for name, parameter in thermal.named_parameters()}
        results.append(tensors | {"": emitted.detach()})
    assert results[0].keys() == results[1].keys() >= {*ATTRIBUTES, "means", "sh_rest", "raw_gain", "raw_surroundings"}
    for name, expected in results[1].items():
        assert torch.allclose(results[0][name].double(), expected, atol=2e-5 * max(1.0, expected.abs().max())), name


def test_only_gaussians_in_view_are_evaluated():
    thermal = model()
    splats, ids = splats_of(thermal, seeds(), disturb=0.3), torch.tensor([7, 3, 50])
    emitted = thermal.features(splats, query(ids))
    assert torch.allclose(emitted, thermal.features(splats, query())[ids])
    emitted.sum().backward()
    for name in (*ATTRIBUTES, "emissivity_rest", "sh0"):
        touched = splats[name].grad.flatten(1).abs().sum(1).nonzero().squeeze(1).tolist()
        assert touched == [3, 7, 50], name
    told = thermal.attributes(splats, query(ids))
    assert list(told) == ["emissivity", "relative_temperature", "reflectance"]
    assert all(values.shape == (3,) for values in told.values())


@pytest.mark.parametrize(
    ("clip", "shown", "slope"), [("straight_through", 1, True), ("hard", 1, False), ("none", 2, True)]
)
def test_emission_above_one(clip, shown, slope):
    thermal = model(clip=clip, gain=3.0)
    splats = splats_of(thermal, seeds(3))
    with torch.no_grad():
        for name in ATTRIBUTES:
            splats.raw[name].fill_(10.0)
    emitted = thermal.features(splats, query())[:, 0]
    emitted.sum().backward()
    assert (emitted == 1).all() if shown == 1 else (emitted > shown).all()
    assert (splats["temperature"].grad.abs().sum() > 0) == slope


# Toggles --------------------------------------------------------------------------------------------


def test_without_three_parameters_there_are_none():
    thermal = model(three_parameter=False)
    splats = splats_of(thermal, seeds(), disturb=0.1)
    assert [name for name in splats.names if name.split("_")[0] in ATTRIBUTES] == []
    assert {"radiance", "radiance_rest"} <= set(splats.names)
    assert list(thermal.parameters()) == []
    assert thermal.attributes(splats, query()) == {}
    assert not {"radiation", "reflection"} & set(thermal.effects())
    assert thermal.cost < model().cost


def test_opacities_are_two_or_one():
    assert (model().modality_channels, model().opacity_channels) == ((1, 3), (1, 3))
    single = model(dual_opacity=False)
    assert (single.modality_channels, single.opacity_channels) == ((1, 3), (4,))
    assert "thermal_opacity" in model().effects() and "thermal_opacity" not in single.effects()


def test_kirchhoff_leaves_reflectance_out():
    thermal = model(reflectance="kirchhoff")
    splats = splats_of(thermal, seeds(), disturb=0.3)
    assert "reflectance" not in splats
    told = thermal.attributes(splats, query())
    assert torch.allclose(told["reflectance"] + told["emissivity"], torch.ones(60))
    assert thermal.cost < model().cost


def test_degrees_decide_which_tensors_there_are():
    flat = model(degrees=dict.fromkeys(ATTRIBUTES, 0)).per_gaussian(seeds())
    assert [name for name in flat if name.endswith("_rest")] == ["sh_rest"]
    full = model(degrees={"emissivity": 0, "temperature": 3, "reflectance": 1}).per_gaussian(seeds())
    assert full["temperature_rest"].initial.shape == (60, 15, 1) and full["reflectance_rest"].initial.shape == (
        60,
        3,
        1,
    )


def test_rates_and_the_penalty_on_colour_are_those_asked_for():
    parts = model(color_l2=0.3, lr_attributes=0.02, lr_rest=0.001, lr_attributes_end=0.5).per_gaussian(seeds())
    assert (parts["emissivity"].lr, parts["emissivity"].lr_end, parts["temperature_rest"].lr) == (0.02, 0.5, 0.001)
    assert (parts["sh_rest"].l2, parts["sh_rest"].l2_mean, parts["sh0"].l2, parts["emissivity"].l2) == (0.3, True, 0, 0)
    assert model(color_l2=0.0).per_gaussian(seeds())["sh_rest"].l2 == 0


def test_temperature_is_no_temperature_in_kelvin():
    assert model().temperature(splats_of(model(), seeds()), 0.0) is None


def test_errors():
    with pytest.raises(ValueError, match="reflectance must be one of free, kirchhoff, got 'none'"):
        model(reflectance="none")
    with pytest.raises(ValueError, match="clip must be one of straight_through, hard, none"):
        model(clip="soft")
    with pytest.raises(ValueError, match="lie between 0 and 1 and gain is positive, got 1.0"):
        model(emissivity=1.0)
    with pytest.raises(ValueError, match="degrees must name emissivity, temperature, reflectance, got emissivity"):
        model(degrees={"emissivity": 1})
    with pytest.raises(
        ValueError, match="color must explain rgb images and nothing else, got a model of thermal images"
    ):
        Radiative(Static())


# Planck's law, and surroundings that were measured ----------------------------------------------------


@pytest.fixture(scope="module")
def room():
    return Synthetic(scene="static", size="tiny", frames=3).scene


OPAQUE = {"reflectance": "kirchhoff", "law": "band", "surroundings": "measured"}


def test_a_body_sends_what_plancks_law_and_kirchhoffs_say(room):
    thermal = model(**OPAQUE)
    thermal.prepare(room)
    splats = splats_of(thermal, seeds(), disturb=0.3, dtype=torch.float64)
    told, band, bounds = thermal.attributes(splats, query()), Band(), room.thermal_range
    own, ambient = (
        band.radiance(kelvin(t))
        for t in (bounds.to_celsius(told["relative_temperature"]), torch.tensor(room.ambient_c, dtype=torch.float64))
    )
    sent = told["emissivity"] * own + (1 - told["emissivity"]) * ambient
    shown = bounds.to_unit(band.temperature(sent) - KELVIN_AT_0_C)
    assert torch.allclose(thermal.features(splats, query())[:, 0], shown.clamp(0, 1), atol=1e-6)
    assert "raw_gain" not in dict(thermal.named_parameters()) and "raw_surroundings" not in dict(
        thermal.named_parameters()
    )


def test_its_temperature_is_one_in_kelvin(room):
    thermal = model(**OPAQUE, degrees={"emissivity": 1, "temperature": 0, "reflectance": 0})
    thermal.prepare(room)
    splats = splats_of(thermal, seeds(), dtype=torch.float64)
    told = thermal.attributes(splats, query())["relative_temperature"]
    assert torch.allclose(thermal.temperature(splats, 0.0), kelvin(room.thermal_range.to_celsius(told)))


@pytest.mark.parametrize("options", [OPAQUE, {"surroundings": "measured"}, OPAQUE | {"surroundings": 0.2}])
def test_with_what_was_measured_emission_starts_at_the_seed_values(room, options):
    thermal = model(**options)
    thermal.prepare(room)
    start = seeds()
    emitted = thermal.features(splats_of(thermal, start), query())
    bright = start.values[:, 0] > 0.15  # more than what is mirrored already
    assert torch.allclose(emitted[bright], start.values[bright], atol=2e-5)


def test_measured_surroundings_need_a_measurement(room):
    with pytest.raises(SceneError, match="thermal.surroundings=measured needs the ambient temperature"):
        model(surroundings="measured").prepare(replace(room, ambient_c=None))


def test_surroundings_that_are_mirrored_white_leave_no_gain(room):
    """A narrow range far below the room: ρ L above 1 had made the gain, and with it all emission, NaN."""
    narrow = replace(room, thermal_range=ThermalRange(20.0, 20.5), ambient_c=26.0)
    with pytest.raises(SceneError, match="reflect 0.1 of surroundings at an image value of 12 are white"):
        model(surroundings="measured").prepare(narrow)
    thermal = model(surroundings="measured", gain=1.0)
    thermal.prepare(narrow)
    assert thermal.gain.item() == pytest.approx(1.0)


@pytest.mark.parametrize(("options", "gain"), [({"emissivity": 0.005}, 0.98 / (0.005 * 0.98**4)), ({"gain": 1e4}, 1e4)])
def test_bodies_that_hardly_emit_have_a_large_gain(options, gain):
    """Softplus of it is told without its exponential, which had made it infinite and slopes NaN."""
    thermal = model(**options)
    splats = splats_of(thermal, seeds())
    thermal.features(splats, query()).sum().backward()
    assert thermal.gain.item() == pytest.approx(gain, rel=1e-6)
    assert all(tensor.grad.isfinite().all() for tensor in (thermal.raw_gain, splats["temperature"]))


def test_plancks_law_is_for_opaque_bodies():
    with pytest.raises(ValueError, match="reflectance=kirchhoff"):
        model(law="band")
