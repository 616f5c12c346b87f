"""One source that all Gaussians answer: against a stiff solver, what it starts from, and what a checkpoint carries."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from heatsplat.contracts import Camera, Frame, SceneData, ThermalRange, ViewSet
from heatsplat.splats import Splats
from heatsplat.thermal.base import Query, Rate, Seeds
from heatsplat.thermal.common_source import CommonSource

RANGE, SPAN_S, AMBIENT = ThermalRange(20.0, 70.0), 400.0, (26.0 - 20.0) / 50.0
RATES = (2.0, 8.0, 32.0)
COURSE = [0.2, 1.0, 0.9, 0.1, 0.0, 0.5, 1.0, 0.3, 0.0]


def scene(thermal_range=RANGE, ambient_c=26.0, times=None):
    times = torch.linspace(0, SPAN_S, 41).tolist() if times is None else times
    frames = [Frame(f"{i}.png", i, Camera(torch.eye(4), torch.eye(3), 4, 4), time) for i, time in enumerate(times)]
    views = ViewSet(frames, lambda i: None)
    return SceneData("kettle", views, views, views, torch.zeros(4, 3), None, thermal_range, ambient_c)


def ready(scene_data=None, dtype=torch.float64, **options):
    model = CommonSource(**{"moments": 9, "course": COURSE} | options).to(dtype)
    model.prepare(scene_data or scene())
    return model


def splats_with(modes):
    count = len(modes)
    geometry = {"means": torch.zeros(count, 3), "log_scales": torch.zeros(count, 3), "quats": torch.ones(count, 4)}
    return Splats(geometry | {"opacity_logits": torch.zeros(count, 1), "modes": modes})


def splats_of(model, numbers):
    """Gaussians of h and g [n, 2 R]."""
    return splats_with(numbers @ torch.linalg.pinv(model.mixing))


def numbers(count=5, size=6):
    return 0.1 * torch.randn(count, size, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def solved(given, spans, off_after=1.0):
    """Excess of bodies h_j, g_j at times, by integrating each mode: dx/dt = r (g s - x) from h."""
    knots = np.linspace(0, 1, len(COURSE))

    def change(t, x):
        power = np.interp(t, knots, COURSE) if t <= off_after else 0.0
        return np.tile(RATES, len(given)) * (given[:, 3:].reshape(-1).numpy() * power - x)

    start, before = given[:, :3].reshape(-1).numpy(), [t for t in spans if t <= off_after]
    first = solve_ivp(change, (0, off_after), start, "LSODA", before, rtol=1e-10, atol=1e-12, max_step=0.01)
    later = solve_ivp(
        change, (off_after, spans[-1]), first.y[:, -1], "LSODA", spans[len(before) :], rtol=1e-10, atol=1e-12
    )
    found = np.concatenate([first.y, later.y], 1).reshape(len(given), 3, -1).sum(1)
    return torch.from_numpy(found)


def test_temperatures_are_those_of_a_stiff_solver_within_the_record_and_beyond():
    model, given = ready(), numbers()
    spans = [0.0, 0.003, 0.11, 0.4375, 0.7, 1.0, 1.2, 3.0]
    expected = solved(given, spans)
    splats = splats_of(model, given)
    for place, span in enumerate(spans):
        found = model.temperature(splats, SPAN_S * span)
        torch.testing.assert_close(found, 293.15 + 50.0 * (AMBIENT + expected[:, place]), rtol=0, atol=5e-6)


def test_before_the_record_no_more_is_extrapolated_than_a_time_constant_of_the_quickest():
    model, given = ready(), numbers()
    splats = splats_of(model, given)
    early, earlier = model.temperature(splats, -SPAN_S / 32), model.temperature(splats, -100 * SPAN_S)
    torch.testing.assert_close(early, earlier)
    expected = (given[:, :3] * torch.exp(torch.tensor(RATES).double() / 32)).sum(1)
    torch.testing.assert_close(early, 293.15 + 50.0 * (AMBIENT + expected))


def test_long_after_the_record_all_is_at_the_ambient_temperature():
    model = ready()
    late = model.features(splats_of(model, numbers()), Query(time_s=100 * SPAN_S))
    torch.testing.assert_close(late, torch.full_like(late, AMBIENT))


def test_modes_are_uncorrelated_over_the_training_images():
    """Their numbers are as strongly felt as each other, which an optimiser of single numbers needs."""
    model = ready()
    courses = torch.stack([model._modes_at(time) for time in scene().train.times_s]).detach()
    torch.testing.assert_close(courses.T @ courses / len(courses), torch.eye(6, dtype=torch.float64), rtol=0, atol=1e-6)


def test_modes_that_no_image_tells_stay_small():
    """Of three images, and of a source that was always on and gives its answers away: three and two numbers of six."""
    for model, told in ((ready(scene(times=[0.0, 200.0, 400.0])), 3), (ready(course=None), 4)):
        courses = torch.stack([model._modes_at(time) for time in (0.0, 200.0, 400.0)]).detach()
        assert courses[:, told:].abs().max() < 0.1 and model.mixing.isfinite().all()


def test_gaussians_start_at_what_training_views_show():
    model, given = ready(dtype=torch.float32, clip="none"), numbers(30)
    times = torch.linspace(0, SPAN_S, 33, dtype=torch.float64)
    looks = solved(given, (times / SPAN_S).tolist() + [1.001])[:, :-1].float() + AMBIENT
    seeds = Seeds(torch.zeros(30, 3), looks.median(1).values[:, None], torch.Generator(), looks[..., None], times)
    splats = splats_with(model.per_gaussian(seeds)["modes"].initial)
    off = torch.stack([model.features(splats, Query(time_s=t))[:, 0] for t in times.tolist()], 1) - looks
    assert off.abs().mean() < 0.1 * looks.std(1).mean()
    alone = Seeds(torch.zeros(30, 3), looks.median(1).values[:, None], torch.Generator())
    levels = model.features(splats_with(model.per_gaussian(alone)["modes"].initial), Query(time_s=0.0))
    torch.testing.assert_close(levels, alone.values, rtol=0, atol=0.3 * (alone.values - AMBIENT).abs().max().item())


def test_only_what_is_asked_for_is_computed_and_every_parameter_learns():
    model = ready()
    splats = splats_of(model, numbers(8))
    ids = torch.tensor([6, 1])
    every = model.features(splats, Query(time_s=130.0))
    torch.testing.assert_close(model.features(splats, Query(ids, time_s=130.0)), every[ids])
    (every.sum() + model.regularisers(splats)["course_smooth"]).backward()
    assert model.course.grad.abs().max() > 0 and splats["modes"].grad.abs().max() > 0
    assert set(dict(model.named_parameters())) == {"course"} and model.cost == 6
    assert model.rate_of("course") == Rate(5e-4, 0.1)


def test_gradients_are_those_of_differences():
    model = ready(clip="none")
    modes = numbers(3).requires_grad_()

    def told(modes, course):
        model.course.data.copy_(course)
        return torch.stack([model._modes_at(t) for t in (0.0, 90.0, 400.0, 700.0)]) @ modes.T

    torch.autograd.gradcheck(lambda modes: told(modes, model.course.detach()), (modes,))
    model.features(splats_with(modes.detach()), Query(time_s=90.0)).sum().backward()
    step = 1e-6
    for k in (0, 2, 8):
        base = model.course.detach().clone()
        ends = []
        for sign in (1, -1):
            moved = base.clone()
            moved[k] += sign * step
            ends.append(told(modes.detach(), moved)[1].sum())
        model.course.data.copy_(base)
        assert model.course.grad[k].item() == pytest.approx(((ends[0] - ends[1]) / (2 * step)).item(), abs=1e-7)


def test_what_it_says_of_itself():
    model = ready()
    given = numbers()
    splats = splats_of(model, given)
    rise = model.attributes(splats, Query(None))["source_rise_c"]
    torch.testing.assert_close(rise, 50.0 * given[:, 3:].sum(1))  # the course is at most 1
    rise.sum().backward()
    torch.testing.assert_close(splats["modes"].grad, (50.0 * model.mixing[:, 3:].sum(1)).expand(len(given), -1))
    assert model.effects()["harmonic_source"] == {"source": "common", "moments": 9}
    (course,) = model.courses()
    assert course.times_s[0] == 0.0 and course.times_s[-1] == SPAN_S and course.values == pytest.approx(COURSE)
    assert model.effects()["relaxation"] == {"rates_per_span": list(RATES), "ambient": "fixed"}
    assert ready(scene(thermal_range=None)).attributes(splats_of(model, given), Query(None)) == {}


def test_a_checkpoint_carries_the_course_and_its_modes():
    trained, fresh = ready(), ready(course=None)
    trained.course.data.mul_(0.7)
    fresh.load_state_dict(trained.state_dict())
    splats = splats_of(trained, numbers())
    torch.testing.assert_close(fresh.temperature(splats, 123.0), trained.temperature(splats, 123.0))


def test_it_can_be_made_double_after_it_has_been_prepared():
    model, given = ready(dtype=torch.float32), numbers()
    narrow = model.temperature(splats_of(model, given.float()), 123.0)
    model.double()
    wide = model.temperature(splats_of(model, given), 123.0)
    assert wide.dtype == torch.float64
    torch.testing.assert_close(wide.float(), narrow, rtol=0, atol=2e-3)


def test_a_moment_that_was_shown_without_gradients_can_be_asked_with_them():
    model = ready()
    splats = splats_of(model, numbers())
    with torch.inference_mode():  # as a test renders
        shown = model.features(splats, Query(None, time_s=123.0))
    model.features(splats, Query(None, time_s=123.0)).sum().backward()
    assert float(model.course.grad.abs().max()) > 0 and torch.equal(model.features(splats, Query(time_s=123.0)), shown)


def test_a_course_of_another_length_is_resampled_and_none_is_always_on():
    assert CommonSource(moments=5, course=[0.0, 1.0]).course.tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert CommonSource(moments=4).course.tolist() == [1.0] * 4


@pytest.mark.parametrize("options", [{"rates": []}, {"rates": [1.0, -1.0]}, {"moments": 2}, {"smooth": -1.0}])
def test_options_out_of_range_are_refused(options):
    with pytest.raises(ValueError, match="rates must be positive, moments at least 3 and smooth not negative"):
        CommonSource(**options)


def test_without_a_penalty_there_is_no_term():
    assert ready(smooth=0.0).regularisers(None) == {}
