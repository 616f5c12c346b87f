"""ETGS's thermal model: what it learns, what it refuses, what is absent, and what a checkpoint carries."""

import io
import logging
import math

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, ThermalRange, ViewSet
from heatsplat.density.ops import Cloud
from heatsplat.physics.first_look import RELAXES, STAYS
from heatsplat.physics.relaxation import temperature
from heatsplat.splats import Splats
from heatsplat.thermal.base import PerGaussian, Query, Seeds
from heatsplat.thermal.newton_harmonic import NewtonHarmonic
from heatsplat.training.adam import OnePassAdam
from heatsplat.training.optimisation import penalties

RANGE = ThermalRange(20.0, 70.0)
SPAN_S = 400.0


def scene(times=None, thermal_range=RANGE, ambient_c=26.0):
    times = torch.linspace(0, SPAN_S, 81).tolist() if times is None else times
    camera = Camera(torch.eye(4), torch.eye(3), 4, 4)
    frames = [Frame(f"{i}.png", i, camera, time) for i, time in enumerate(times)]
    views = ViewSet(frames, lambda i: None)
    return SceneData("kettle", views, views, views, torch.zeros(4, 3), None, thermal_range, ambient_c)


def seeds(count=6):
    generator = torch.Generator().manual_seed(0)
    return Seeds(torch.randn(count, 3, generator=generator), torch.rand(count, 1, generator=generator), generator)


def splats_of(model, start, dtype=torch.float32):
    count = len(start.means)
    tensors = {"means": start.means, "log_scales": torch.zeros(count, 3), "quats": torch.ones(count, 4)}
    tensors |= {"opacity_logits": torch.zeros(count, 1)}
    tensors |= {name: item.initial for name, item in model.per_gaussian(start).items()}
    return Splats({name: tensor.to(dtype) for name, tensor in tensors.items()})


def ready(start=None, scene_data=None, dtype=torch.float32, **options):
    model = NewtonHarmonic(**options)
    model.prepare(scene_data or scene())
    return model, splats_of(model, start or seeds(), dtype)


def stir(splats, size=0.3):
    """The same splats with random thermal tensors."""
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for name in splats.names:
            tensor = splats[name]
            tensor += size * torch.randn(tensor.shape, generator=generator)
    return splats


@pytest.mark.parametrize("param", ["rate", "faithful"])
def test_it_starts_at_the_seed_values_and_relaxes_to_the_ambient(param):
    start = seeds()
    model, splats = ready(start, param=param)
    first = model.features(splats, Query(time_s=0.0))
    torch.testing.assert_close(first, start.values)
    late = model.features(splats, Query(time_s=100 * SPAN_S))
    torch.testing.assert_close(late, torch.full_like(late, (26.0 - 20.0) / 50.0))


def test_values_are_the_closed_form_in_seconds_and_celsius():
    """Undoes the normalisation by hand: rates per second, gains in °C per second."""
    model, splats = ready(dtype=torch.float64)
    stir(splats, 0.1)
    time_s = 137.0
    gains = splats["source_gains"].detach() * RANGE.span_k / SPAN_S
    expected = temperature(
        torch.tensor(time_s, dtype=torch.float64),
        torch.tensor(26.0, dtype=torch.float64),
        RANGE.to_celsius(splats["initial_state"].detach()),
        splats["log_rate"].detach().exp() / SPAN_S,
        model.omega / SPAN_S,
        gains[:, 0],
        gains[:, 1],
    )
    torch.testing.assert_close(model.temperature(splats, time_s).detach(), expected + 273.15, rtol=0, atol=1e-5)


@pytest.mark.parametrize("param", ["rate", "faithful"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_beyond_the_record_sources_are_off_and_temperatures_relax(dtype, param):
    """Half a record later a sum of sines has bodies far below the ambient temperature that were above it at the end."""
    model, splats = ready(dtype=dtype, param=param, clip="none")
    with torch.no_grad():
        splats["initial_state"].fill_(0.9)
        splats["source_gains"][:, 0, 0] = -torch.linspace(5.0, 9.0, len(splats))  # cools in the first half, then heats
        splats["source_gains"][:, 1, 0] = 4.0
        ambient, rate = model.ambient.to(dtype), model._rate(splats)
    end = model.features(splats, Query(time_s=SPAN_S))[:, 0].detach()
    assert end.min() > ambient
    for after_s in (1e-3, 60.0, SPAN_S, 100 * SPAN_S):
        value = model.features(splats, Query(time_s=SPAN_S + after_s))[:, 0]
        torch.testing.assert_close(value, ambient + (end - ambient) * torch.exp(-rate * after_s / SPAN_S))
        assert value.min() >= ambient - 1e-6
        assert not value.requires_grad  # no image shows that moment
    sines = model._recorded(splats, 1.5, None)
    assert sines.min() < ambient - 0.1
    ids = torch.tensor([4, 1])
    some = model.features(splats, Query(ids, time_s=2 * SPAN_S))
    assert torch.equal(some, model.features(splats, Query(time_s=2 * SPAN_S))[ids])


@pytest.mark.parametrize("end_s", [0.0, SPAN_S])
def test_nothing_jumps_at_the_ends_of_the_record(end_s):
    model, splats = ready(dtype=torch.float64, clip="none")
    stir(splats, 0.1)
    at = [model.features(splats, Query(time_s=end_s + step)) for step in (-1e-6, 0.0, 1e-6)]
    torch.testing.assert_close(at[0], at[1], atol=1e-6, rtol=0)
    torch.testing.assert_close(at[2], at[1], atol=1e-6, rtol=0)


def test_before_the_record_temperatures_come_from_at_most_one_time_constant_back():
    model, splats = ready(clip="none")
    with torch.no_grad():
        splats["source_gains"][:] = 3.0
        start, rate = splats["initial_state"].clone(), model._rate(splats)
    value = model.features(splats, Query(time_s=-0.1 * SPAN_S))[:, 0]
    torch.testing.assert_close(value, model.ambient + (start - model.ambient) * torch.exp(0.1 * rate))
    long_before = model.features(splats, Query(time_s=-100 * SPAN_S))[:, 0]
    torch.testing.assert_close(long_before, model.ambient + (start - model.ambient) * math.e)


def test_frequencies_span_one_cycle_to_the_half_power_point():
    model, _ = ready(tau_min_s=10.0, separation=0.0)
    assert model.omega.shape == (24,)
    assert (model.omega[0] / SPAN_S).item() == pytest.approx(2 * math.pi / SPAN_S)
    assert (model.omega[-1] / SPAN_S).item() == pytest.approx(0.1)


@pytest.mark.parametrize("frequencies", [1, 3, 24])
@pytest.mark.parametrize("param", ["rate", "faithful"])
def test_gradients_in_float32_are_those_of_float64(frequencies, param):
    found = {}
    for dtype in (torch.float32, torch.float64):
        model, splats = ready(dtype=dtype, frequencies=frequencies, param=param, ambient="learned")
        stir(splats)
        weights = torch.linspace(-1, 1, 4)
        emitted = model.features(splats, Query(torch.tensor([4, 1, 5, 0]), time_s=77.0))[:, 0]
        (emitted * weights).sum().backward()
        names = set(splats.names) - {"means", "log_scales", "quats", "opacity_logits"}
        found[dtype] = {name: splats[name].grad for name in names} | {"ambient": model.ambient.grad}
    for name, exact in found[torch.float64].items():
        torch.testing.assert_close(found[torch.float32][name].double(), exact.double(), rtol=2e-5, atol=2e-6, msg=name)
        assert exact.abs().max() > 0, name


def test_rows_out_of_view_are_not_read_and_get_no_gradient():
    model, splats = ready()
    stir(splats)
    seen = torch.tensor([5, 2])
    expected = model.features(splats, Query(time_s=50.0))[seen]
    unseen = torch.tensor([0, 1, 3, 4])
    with torch.no_grad():
        splats["source_gains"][unseen] = torch.nan
        splats["initial_state"][unseen] = torch.nan
    emitted = model.features(splats, Query(seen, time_s=50.0))
    assert torch.equal(emitted, expected)
    emitted.sum().backward()
    for name in ("source_gains", "initial_state", "log_rate"):
        gradient = splats[name].grad
        assert not gradient[unseen].any(), name
        assert gradient[seen].abs().flatten(1).max(1).values.all() if gradient.ndim > 1 else gradient[seen].all(), name


def fit(model, splats, declared, observed, times_s, steps):
    groups = [
        {"params": [splats[name]], "lr": item.lr} | penalties(item, len(splats)) for name, item in declared.items()
    ]
    optimizer = OnePassAdam(groups, eps=1e-15)
    for step in range(steps):
        if step == steps // 2:
            for group in optimizer.param_groups:
                group["lr"] /= 10
        shown = step * 37 % len(times_s)
        error = model.features(splats, Query(time_s=times_s[shown]))[:, 0] - observed[shown]
        optimizer.zero_grad()
        error.square().mean().backward()
        optimizer.step()


def test_it_recovers_the_rates_of_cooling_bodies():
    start = Seeds(torch.zeros(20, 3), torch.linspace(0.5, 1, 20)[:, None], torch.Generator())
    model, splats = ready(start, frequencies=0, lr_rate=2e-2)
    rates = torch.linspace(1.0, 12.0, 20)
    times_s = torch.linspace(0, SPAN_S, 81).tolist()
    initial, ambient = start.values[:, 0], 0.12
    observed = [ambient + (initial - ambient) * torch.exp(-rates * time / SPAN_S) for time in times_s]
    fit(model, splats, model.per_gaussian(start), observed, times_s, steps=1500)
    torch.testing.assert_close(splats["log_rate"].detach().exp(), rates, rtol=0.02, atol=0)


def test_it_learns_a_driven_temperature_at_unseen_times():
    """A thermostat between two frequencies of the grid: half a degree of 50 off, and four without a source."""
    count, times_s = 12, torch.linspace(0, SPAN_S, 81).tolist()
    phase = torch.linspace(0, 3, count)
    observed = [0.5 + 0.2 * torch.sin(2 * math.pi * 3.3 * time / SPAN_S + phase) for time in times_s]
    error = {}
    for frequencies in (0, 24):
        start = Seeds(torch.zeros(count, 3), observed[0][:, None].clone(), torch.Generator())
        model, splats = ready(start, frequencies=frequencies, tau_min_s=5.0, source_penalty=0.0, lr_source=0.48)
        fit(model, splats, model.per_gaussian(start), observed[::2], times_s[::2], steps=1500)
        shown = torch.stack([model.features(splats, Query(time_s=time))[:, 0] for time in times_s[1::2]])
        error[frequencies] = (shown - torch.stack(observed[1::2])).abs().mean().item()
    assert error[24] < 0.01
    assert error[0] > 0.08


def test_without_frequencies_the_source_is_absent():
    model, splats = ready(frequencies=0)
    assert "source_gains" not in splats
    assert model.effects() == {"relaxation": {"param": "rate", "ambient": "fixed"}}
    assert model.cost < NewtonHarmonic().cost + 1
    with_source, _ = ready(frequencies=24, separation=0.0)
    assert with_source.effects()["harmonic_source"] == {"frequencies": 24}
    apart, _ = ready(frequencies=24)
    assert apart.effects()["harmonic_source"] == {"frequencies": apart.omega.numel()}
    assert apart.omega.numel() < 24
    assert with_source.cost > 10 * model.cost


def test_zero_gains_equal_no_frequencies():
    start = seeds()
    with_source, splats = ready(start)
    without, plain = ready(start, frequencies=0)
    query = Query(time_s=33.0)
    assert torch.equal(with_source.features(splats, query), without.features(plain, query))


@pytest.mark.parametrize("times", [[5.0], [3.0, 3.0, 3.0]])
def test_one_moment_leaves_relaxation_and_says_so(times, caplog):
    model, splats = ready(scene_data=scene(times))
    assert model.omega.numel() == 0
    assert "source_gains" not in splats
    assert "one moment only" in caplog.text
    assert model.features(splats, Query(time_s=3.0)).isfinite().all()


def test_a_scene_without_times_is_refused():
    model = NewtonHarmonic()
    with pytest.raises(
        SceneError, match="NewtonHarmonic needs time, which scene 'kettle' does not have .*: time by data.time_csv or"
    ):
        model.check(scene([0.0, None, 2.0]))
    with pytest.raises(SceneError, match="needs time"):
        model.check(scene([None, None]))


def test_a_query_without_time_is_refused():
    model, splats = ready()
    with pytest.raises(ValueError, match="give time_s"):
        model.features(splats, Query())


def test_a_scene_without_range_is_modelled_in_image_values(caplog):
    start = seeds()
    model, splats = ready(start, scene(thermal_range=None))
    assert "no temperature range" in caplog.text
    assert "it is learned" in caplog.text
    assert model.temperature(splats, 1.0) is None
    assert model.ambient.item() == pytest.approx(start.values.median().item())
    torch.testing.assert_close(model.features(splats, Query(time_s=0.0)), start.values)


def test_ambient_measured_learned_or_given(caplog):
    fixed, _ = ready()
    assert [*fixed.parameters()] == []
    assert fixed.ambient.item() == pytest.approx(0.12)
    given, _ = ready(ambient=45.0)
    assert given.ambient.item() == pytest.approx(0.5)
    learned, splats = ready(ambient="learned")
    assert learned.ambient.item() == pytest.approx(0.12)
    assert [*learned.parameters()] == [learned.ambient]
    learned.features(splats, Query(time_s=200.0)).sum().backward()
    assert learned.ambient.grad.item() == pytest.approx(6 * (1 - math.exp(-2)), rel=1e-5)
    assert caplog.text == ""
    missing, _ = ready(scene_data=scene(ambient_c=None))
    assert isinstance(missing.ambient, torch.nn.Parameter)
    assert "no measured ambient temperature: it is learned" in caplog.text
    with pytest.raises(SceneError, match="ambient=30.0 is in °C, but scene 'kettle' has no temperature range"):
        ready(scene_data=scene(thermal_range=None), ambient=30.0)


def test_clipping_straight_through_hard_and_none():
    start = Seeds(torch.zeros(3, 3), torch.tensor([[-0.5], [0.5], [1.5]]), torch.Generator())
    expected = {
        "straight_through": ([0.0, 0.5, 1.0], [1, 1, 1]),
        "hard": ([0.0, 0.5, 1.0], [0, 1, 0]),
        "none": ([-0.5, 0.5, 1.5], [1, 1, 1]),
    }
    for clip, (values, gradients) in expected.items():
        model, splats = ready(start, clip=clip)
        emitted = model.features(splats, Query(time_s=0.0))
        emitted.sum().backward()
        assert emitted[:, 0].tolist() == values
        assert splats["initial_state"].grad.tolist() == gradients


def test_faithful_form_has_a_gauge_that_only_its_prior_sees():
    """C, h, A and B times a factor: the same image, a smaller penalty on A and B; only the prior on C holds it."""
    model, splats = ready(param="faithful", dtype=torch.float64, penalty="ridge")
    stir(splats)
    query = Query(time_s=91.0)
    before = model.features(splats, query)
    factor = 0.1
    with torch.no_grad():
        splats["log_capacity"].add_(math.log(factor))
        splats["log_conductance"].add_(math.log(factor))
        splats["source_gains"].mul_(factor)
    torch.testing.assert_close(model.features(splats, query), before, rtol=1e-12, atol=1e-12)
    declared = model.per_gaussian(seeds())
    assert declared["log_capacity"].l2 > 0
    assert declared["source_gains"].l2 > 0
    assert declared["log_conductance"].l2 == declared["initial_state"].l2 == 0


def test_faithful_and_rate_form_agree():
    faithful, splats = ready(param="faithful", dtype=torch.float64)
    stir(splats)
    rate, same = ready(dtype=torch.float64)
    capacity = splats["log_capacity"].detach().exp()
    with torch.no_grad():
        same["initial_state"].copy_(splats["initial_state"])
        same["log_rate"].copy_(splats["log_conductance"] - splats["log_capacity"])
        same["source_gains"].copy_(splats["source_gains"] / capacity[:, None, None])
    torch.testing.assert_close(faithful.temperature(splats, 60.0), rate.temperature(same, 60.0), rtol=1e-12, atol=0)


def test_squares_are_penalised_in_the_optimiser_as_a_sum_or_a_mean():
    summed, meant = (
        ready(penalty="ridge", source_penalty=1e-5, penalty_reduction=reduction)
        for reduction in ("sum", "mean_over_gaussians")
    )
    declared = [model.per_gaussian(seeds())["source_gains"] for model, _ in (summed, meant)]
    assert [(item.l2, item.l2_mean) for item in declared] == [(1e-5, False), (1e-5, True)]
    assert [model.regularisers(splats) for model, splats in (summed, meant)] == [{}, {}]


@pytest.mark.parametrize(("reduction", "root"), [("sum", 1.0), ("mean_over_gaussians", math.sqrt(6))])
def test_groups_are_penalised_in_the_optimiser_as_norms_of_sums_or_of_means(reduction, root):
    model, splats = ready(source_penalty=0.1, penalty_reduction=reduction)
    declared = model.per_gaussian(seeds())["source_gains"]
    assert model.regularisers(splats) == {}
    assert penalties(declared, 6) == {"weight_decay": 0.0, "group_penalty": pytest.approx(0.1 / root)}


def test_in_si_units_sources_are_counted_in_degrees_per_second():
    """50 °C within 400 s: a gain of 1 image unit per span is 1/8 °C per second."""

    def gains(penalty, **options):
        return ready(penalty=penalty, source_penalty=1e-5, **options)[0].per_gaussian(seeds())["source_gains"]

    assert gains("ridge", penalty_units="si").l2 == pytest.approx(1e-5 / 64)
    assert gains("group", penalty_units="si").group == pytest.approx(1e-5 / 8)
    with pytest.raises(SceneError, match="penalty_units=image"):
        gains("group", penalty_units="si", scene_data=scene(thermal_range=None))


@pytest.mark.parametrize("off", [{"source_penalty": 0.0}, {"frequencies": 0}])
def test_a_penalty_that_is_off_is_absent(off):
    model, splats = ready(**off)
    assert "group_penalty" not in penalties(model.per_gaussian(seeds()).get("source_gains", PerGaussian(None, 0.0)), 6)


def test_groups_leave_the_frequencies_that_a_scene_needs():
    """A drive at one frequency of the grid and half of it noise: squares shrink all by a share, groups the idle ones."""
    times_s, count = torch.linspace(0, SPAN_S, 81).tolist(), 8
    generator = torch.Generator().manual_seed(1)
    left = {}
    for penalty, weight in (("ridge", 3e-4), ("group", 3e-3)):
        start = Seeds(torch.zeros(count, 3), torch.full((count, 1), 0.5), torch.Generator())
        model, splats = ready(start, tau_min_s=5.0, penalty=penalty, source_penalty=weight)
        driven = model.omega[4].item() / SPAN_S
        noise = 0.02 * torch.randn(len(times_s), count, generator=generator.manual_seed(1))
        observed = [0.5 + 0.2 * math.sin(driven * t) + noise[i] for i, t in enumerate(times_s)]
        fit(model, splats, model.per_gaussian(start), observed, times_s, steps=1000)
        strength = splats["source_gains"].detach().norm(dim=(0, 1))
        left[penalty] = (strength / strength.max() < 0.05).sum().item()
    assert left["group"] > left["ridge"]


def test_a_step_moves_the_temperature_as_much_whatever_the_number_of_harmonics():
    rates = [ready(frequencies=k)[0].per_gaussian(seeds())["source_gains"] for k in (1, 4, 8)]
    sizes = [item.initial.shape[2] for item in rates]
    assert sizes[0] < sizes[1] < sizes[2]
    assert [item.lr * size for item, size in zip(rates, sizes, strict=True)] == pytest.approx([0.16] * 3)


@pytest.mark.parametrize("param", ["rate", "faithful"])
def test_what_it_learned_is_told_in_seconds_and_degrees_per_hour(param):
    """Of a body driven by one wave: dT/dt = -(T - T_a) / tau + a sin(wt), a times the root of a half."""
    model, splats = ready(param=param, dtype=torch.float64)
    with torch.no_grad():
        splats["source_gains"].zero_()
        splats["source_gains"][2, 0, 1] = 0.4
        splats["log_rate" if param == "rate" else "log_conductance"][:] = math.log(5.0)
        splats["log_rate" if param == "rate" else "log_conductance"][1] = -50.0
        if param == "faithful":
            splats["log_capacity"][:] = math.log(2.0)
    told = model.attributes(splats, Query(torch.tensor([2, 1])))
    capacity, span_s = (2.0 if param == "faithful" else 1.0), model.clock.span_s
    assert told["time_constant_s"].tolist() == pytest.approx([capacity * span_s / 5.0, 100.0 * span_s])
    per_span = 0.4 / capacity / 2**0.5 * RANGE.span_k
    assert told["source_c_per_h"].tolist() == pytest.approx([per_span * 3600.0 / span_s, 0.0])
    Cloud(splats).drop("source_gains", torch.arange(len(splats)) != 2, {})
    assert model.attributes(splats, Query(None))["source_c_per_h"].count_nonzero() == 1


@pytest.mark.parametrize("log_rate", [math.log(1e-30), -1e4, 1e4])
def test_extreme_rates_stay_finite(log_rate):
    model, splats = ready()
    with torch.no_grad():
        splats["log_rate"].fill_(log_rate)
        splats["source_gains"].fill_(0.1)
    for time_s in (-100 * SPAN_S, -SPAN_S, 2 * SPAN_S, 100 * SPAN_S):  # beyond the record there is no gradient
        assert model.features(splats, Query(time_s=time_s)).isfinite().all()
    for time_s in (0.0, 1e-3, SPAN_S):
        splats.zero_grad()
        emitted = model.features(splats, Query(time_s=time_s))
        emitted.sum().backward()
        assert emitted.isfinite().all()
        assert all(splats[name].grad.isfinite().all() for name in ("log_rate", "source_gains", "initial_state"))


def test_a_checkpoint_carries_grid_range_span_and_ambient():
    model, splats = ready(ambient="learned")
    stir(splats)
    with torch.no_grad():
        model.ambient.fill_(0.33)
    file = io.BytesIO()
    torch.save({"model": model.state_dict(), "splats": splats.state_dict()}, file)
    file.seek(0)
    stored = torch.load(file, weights_only=True)
    other, loaded = ready(
        scene_data=scene(torch.linspace(0, 9.0, 81).tolist(), ThermalRange(0, 1), 0.5), ambient="learned"
    )
    other.load_state_dict(stored["model"])
    loaded.load_state_dict(stored["splats"])
    assert torch.equal(other.temperature(loaded, 123.0), model.temperature(splats, 123.0))
    assert set(stored["model"]) == {"omega", "clock.record", "range.range_c", "ambient"}


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"param": "tau"}, "param must be one of rate, faithful, got 'tau'"),
        ({"clip": "soft"}, "clip must be one of"),
        ({"penalty": "lasso"}, "penalty must be one of group, ridge"),
        ({"penalty_reduction": "mean"}, "penalty_reduction must be one of sum, mean_over_gaussians"),
        ({"penalty_units": "kelvin"}, "penalty_units must be one of image, si"),
        ({"ambient": "guess"}, "ambient must be measured, learned or a number"),
    ],
)
def test_unknown_options_are_named(option, message):
    with pytest.raises(ValueError, match=message):
        NewtonHarmonic(**option)


def test_the_configuration_holds_the_defaults(request):
    config = OmegaConf.load(request.config.rootpath / "conf/thermal/newton_harmonic.yaml")
    model, default = instantiate(config), NewtonHarmonic()
    settings = {key: value for key, value in vars(default).items() if isinstance(value, (int, float, str, type(None)))}
    assert settings
    for key, value in settings.items():
        assert getattr(model, key) == pytest.approx(value) if isinstance(value, float) else getattr(model, key) == value


def test_messages_are_warnings(caplog):
    ready(scene_data=scene(ambient_c=None))
    assert [record.levelno for record in caplog.records] == [logging.WARNING]


def test_bodies_start_slow_unless_training_views_show_that_they_relax():
    times_s = torch.linspace(0, SPAN_S, 20, dtype=torch.float64)
    rates = torch.tensor([0.0, 1.0, 8.0])
    looks = 0.12 + (0.8 - 0.12) * torch.exp(-rates[:, None].double() * times_s / SPAN_S).float()
    start = Seeds(torch.zeros(3, 3), looks.median(1, keepdim=True).values, torch.Generator(), looks[..., None], times_s)
    _, splats = ready(start)
    assert splats["log_rate"].detach().exp().tolist() == pytest.approx([STAYS, RELAXES, RELAXES])
    assert torch.equal(splats["initial_state"].detach(), start.values[:, 0])
