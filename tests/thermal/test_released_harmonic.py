"""ETGS in the parameters of its authors' code: their formula, an ODE solver, their starts, steps and bounds."""

import mpmath
import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from scipy.integrate import solve_ivp
from thermal.test_newton_harmonic import RANGE, SPAN_S, scene, seeds, splats_of

from heatsplat.composition import compose
from heatsplat.contracts import SceneError
from heatsplat.thermal.base import Query
from heatsplat.thermal.newton_harmonic import NewtonHarmonic
from heatsplat.thermal.released_harmonic import ReleasedHarmonic
from heatsplat.training.optimisation import penalties

AMBIENT_C = 26.0
TIMES_S = (0.0, 0.5, 137.0, SPAN_S)


def ready(dtype=torch.float32, start=None, **options):
    model = ReleasedHarmonic(**options)
    model.prepare(scene())
    return model, splats_of(model, start or seeds(), dtype)


def bodies(dtype=torch.float64, **options):
    """Six Gaussians whose τ (1 s to 2 hours), γ, T0, A and B are given in seconds and °C; those numbers as well."""
    model, splats = ready(dtype, **options)
    generator = torch.Generator().manual_seed(3)
    count, harmonics = len(splats), model.omega.numel()
    tau_s = torch.logspace(0, 3.9, count, dtype=torch.float64)
    gamma_c = torch.linspace(0.2, 3.0, count, dtype=torch.float64)
    start_c = torch.linspace(21.0, 69.0, count, dtype=torch.float64)
    with torch.no_grad():
        splats["time_constant"].copy_(tau_s / SPAN_S)
        splats["source_scale"].copy_(gamma_c / RANGE.span_k)
        splats["initial_state"].copy_(RANGE.to_unit(start_c))
        splats["source_gains"].copy_(torch.randn(count, 2, harmonics, generator=generator))
    return model, splats, (tau_s, gamma_c, start_c, splats["source_gains"].detach().double())


def printed(time_s, omega, tau, gamma, start, sin_gain, cos_gain):
    """T(t) in °C as the text and the code have it, with 50 digits."""
    decay = mpmath.exp(-time_s / tau)
    total = AMBIENT_C + (start - AMBIENT_C) * decay
    for w, a, b in zip(omega, sin_gain, cos_gain, strict=True):
        sine, cosine, wt = mpmath.sin(w * time_s), mpmath.cos(w * time_s), w * tau
        total += gamma / (1 + wt**2) * (a * (sine - wt * cosine + wt * decay) + b * (cosine + wt * sine - decay))
    return total


@pytest.mark.parametrize(("dtype", "error_k"), [(torch.float64, 2e-6), (torch.float32, 2e-4)])
def test_temperatures_are_the_printed_closed_form(dtype, error_k):
    model, splats, (tau, gamma, start, gains) = bodies(dtype)
    if dtype == torch.float64:
        model.ambient = torch.tensor(RANGE.to_unit(AMBIENT_C), dtype=dtype)
    with mpmath.workdps(50):
        omega = [mpmath.mpf(w) / SPAN_S for w in model.omega.tolist()]
        for time_s in TIMES_S:
            found = model.temperature(splats, time_s).detach() - 273.15
            for i, value in enumerate(found.tolist()):
                numbers = (mpmath.mpf(x[i].item()) for x in (tau, gamma, start))
                assert value == pytest.approx(
                    float(printed(mpmath.mpf(time_s), omega, *numbers, *gains[i].tolist())), abs=error_k
                )


def test_temperatures_solve_the_differential_equation():
    """C dT/dt = -h (T - T_ambient) + Q with C = τ/γ and h = 1/γ, by steps that know no closed form."""
    model, splats, (tau, gamma, start, gains) = bodies()
    tau, gamma, start, gains = (x.numpy() for x in (tau, gamma, start, gains))
    omega = (model.omega / SPAN_S).numpy()[:, None]

    def slope(time_s, state):
        heat = gains[:, 0].T * torch.sin(torch.tensor(omega * time_s)).numpy()
        heat += gains[:, 1].T * torch.cos(torch.tensor(omega * time_s)).numpy()
        return (-(state - AMBIENT_C) / gamma + heat.sum(0)) / (tau / gamma)

    steps = solve_ivp(slope, (0.0, SPAN_S), start, "DOP853", TIMES_S, rtol=1e-10, atol=1e-9).y.T
    for time_s, expected in zip(TIMES_S, steps, strict=True):
        found = model.temperature(splats, time_s).detach() - 273.15
        torch.testing.assert_close(found, torch.from_numpy(expected), rtol=0, atol=2e-5)


def test_gradients_are_those_of_small_steps():
    model, splats, _ = bodies(frequencies=4, clip="none")
    names = "time_constant", "source_scale", "initial_state", "source_gains"
    model.features(splats, Query(time_s=91.0)).sum().backward()
    for name in names:
        value, slope = splats[name].detach(), splats[name].grad.flatten()
        for i in range(0, value.numel(), 5):
            entry = value.view(-1)[i]
            step = 1e-5 * abs(entry.item())
            sides = []
            for sign in (1, -1):
                entry += sign * step
                sides.append(model.features(splats, Query(time_s=91.0)).sum().item())
                entry -= sign * step
            assert (sides[0] - sides[1]) / (2 * step) == pytest.approx(slope[i].item(), rel=1e-5, abs=1e-8), name


def test_gaussians_start_as_released_and_step_in_seconds_and_degrees():
    model, splats = ready()
    query = Query(time_s=SPAN_S / 3)
    torch.testing.assert_close(model.temperature(splats, 77.0), torch.full((6,), AMBIENT_C + 273.15))
    declared = model.per_gaussian(seeds())
    groups = [{"params": [splats[name]], "lr": item.lr} for name, item in declared.items()]
    before = {name: splats[name].detach().clone() for name in declared}
    with torch.no_grad():
        splats["source_gains"].fill_(1.0)  # at their start, 0, nothing pulls on γ; nor on τ at the ambient temperature
        splats["initial_state"].add_(0.1)
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    moved = {name: splats[name].detach().clone() for name in declared}
    model.features(splats, query).sum().backward()
    optimizer.step()
    step = {name: (splats[name].detach() - moved[name]).abs().amax().item() for name in declared}
    assert before["time_constant"][0].item() * SPAN_S == pytest.approx(60.0)
    assert before["source_scale"][0].item() * RANGE.span_k == pytest.approx(1e-3)
    assert not before["source_gains"].any()
    assert step["initial_state"] * RANGE.span_k == pytest.approx(0.1, rel=1e-4)
    assert step["time_constant"] * SPAN_S == pytest.approx(0.1, rel=1e-3)
    assert step["source_scale"] * RANGE.span_k == pytest.approx(1e-3, rel=1e-3)
    assert step["source_gains"] == pytest.approx(2e-3, rel=1e-3)
    assert {item.lr_end for item in declared.values()} == {1.0}


def test_below_the_bounds_values_act_as_the_bounds_and_get_no_gradient():
    model, splats, _ = bodies(clip="none")
    with torch.no_grad():
        splats["time_constant"][0] = -1.0
        splats["source_scale"][1] = -1.0
    model.features(splats, Query(time_s=50.0)).sum().backward()
    assert splats["time_constant"].grad[0] == 0 and splats["time_constant"].grad[1:].all()
    assert splats["source_scale"].grad[1] == 0 and splats["source_scale"].grad[2:].all()
    shown = model.temperature(splats, 50.0).detach()
    with torch.no_grad():
        splats["time_constant"][0] = 1e-3 / SPAN_S
        splats["source_scale"][1] = 1e-8 / RANGE.span_k
    assert torch.equal(model.temperature(splats, 50.0).detach(), shown)


def test_the_penalty_is_the_released_norm_of_groups():
    model, splats, _ = bodies()
    assert model.regularisers(splats) == {}
    expected = {"weight_decay": 0.0, "group_penalty": 1e-5}
    assert penalties(model.per_gaussian(seeds())["source_gains"], len(splats)) == expected


def test_gains_and_their_scale_are_a_gauge():
    model, splats, _ = bodies()
    shown = model.temperature(splats, 91.0).detach()
    with torch.no_grad():
        splats["source_gains"].mul_(0.1)
        splats["source_scale"].mul_(10.0)
    torch.testing.assert_close(model.temperature(splats, 91.0).detach(), shown, rtol=1e-12, atol=0)


def test_it_shows_what_the_rate_form_shows():
    model, splats, _ = bodies()
    rate = NewtonHarmonic(tau_min_s=60.0, frequency_gain=0.25)
    rate.prepare(scene())
    same = splats_of(rate, seeds(), torch.float64)
    with torch.no_grad():
        same["initial_state"].copy_(splats["initial_state"])
        same["log_rate"].copy_(-splats["time_constant"].log())
        factor = splats["source_scale"] / splats["time_constant"]
        same["source_gains"].copy_(factor[:, None, None] * splats["source_gains"])
    for time_s in (-30.0, *TIMES_S, 2 * SPAN_S):
        torch.testing.assert_close(
            model.temperature(splats, time_s), rate.temperature(same, time_s), rtol=1e-12, atol=0
        )
    assert model.effects()["relaxation"]["param"] == "released"


def test_without_frequencies_the_source_is_absent():
    model, splats = ready(frequencies=0)
    assert {"source_scale", "source_gains"}.isdisjoint(splats.names)
    assert model.features(splats, Query(time_s=50.0)).isfinite().all()
    assert model.regularisers(splats) == {}


def test_a_scene_without_range_is_refused():
    with pytest.raises(SceneError, match="'kettle' has no temperature range, and the released form of ETGS"):
        ReleasedHarmonic().check(scene(thermal_range=None))


def test_the_configuration_holds_the_defaults(request):
    config = OmegaConf.load(request.config.rootpath / "conf/thermal/released_harmonic.yaml")
    model, default = instantiate(config), ReleasedHarmonic()
    settings = {key: value for key, value in vars(default).items() if isinstance(value, (int, float, str, type(None)))}
    assert {key: getattr(model, key) for key in settings} == settings


def test_the_recipe_is_the_released_one():
    config = compose(["method=etgs_released", "recipe=published"])
    photometric = config["loss"]["terms"]["photometric"]
    assert (photometric["dssim_weight"], photometric["dssim_half"]) == (0.2, False)
    assert config["optim"]["opacity_logits"] == 0.025


@pytest.mark.parametrize("name", ["time_constant_s", "source_scale"])
def test_bodies_that_start_without_time_or_source_are_refused(name):
    with pytest.raises(ValueError, match=f"{name}.* must be above 0, got .*-1"):
        ReleasedHarmonic(**{name: -1})
