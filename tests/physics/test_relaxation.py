"""The closed form against 60 digits, in its limits, before time 0, and its gradients."""

import math

import pytest
import torch
from harmonic_reference import draw, exact, joint_error, own_error
from hypothesis import example, given, settings
from hypothesis import strategies as st

from heatsplat.physics.relaxation import harmonic_response, phases, relax, response_slope, temperature

DOUBLE = torch.float64


def scalar(value, dtype=DOUBLE):
    return torch.tensor(value, dtype=dtype)


def vector(*values, dtype=DOUBLE):
    return torch.tensor(values, dtype=dtype)


@pytest.mark.parametrize(
    ("dtype", "bound", "relative"), [(torch.float32, 5e-7, 1e-4), (torch.float64, 2e-15, 1e-12)], ids=str
)
def test_values_and_slopes_over_the_whole_range(dtype, bound, relative):
    worst, drawn = torch.zeros(4), draw(1500, seed=1)
    for rates, omegas, times in zip(*(x.split(10) for x in drawn), strict=True):
        arguments = rates.to(dtype), omegas, times  # of ten bodies each frequency at a time of its own
        found = [[x.diagonal().tolist() for x in form(*arguments)] for form in (harmonic_response, response_slope)]
        for k, (rate, omega, time) in enumerate(zip(*(x.tolist() for x in (rates, omegas, times)), strict=True)):
            reference = exact(rate, omega, time)
            values, slopes = ([x[k] for x in pair] for pair in found)
            pairs = (values, reference[:2]), (slopes, reference[2:])
            joint = [joint_error(*pair) for pair in pairs]
            worst = worst.maximum(torch.tensor(joint + [own_error(*pair, phase=omega * time) for pair in pairs]))
    assert worst[:2].max() <= bound, worst
    assert worst[2:].max() <= relative, worst


def test_the_formula_as_printed_fails_where_ours_holds():
    """The reason for the stable form: cos ωt - e^{-at} is 0 in float32 here, and half of the response is lost."""
    rate, omega, time = 1e-5, 1e-5, 1e-3
    tau = 1 / torch.tensor(rate)
    turn, decay = torch.tensor(omega) * tau, torch.exp(-torch.tensor(time) / tau)
    phase = torch.tensor(omega * time)
    printed = tau / (1 + turn**2) * (phase.cos() + turn * phase.sin() - decay)
    reference = exact(float(torch.tensor(rate)), omega, time)
    assert abs(printed.item() / float(reference[1]) - 1) > 0.4
    ours = harmonic_response(vector(rate, dtype=torch.float32), vector(omega), scalar(time))[1]
    assert abs(ours.item() / float(reference[1]) - 1) < 1e-6


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_limits_hold_exactly(dtype):
    rate, omega, time = vector(0.0, 0.5, dtype=dtype), vector(0.0, 0.75), scalar(3.0)
    sine, cosine = harmonic_response(rate, omega, time)
    close = {"rtol": 4 * torch.finfo(dtype).eps, "atol": 0.0}
    assert sine[:, 0].tolist() == [0, 0]
    assert cosine[0, 0] == 3.0
    torch.testing.assert_close(sine[0, 1].item(), (1 - math.cos(2.25)) / 0.75, **close)
    torch.testing.assert_close(cosine[0, 1].item(), math.sin(2.25) / 0.75, **close)
    torch.testing.assert_close(cosine[1, 0].item(), (1 - math.exp(-1.5)) / 0.5, **close)
    at_start = harmonic_response(rate, omega, scalar(0.0))
    assert not at_start[0].any()
    assert not at_start[1].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_slopes_in_the_limits(dtype):
    """By hand: 0 and -t²/2 at a = 0 and ω = 0; at a = 0 alone they follow from integrating by parts."""
    time, omega = 3.0, 0.75
    sine, cosine = response_slope(vector(0.0, dtype=dtype), vector(0.0, omega), scalar(time))
    assert (sine[0, 0].item(), cosine[0, 0].item()) == (0, -4.5)
    x = omega * time
    close = {"rtol": 1e-6 if dtype == torch.float32 else 1e-14, "atol": 0.0}
    torch.testing.assert_close(cosine[0, 1].item(), -(1 - math.cos(x)) / omega**2, **close)
    torch.testing.assert_close(sine[0, 1].item(), -(x - math.sin(x)) / omega**2, **close)
    assert not torch.cat(response_slope(vector(0.0, 2.0, dtype=dtype), vector(0.0, omega), scalar(0.0))).any()


edges = st.sampled_from([0.0, 1e-45, 1e-38, 1e-30, 1e-20, 1e-12, 1e-8])
rates = st.one_of(edges, st.floats(1e-12, 1e4), st.sampled_from([1e4, 1e9]))
omegas = st.one_of(edges, st.floats(1e-5, 3e2))
times = st.one_of(st.sampled_from([-1e5, -1.0, -1e-9, 0.0, 1e-12, 1e-8]), st.floats(1e-3, 1e5))


@settings(max_examples=300, deadline=None, derandomize=True)
@given(rates, omegas, times)
@example(1.0, 1e-12, 1.0)  # on the border between series and closed form
@example(1e-30, 0.0, 1e5)
@example(1e-45, 1e-45, 1e5)
def test_edges_are_finite_and_near_the_exact_value(rate, omega, time):
    for dtype, bound in ((torch.float32, 2e-6), (torch.float64, 1e-14)):
        a = vector(rate, dtype=dtype)
        rate_used = min(a.item(), 1 / -time) if time < 0 else a.item()
        values = [x.item() for x in harmonic_response(a, vector(omega), scalar(time))]
        slopes = [x.item() for x in response_slope(vector(rate_used, dtype=dtype), vector(omega), scalar(time))]
        assert all(map(math.isfinite, values + slopes))
        if rate_used == 0 and omega == 0:
            assert values[0] == 0
            assert values[1] == pytest.approx(time, rel=1e-7)
        elif time != 0:
            reference = exact(rate_used, omega, time)
            assert joint_error(values, reference[:2]) <= bound
            assert joint_error(slopes, reference[2:]) <= bound


def test_phases_keep_their_turns_at_ten_million_radians():
    time, omega = 98765.4321, vector(299.987654321)
    exact_phase = exact(0.0, omega.item(), time)  # without decay: (1 - cos x)/ω and sin x / ω
    found = phases(omega, scalar(time))
    assert found.x.item() > 2e7
    assert found.sinc.item() * time == pytest.approx(float(exact_phase[1]), rel=1e-13)
    assert found.cosc.item() * time == pytest.approx(float(exact_phase[0]), rel=1e-13)


def test_gradients_of_the_response_pass_gradcheck():
    generator = torch.Generator().manual_seed(0)
    rate = torch.exp(torch.randn(6, generator=generator, dtype=DOUBLE)).requires_grad_()
    omega = vector(0.0, 0.3, 2.0, 11.0)
    for time in (0.01, 0.9, 40.0):
        assert torch.autograd.gradcheck(lambda a, t=time: harmonic_response(a, omega, scalar(t)), rate, eps=1e-7)


def test_gradients_of_the_temperature_pass_gradcheck():
    generator = torch.Generator().manual_seed(0)

    def normal(*shape):
        return torch.randn(shape, generator=generator, dtype=DOUBLE).requires_grad_()

    arguments = normal(), normal(5), normal(5).detach().exp().requires_grad_(), normal(5, 3), normal(5, 3)
    omega = vector(0.2, 1.0, 7.0)
    assert torch.autograd.gradcheck(
        lambda ambient, initial, rate, sine, cosine: temperature(
            scalar(1.3), ambient, initial, rate, omega, sine, cosine
        ),
        arguments,
        eps=1e-7,
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("time", [0.0, 1e-3, 2e3, -50.0])
def test_gradient_by_the_log_of_a_vanishing_rate(dtype, time):
    """a = 1e-30 is a perfectly insulated body: finite gradients everywhere, those by the gains those of a = 0."""
    log_rate = vector(math.log(1e-30), dtype=dtype).requires_grad_()
    initial, gains = vector(310.0, dtype=dtype).requires_grad_(), torch.ones(1, 4, dtype=dtype).requires_grad_()
    omega = vector(0.0, 1e-3, 0.1, 5.0)
    result = temperature(
        scalar(time), scalar(290.0, dtype), initial, log_rate.exp(), omega, gains, torch.zeros_like(gains)
    )
    result.sum().backward()
    for tensor in (log_rate, initial, gains):
        assert tensor.grad.isfinite().all()
    assert initial.grad.item() == 1
    assert abs(log_rate.grad.item()) <= 1e-20
    expected = torch.where(omega == 0, 0.0, (1 - torch.cos(omega * time)) / omega.clamp(min=1e-9))
    torch.testing.assert_close(gains.grad[0].double(), expected, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("rate", [1e-12, 1e-3, 0.5, 1e4])
@pytest.mark.parametrize("time", [1e-3, 2.0, 1e5])
def test_relaxation_gradients_against_mpmath(rate, time):
    a = vector(rate).requires_grad_()
    initial, ambient = vector(350.0).requires_grad_(), scalar(290.0).requires_grad_()
    relax(scalar(time), ambient, initial, a).sum().backward()
    decay = math.exp(-rate * time)
    assert a.grad.item() == pytest.approx(-60 * time * decay, rel=1e-12)
    assert initial.grad.item() == pytest.approx(decay, rel=1e-12)
    assert ambient.grad.item() == pytest.approx(-math.expm1(-rate * time), rel=1e-12)


def test_relaxation_meets_both_ends_exactly():
    initial, ambient, rate = vector(331.7, 277.1), scalar(299.9), vector(0.0, 3.0)
    assert torch.equal(relax(scalar(0.0), ambient, initial, rate), initial)
    late = relax(scalar(1e6), ambient, initial, rate)
    assert late.tolist() == [331.7, 299.9]


def test_temperature_solves_its_equation():
    """An independent path: a fine Runge-Kutta integration of the differential equation itself."""
    rate, omega = vector(0.0, 0.02, 1.5), vector(0.05, 0.4)
    sine, cosine = vector(0.3, -0.2).repeat(3, 1), vector(-0.1, 0.5).repeat(3, 1)
    ambient, initial = scalar(290.0), vector(300.0, 310.0, 280.0)

    def slope(t, state):
        source = sine * torch.sin(omega * t) + cosine * torch.cos(omega * t)
        return -rate * (state - ambient) + source.sum(1)

    steps, end = 2000, 60.0
    h, state = end / steps, initial
    for i in range(steps):
        t = i * h
        k1 = slope(t, state)
        k2 = slope(t + h / 2, state + h / 2 * k1)
        k3 = slope(t + h / 2, state + h / 2 * k2)
        k4 = slope(t + h, state + h * k3)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    closed = temperature(scalar(end), ambient, initial, rate, omega, sine, cosine)
    torch.testing.assert_close(closed, state, rtol=0, atol=1e-8)


def test_before_time_zero_the_decay_is_bounded():
    """A test frame a day before the first training frame, and a body that forgets within milliseconds."""
    initial, ambient = vector(320.0), scalar(300.0)
    early = temperature(
        scalar(-86400.0), ambient, initial, vector(1e3), vector(1e-3), vector(0.0)[None], vector(0.0)[None]
    )
    assert early.item() == pytest.approx(300 + 20 * math.e)
    slow = relax(scalar(-10.0), ambient, initial, vector(0.01))  # below the bound the true value
    assert slow.item() == pytest.approx(300 + 20 * math.exp(0.1))


def test_no_frequency_is_pure_relaxation():
    empty = torch.zeros(2, 0, dtype=DOUBLE)
    arguments = scalar(5.0), scalar(290.0), vector(300.0, 310.0), vector(0.1, 0.0)
    assert torch.equal(temperature(*arguments, empty[0], empty, empty), relax(*arguments))


@pytest.mark.parametrize(
    ("omega", "time", "message"),
    [
        (torch.ones(2), scalar(1.0), "omega must be float64"),
        (vector(1.0), torch.tensor(1.0), "time must be float64"),
        (vector(1.0).requires_grad_(), scalar(1.0), "omega is a constant"),
    ],
)
def test_wrong_constants_are_named(omega, time, message):
    with pytest.raises(ValueError, match=message):
        harmonic_response(torch.ones(3), omega, time)


def test_relaxation_starts_at_the_initial_temperature_to_the_last_bit():
    """From the late end alone ambient + (initial - ambient) it would miss by the rounding of the larger of the two."""
    generator = torch.Generator().manual_seed(3)
    initial, ambient = torch.rand(2, 500, generator=generator) * torch.tensor([[1.0], [1e4]])
    rate = torch.rand(500, generator=generator)
    assert torch.equal(relax(scalar(0.0), ambient, initial, rate), initial)
