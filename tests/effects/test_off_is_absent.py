"""Off is absent, for every effect: no parameter, no buffer, no operator, and the very image of a model that never had it.

Each effect is switched off on a ground of others through ``assembly.assemble``. Beside it stands a model of the plain classes,
put together here by hand. What both hold, what torch records of a forward and backward pass from heat to recorded image,
the image and all gradients must be the same. With the effect on, the same comparison must fail.
"""

import math
import zlib
from collections import Counter
from dataclasses import dataclass, replace
from functools import cache, cached_property

import pytest
import torch
from omegaconf import OmegaConf
from running import compose_run
from torch.profiler import ProfilerActivity, profile
from weathered import HOUR_S, make_weather

from heatsplat.composition import build
from heatsplat.contracts import Camera, Frame, SceneData, ThermalRange, ViewSet
from heatsplat.effects import assembly
from heatsplat.effects.base import Verdict
from heatsplat.geometry.resampling import resampled
from heatsplat.physics import fused
from heatsplat.physics.responses import grid_position, interpolate
from heatsplat.physics.surfaces import power_excess
from heatsplat.physics.units import celsius
from heatsplat.renderers.settings import Renderer
from heatsplat.sensors import calibration
from heatsplat.sensors.agc import GainControl
from heatsplat.sensors.calibration import Calibration
from heatsplat.sensors.frame_offset import FrameOffset
from heatsplat.sensors.point_spread import PointSpread
from heatsplat.splats import Splats
from heatsplat.thermal.attenuation import Attenuation
from heatsplat.thermal.base import Query, Seeds
from heatsplat.thermal.clipping import clipped
from heatsplat.thermal.conduction import Conducting
from heatsplat.thermal.energy_balance import EnergyBalance
from heatsplat.thermal.newton_harmonic import NewtonHarmonic
from heatsplat.thermal.reflection import Reflection
from heatsplat.thermal.static import Static
from heatsplat.thermal.view_dependence import ViewDependence
from heatsplat.training.resolution import rendered

COUNT, HEIGHT, WIDTH = 60, 12, 16
SHOWN = 2  # the training frame that is rendered


# The scene ------------------------------------------------------------------------------------------------


def camera(x):
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3], viewmat[2, 3] = -x, 4.0
    K = torch.tensor([[14.0, 0, WIDTH / 2], [0, 14.0, HEIGHT / 2], [0, 0, 1]])
    return Camera(viewmat, K, WIDTH, HEIGHT)


@cache
def scene():
    """A yard under a sky for nine hours, with everything that an effect may ask of a scene."""
    frames = [Frame(f"{i}.png", i, camera(0.2 * i), 1.5 * HOUR_S * i) for i in range(7)]
    views = ViewSet(frames, lambda i: None)
    bounds = ThermalRange(0.0, 50.0)
    return SceneData(
        "yard", views, views, views, seeds(1).means, None, bounds, 18.0, metres_per_unit=1.0, weather=make_weather()
    )


def seeds(channels):
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(COUNT, 3, generator=generator)
    return Seeds(means, 0.2 + 0.6 * torch.rand(COUNT, channels, generator=generator), generator)


def drawn(name, shape):
    """Random numbers that a tensor of this name gets in whatever model it stands."""
    generator = torch.Generator().manual_seed(zlib.crc32(name.encode()))
    return torch.randn(shape, generator=generator)


# A model in both forms ------------------------------------------------------------------------------------


class Built:
    """What assembly builds."""

    def __init__(self, found):
        self.thermal, self.sensor = build(found["thermal"]), build(found["sensor"])
        self.thermal.prepare(scene())
        self.sensor.prepare(scene())
        self.modules = {"thermal": self.thermal, "sensor": self.sensor}
        self.channels, self.opacities = self.thermal.modality_channels, self.thermal.opacity_channels
        self.declared = self.thermal.per_gaussian(seeds(sum(self.channels)))
        self.needs_depth = self.sensor.needs_depth
        self.grid = found.get("grid", {}).get("pixel_area")
        for part in self.sensor.parts.values():
            if part.needs_depth:
                part.twists *= 1e5  # a camera that takes hours for its way blurs nothing

    def seen_by(self, frame):
        return replace(frame, camera=rendered(frame.camera, self.grid["factor"])) if self.grid else frame

    def features(self, splats, query):
        return self.thermal.features(splats, query)

    def recorded(self, image, frame, depth):
        image = self.sensor(image, frame, depth)
        return resampled(image, HEIGHT, WIDTH, self.grid["kernel"] or "area") if self.grid else image

    def regularisers(self, splats):
        return [*self.thermal.regularisers(splats).values(), *self.sensor.regularisers().values()]


class ByHand:
    """A state, parts on the way and parts of the camera, put one after the other."""

    channels = opacities = (1,)
    needs_depth = False

    def __init__(self, state, parts=None, chain=None):
        self.state, self.parts, self.chain = state, parts or {}, chain or {}
        self.modules = {"thermal.state": state}
        self.modules |= {f"thermal.parts.{name}": part for name, part in self.parts.items()}
        self.modules |= {f"sensor.parts.{name}": part for name, part in self.chain.items()}
        for module in self.modules.values():
            module.prepare(scene())
        self.declared = state.per_gaussian(seeds(1))
        for part in self.parts.values():
            self.declared |= part.per_gaussian(seeds(1))

    def features(self, splats, query):
        values = self.state.features(splats, query)
        for part in self.parts.values():
            values = part(values, splats, query)
        return clipped(values, "straight_through") if self.parts else values

    def seen_by(self, frame):
        return frame

    def recorded(self, image, frame, depth):
        for part in self.chain.values():
            image = part(image, frame)
        return image

    def regularisers(self, splats):
        terms = [*self.state.regularisers(splats).values()]
        for part in self.parts.values():
            terms += part.regularisers(splats).values()
        terms += [part.regulariser() for part in self.chain.values()]
        return [term for term in terms if term is not None]


class Run:
    """A model with its splats, every number of it moved away from where it starts."""

    def __init__(self, model):
        self.model = model
        tensors = {
            "means": seeds(1).means,
            "log_scales": -1.5 + 0.3 * drawn("log_scales", (COUNT, 3)),
            "quats": drawn("quats", (COUNT, 4)),
            "opacity_logits": drawn("opacity", (COUNT, 1)).expand(-1, len(model.opacities)),
        }
        for name, item in model.declared.items():
            tensors[name] = item.initial + 0.3 * drawn(name, item.initial.shape)
        self.splats = Splats(tensors)
        with torch.no_grad():
            for name, parameter in self.parameters().items():
                if not name.startswith("splats."):
                    parameter += 0.3 * drawn(name, parameter.shape).to(parameter)

    def parameters(self):
        found = {f"splats.{name}": self.splats[name] for name in self.splats.names}
        for prefix, module in self.model.modules.items():
            found |= {f"{prefix}.{name}": parameter for name, parameter in module.named_parameters()}
        return found

    def held(self):
        """Shapes and types of parameters, buffers and tensors of the Gaussians, by name."""
        found = self.parameters() | {f"splats.{name}": buffer for name, buffer in self.splats.named_buffers()}
        for prefix, module in self.model.modules.items():
            found |= {f"{prefix}.{name}": buffer for name, buffer in module.named_buffers()}
        return {name: (tuple(tensor.shape), tensor.dtype) for name, tensor in found.items()}

    def numbers(self):
        return sum(math.prod(shape) for shape, _ in self.held().values())

    def image(self):
        splats, model = self.splats, self.model
        frame = model.seen_by(scene().train.frames[SHOWN])

        def emitted(ids):
            return model.features(splats, Query(ids, frame.camera, frame.time_s, frame.frame_id))

        behind = torch.full((sum(model.channels),), 0.3)
        shown = Renderer("cpu")(
            *(
                splats.means,
                splats.quats,
                splats.scales,
                splats.opacities,
                emitted,
                frame.camera,
                behind,
                model.opacities,
            ),
            depth=model.needs_depth,
        )
        image, *companions = shown.features.split(model.channels, dim=-1)
        return torch.cat((model.recorded(image, frame, shown.seen_depth), *companions), dim=-1)

    def backward(self):
        """The recorded image, after a backward pass from it and from all regularisers."""
        for parameter in self.parameters().values():
            parameter.grad = None
        image = self.image()
        (image.square().sum() + sum(self.model.regularisers(self.splats))).backward()
        return image.detach()

    @cached_property
    def shown(self):
        """The recorded image; gradients are there from now on."""
        return self.backward()

    @cached_property
    def operators(self):
        """How often each operator runs in a forward and backward pass."""
        assert self.shown.isfinite().all()  # tables, graphs and kernels are made once
        return counted(self.backward)


def counted(work):
    with profile(activities=[ProfilerActivity.CPU]) as seen:
        work()
    return Counter(event.name() for event in seen.profiler.kineto_results.events())  # seen.events() takes twice as long


def operators(work):
    work()
    return counted(work)


# The effects ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """An effect, others that stay on, the same without it by hand, and what of it must not be found anywhere.

    Args:
        others: effects that are on with it and without it.
        by_hand: makes the model without it.
        traces: names of its tensors; one that ends in a point is of a module.
    """

    others: tuple[str, ...]
    by_hand: object
    traces: tuple[str, ...]


def air(**on):
    return EnergyBalance(**{"sun": False, "sky": None, "wind": False, **on})


def open_air(**on):
    return air(clip="none", **on)


PATTERN, FALLOFF = {"vignetting_max": 0.0}, {"gain_max": 0.0, "bias_max": 0.0}
CASES = {
    "relaxation": Case(
        ("attenuation",),
        lambda: ByHand(Static(floor=False), {"attenuation": Attenuation(moments=12)}),
        ("initial_state", "log_rate", "ambient"),
    ),
    "harmonic_source": Case(
        ("relaxation", "conduction"),
        lambda: ByHand(Conducting(NewtonHarmonic(frequencies=0), neighbours=6)),
        ("source_gains",),
    ),
    "solar": Case(
        ("relaxation", "radiation", "frame_offset"),
        lambda: ByHand(air(sky="auto"), chain={"frame_offset": FrameOffset()}),
        ("raw_sun", "normals"),
    ),
    "semi_infinite": Case(("relaxation", "solar"), lambda: ByHand(air(sun=True)), ()),
    "radiation": Case(
        ("relaxation", "solar", "reflection"),
        lambda: ByHand(open_air(sun=True), {"reflection": Reflection(degree=2)}),
        ("raw_share",),
    ),
    "convection": Case(
        ("relaxation", "solar", "radiation"),
        lambda: ByHand(air(sun=True, sky="auto")),
        ("raw_wind", "mean_wind"),
    ),
    "shadows": Case(
        ("relaxation", "solar", "radiation", "convection"),
        lambda: ByHand(air(sun=True, sky="auto", wind=True)),
        ("sun_seen",),
    ),
    "sky_view": Case(
        ("relaxation", "solar", "radiation", "convection", "shadows"),
        lambda: ByHand(air(sun=True, sky="auto", wind=True, shadows=True)),
        ("sky_seen",),
    ),
    "albedo": Case(  # all that stands around, of which the march has a kernel anyway
        ("relaxation", "solar", "radiation", "convection", "shadows"),
        lambda: ByHand(air(sun=True, sky="auto", wind=True, shadows=True)),
        (),
    ),
    "conduction": Case(
        ("relaxation", "harmonic_source"),
        lambda: ByHand(NewtonHarmonic(frequencies=24)),
        ("log_flow", "edges", "joined"),
    ),
    "directional_emissivity": Case(
        ("relaxation", "attenuation"),
        lambda: ByHand(NewtonHarmonic(frequencies=0, clip="none"), {"attenuation": Attenuation(moments=12)}),
        ("falloff_logit", "directional_emissivity.", "normals", "normal_tilt"),
    ),
    "view_dependence": Case(
        ("attenuation",),
        lambda: ByHand(Static(floor=False), {"attenuation": Attenuation(moments=12)}),
        ("view_rest",),
    ),
    "reflection": Case(
        ("relaxation", "view_dependence"),
        lambda: ByHand(
            NewtonHarmonic(frequencies=0, clip="none"),
            {"view_dependence": ViewDependence(sh_degree=2, sh_degree_interval=0)},
        ),
        ("reflectance_logit", "surroundings", "reflection."),
    ),
    "mirrored_sky": Case(
        ("relaxation", "solar", "reflection"),
        lambda: ByHand(open_air(sun=True), {"reflection": Reflection(degree=2)}),
        ("sky_reflectance_logit", "mirrored_sky."),
    ),
    "attenuation": Case(
        ("reflection", "agc"),
        lambda: ByHand(Static(floor=False), {"reflection": Reflection(degree=2)}, {"agc": GainControl()}),
        ("attenuation.", "log_depth"),
    ),
    "thermal_opacity": Case(
        ("relaxation", "vignetting"),
        lambda: ByHand(NewtonHarmonic(frequencies=0), chain={"calibration": Calibration(**FALLOFF)}),
        ("companion.", "companion_sh0", "companion_sh_rest"),
    ),
    "frame_offset": Case(
        ("relaxation", "point_spread"),
        lambda: ByHand(NewtonHarmonic(frequencies=0), chain={"point_spread": PointSpread()}),
        ("frame_offset.", "raw_offset"),
    ),
    "agc": Case(
        ("frame_offset",),
        lambda: ByHand(Static(), chain={"frame_offset": FrameOffset(gain_max=0.0)}),
        ("agc.",),
    ),
    "fixed_pattern": Case(
        ("vignetting",),
        lambda: ByHand(Static(), chain={"calibration": Calibration(**FALLOFF)}),
        ("raw_gain", "raw_bias", "shared"),
    ),
    "vignetting": Case(
        ("relaxation", "fixed_pattern"),
        lambda: ByHand(NewtonHarmonic(frequencies=0), chain={"calibration": Calibration(**PATTERN)}),
        ("raw_falloff",),
    ),
    "tone": Case(
        ("agc",),
        lambda: ByHand(Static(), chain={"agc": GainControl()}),
        ("tone.", "levels"),
    ),
    "point_spread": Case(
        ("fixed_pattern", "vignetting", "agc"),
        lambda: ByHand(Static(), chain={"calibration": Calibration(), "agc": GainControl()}),
        ("point_spread.", "raw_spread"),
    ),
    "thermal_lag": Case(
        ("point_spread", "frame_offset"),
        lambda: ByHand(Static(), chain={"point_spread": PointSpread(), "frame_offset": FrameOffset()}),
        ("thermal_lag.", "twists", "raw_tau", "raw_lead"),
    ),
    "rolling_readout": Case(
        ("relaxation",),
        lambda: ByHand(NewtonHarmonic(frequencies=0)),
        ("rolling_readout.", "twists", "raw_readout"),
    ),
    "pixel_area": Case(("relaxation",), lambda: ByHand(NewtonHarmonic(frequencies=0)), ()),
}
EFFECTS = tuple(CASES)


@cache
def templates():
    plain = compose_run("method=auto", "data.size=tiny")
    return OmegaConf.to_container(plain, resolve=True)["effects"]


def assembled(*on):
    said = {"pixel_area": {"factor": 2}}
    verdicts = {
        name: Verdict(name, name in on, None, None, "as the test says", said.get(name, {})) for name in assembly.NAMES
    }
    return assembly.assemble(verdicts, templates())


@cache
def switched_off(name):
    return Run(Built(assembled(*CASES[name].others)))


@cache
def by_hand(name):
    return Run(CASES[name].by_hand())


@cache
def switched_on(name):
    return Run(Built(assembled(*CASES[name].others, name)))


def traced(run, trace):
    """Names of tensors of a run that belong to what ``trace`` names."""
    return [name for name in run.held() if f".{trace}" in f".{name}." and (trace[-1] == "." or name.endswith(trace))]


def test_every_effect_of_the_catalogue_is_proven():
    from heatsplat.effects.catalogue import CATALOGUE

    assert set(EFFECTS) == {effect.name for effect in CATALOGUE} == set(assembly.NAMES)


@pytest.mark.parametrize("name", EFFECTS)
def test_it_holds_what_a_model_without_it_holds(name):
    off, hand = switched_off(name), by_hand(name)
    assert off.held() == hand.held()
    assert off.splats["opacity_logits"].shape == (COUNT, 1)
    for key, item in off.model.declared.items():  # with the same start and the same rates
        other = hand.model.declared[key]
        assert torch.equal(item.initial, other.initial)
        assert replace(item, initial=0) == replace(other, initial=0), key


@pytest.mark.parametrize("name", EFFECTS)
def test_nothing_of_it_is_left(name):
    for trace in CASES[name].traces:
        assert traced(switched_on(name), trace), trace  # or the next line would say nothing
        assert not traced(switched_off(name), trace)


@pytest.mark.parametrize("name", EFFECTS)
def test_the_operators_are_those_of_a_model_without_it(name):
    off, hand = switched_off(name).operators, by_hand(name).operators
    assert off == hand, (off - hand, hand - off)


@pytest.mark.parametrize("name", EFFECTS)
def test_image_and_gradients_are_those_of_a_model_without_it_to_the_last_bit(name):
    off, hand = switched_off(name), by_hand(name)
    image = off.shown
    assert torch.equal(image, hand.shown) and image.isfinite().all() and image.std() > 1e-3
    expected = hand.parameters()
    for key, parameter in off.parameters().items():
        gradient, other = parameter.grad, expected[key].grad
        assert (gradient is None) == (other is None), key
        assert gradient is None or torch.equal(gradient, other), key


@pytest.mark.parametrize("name", EFFECTS)
def test_with_it_on_all_of_that_differs(name):
    off, on = switched_off(name), switched_on(name)
    if name != "albedo":  # one more driver in the kernel that marches the balance
        assert on.operators - off.operators
    shown, without = on.shown, off.shown  # which draws a graph of neighbours, where there is one
    if CASES[name].traces:  # bodies without an end have other tables, pixels are averages: nothing to learn
        assert on.held() != off.held()
        assert on.numbers() > off.numbers()
    if name == "thermal_opacity":  # the visible image beside the thermal one, each with opacities of its own
        assert shown.shape[2] == without.shape[2] + 3 and assembled(*CASES[name].others)["loss"] == {}
        assert len(on.model.opacities) == 2 and set(assembled(name)["loss"]) == {"rgb"}
    else:
        assert (shown - without).abs().max() > 1e-3


# What two effects of one class share ------------------------------------------------------------------------
#
# Weather, pattern and falloff, and a heat source are options of classes that others need too. The model by hand above is of
# the same class with the same option, so that it could do the same needless work. Here what is left is written out, or
# what must not be called is taken away.


def refused(*_, **__):
    raise AssertionError("an effect that is off was computed")


def calibrated(**options):
    part = Calibration(**options)
    part.prepare(scene())
    return part


def used(part):
    image = torch.rand(HEIGHT, WIDTH, 1, generator=torch.Generator().manual_seed(1)).requires_grad_()
    (part(image, scene().train.frames[SHOWN]).sum() + part.regulariser()).backward()


def test_without_vignetting_nobody_asks_how_far_a_pixel_is_from_the_middle(monkeypatch):
    pattern, falloff = calibrated(**PATTERN), calibrated(**FALLOFF)
    assert {name for name, _ in pattern.named_parameters()} == {"raw_gain", "raw_bias"}
    assert pattern.shared.shape[1] == 1  # of the gain only its level is anybody else's
    monkeypatch.setattr(calibration, "radius_squared", refused)
    monkeypatch.setattr(Calibration, "coefficients", refused)
    used(pattern)
    with pytest.raises(AssertionError, match="an effect that is off"):
        used(falloff)


def test_without_a_pattern_nothing_is_spread_over_the_image(monkeypatch):
    pattern, falloff = calibrated(**PATTERN), calibrated(**FALLOFF)
    assert [name for name, _ in falloff.named_parameters()] == ["raw_falloff"] and not list(falloff.named_buffers())
    monkeypatch.setattr(calibration, "resampled", refused)
    used(falloff)
    with pytest.raises(AssertionError, match="an effect that is off"):
        used(pattern)


def test_a_drift_without_gains_is_one_addition():
    part = FrameOffset(gain_max=0.0)
    part.prepare(scene())
    image, frame = torch.rand(HEIGHT, WIDTH, 1), scene().train.frames[SHOWN]

    def plain():
        level = 0.25 * part.raw_offset.tanh()
        return image + (level - level.mean())[SHOWN]

    assert "raw_gain" not in dict(part.named_parameters())
    with torch.no_grad():
        part.raw_offset.copy_(drawn("offset", (7,)))
        assert torch.equal(part(image, frame), plain())
    seen = operators(lambda: part(image, frame).sum().backward()), operators(lambda: plain().sum().backward())
    # Whose image it is.
    looked_up = {"aten::eq", "aten::nonzero", "aten::item", "aten::_local_scalar_dense", "aten::len"}
    more = {name: count for name, count in (seen[0] - seen[1]).items() if name not in looked_up}
    assert not {"aten::mul", "aten::tanh", "aten::lerp"} & set(more), more


@pytest.mark.parametrize("frequencies", [0, 4])
def test_without_a_heat_source_no_gradient_of_gains_is_written(monkeypatch, frequencies):
    written, write = [], fused.kernels.write_gains
    monkeypatch.setattr(fused.kernels, "write_gains", lambda *arguments: (written.append(1), write(*arguments)))
    model = NewtonHarmonic(frequencies=frequencies)
    model.prepare(scene())
    run = Run(ByHand(model))
    model.features(run.splats, Query(torch.tensor([3, 8]), camera(0.0), HOUR_S)).sum().backward()
    assert run.splats["log_rate"].grad[8] != 0 == run.splats["log_rate"].grad[4]
    assert bool(written) == (frequencies > 0)


WEATHER = {  # the two other drivers, and the columns in which responses to them are looked up
    "solar": ({"sky": "auto", "wind": True}, {"air", "sky", "gusts", "gusts_air"}),
    "radiation": ({"sun": True, "wind": True}, {"air", "light", "gusts", "gusts_air"}),
    "convection": ({"sun": True, "sky": "auto"}, {"air", "light", "sky", "around"}),
}


def written_out(model, splats, query, off):
    """Features of the model, whose options are those of WEATHER[off], with its tables but only what it has to compute."""
    climate, reference, times = model.climate, model.climate.drivers.reference_k, model.climate.drivers.times_s
    sunny, radiates, windy = (off != name for name in WEATHER)

    def bounds():
        return model.range.bounds

    def between(low, high, name):
        return low + (high - low) * query.rows(splats[name]).sigmoid()

    first, last = float(times[0]), float(times[-1])
    assert first <= query.time_s <= last
    start = bounds().to_celsius(query.rows(splats["initial_state"])) - celsius(model.reference_k).item()
    log_rate = query.rows(splats["log_rate"]).clamp(math.log(1e-7), math.log(0.1))
    if sunny:
        sun, normals = between(0.0, 200.0, "raw_sun"), query.normals(splats)
    if radiates:
        share = between(0.02, 0.98, "raw_share")
    if windy:
        wind = between(0.0, 0.95, "raw_wind")

    def exchange():  # with the air, in the mean of the record
        if radiates and windy:
            return (1 - share) * (1 + wind * climate.wind_anomaly_mean)
        return 1 - share if radiates else 1 + wind * climate.wind_anomaly_mean

    def balance(values, beam, mean):
        take = {name: values[..., j] for name, j in climate.columns.items()}
        total = exchange() * take["air"]
        if sunny:
            sky = 0.5 * (1 + normals @ climate.drivers.up.to(normals))
            total = sun * (beam + sky * take["light"]) + total
        if windy:
            gusty = (1 - share) * wind if radiates else wind
            total = total + gusty * (take["gusts_air"] - mean * take["gusts"])
        if radiates:
            total = total + share * (sky * take["sky"] + (1 - sky) * take["around"] if sunny else take["sky"])
        return total

    means = climate.means.to(log_rate)
    mean_beam = climate.beam.mean(normals).to(log_rate) if sunny else None

    def newton(x):
        stiffness = exchange()
        slope = stiffness.detach() + share.detach() * (1 + x.detach() / reference) ** 3
        rest = balance(means, mean_beam, 0.0) - stiffness * x - share * power_excess(x, reference)
        return (x + rest / slope.clamp(min=0.05)).clamp(-150.0, 150.0)

    if radiates:
        with torch.no_grad():
            mean = share * 0.0
            for _ in range(5):
                mean = newton(mean)
        mean = newton(mean)
        steep = (1 + mean / reference) ** 3
        constant = share * (steep * mean - power_excess(mean, reference))
        stiffness = (exchange() + share * steep).clamp(min=0.05)
    else:
        mean, stiffness = balance(means, mean_beam, 0.0) / exchange(), exchange()
    log_rate = log_rate + stiffness.log()
    table = climate.table.at(query.time_s).to(log_rate)
    settled = interpolate(table, *grid_position(log_rate, climate.table.log_rates))
    beam = climate.beam.response(query.time_s, normals, log_rate).to(log_rate) if sunny else None
    kept = torch.exp(-log_rate.exp() * (query.time_s - float(times[0])))
    forced = balance(settled, beam, mean)
    if radiates:
        forced = forced + constant * (1 - kept)
    unit = bounds().to_unit(start * kept + forced / stiffness + celsius(model.reference_k).item())
    return clipped(unit, "straight_through")[:, None]


def under_weather(off):
    model = air(solution="linear", **WEATHER[off][0])
    run, query = Run(ByHand(model)), Query(torch.arange(0, COUNT, 2), camera(0.0), 3 * HOUR_S)
    return model, lambda: model.features(run.splats, query), lambda: written_out(model, run.splats, query, off)


@pytest.mark.parametrize("off", WEATHER)
def test_weather_that_does_not_act_is_not_looked_up(off):
    model, features, plain = under_weather(off)
    assert set(model.climate.columns) == WEATHER[off][1]
    assert (model.climate.beam is None) == (off == "solar")
    assert torch.equal(features(), plain())


@pytest.mark.parametrize("off", WEATHER)
def test_weather_that_does_not_act_is_not_computed(off):
    _, features, plain = under_weather(off)
    needless = operators(lambda: features().sum().backward()) - operators(lambda: plain().sum().backward())
    assert not needless, needless
