"""The frequency grid of ETGS App. B and every way in which it can degenerate."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from heatsplat.physics.frequencies import default_tau_min, frequency_grid

HALF_POWER = math.sqrt(0.5)


def times(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_bounds_of_the_paper():
    timestamps = torch.arange(0, 1001, 2.0, dtype=torch.float64)
    omega = frequency_grid(timestamps, 24, tau_min=10.0, gain=HALF_POWER, separation=0.0)
    assert omega.shape == (24,)
    assert omega.dtype == torch.float64
    assert omega[0].item() == pytest.approx(2 * math.pi / 1000)  # one cycle over the span (Eq. 27)
    assert omega[-1].item() == pytest.approx(0.1)  # the half-power point is 1/τ (Eq. 32)
    torch.testing.assert_close(omega.log().diff(), torch.full((23,), math.log(omega[-1] / omega[0]) / 23).double())


def test_sampling_bounds_the_band_where_bodies_are_fast():
    omega = frequency_grid(torch.arange(0, 100, 0.5), 8, tau_min=1e-3, gain=0.1)
    assert omega[-1].item() == pytest.approx(2 * math.pi)  # 1 / (2 · 0.5 s) (Eq. 28)


def test_a_span_beyond_a_day_is_cut_at_the_lowest_frequency():
    omega = frequency_grid(times(0, 60, 1e6), 4, tau_min=60.0, gain=HALF_POWER)
    assert omega[0].item() == pytest.approx(2 * math.pi * 1e-5)


def test_images_too_far_apart_for_the_lowest_frequency_are_told(caplog):
    omega = frequency_grid(86400.0 * torch.arange(30.0), 4, tau_min=86400.0, gain=HALF_POWER)
    assert omega[0].item() == pytest.approx(2 * math.pi * 1e-5) and "images at least 24 h apart" in caplog.text


@pytest.mark.parametrize("gain", [1.0, 0.999999])
def test_no_gain_to_lose_leaves_the_narrowest_band(gain):
    omega = frequency_grid(times(0, 1, 2, 100), 5, tau_min=50.0, gain=gain, separation=0.0)
    assert omega[-1].item() == pytest.approx(1.2 * omega[0].item())  # Eq. 34
    assert len(omega) == 5


def test_one_frequency_is_the_lowest():
    omega = frequency_grid(times(0, 1, 50), 1, tau_min=1.0, gain=HALF_POWER)
    assert omega.tolist() == pytest.approx([2 * math.pi / 50])


def test_order_and_repetition_do_not_matter():
    plain = frequency_grid(times(0, 1, 3, 10), 6, tau_min=1.0, gain=0.5)
    assert torch.equal(frequency_grid(times(10, 3, 3, 0, 1, 1, 0), 6, tau_min=1.0, gain=0.5), plain)


@pytest.mark.parametrize("timestamps", [times(), times(7.0), times(7.0, 7.0, 7.0)])
def test_one_moment_has_no_frequency_and_says_so(timestamps, caplog):
    omega = frequency_grid(timestamps, 24, tau_min=1.0, gain=HALF_POWER)
    assert omega.shape == (0,)
    assert omega.dtype == torch.float64
    assert "no two timestamps differ" in caplog.text
    assert default_tau_min(timestamps) == 0


def test_none_asked_for_none_given(caplog):
    assert frequency_grid(times(0, 1), 0, tau_min=1.0, gain=0.5).shape == (0,)
    assert caplog.text == ""


def test_frequencies_stay_distinct_in_the_narrowest_band():
    omega = frequency_grid(times(0.0, 1.0), 100_000, tau_min=1.0, gain=1.0, separation=0.0)
    assert len(omega) == 100_000
    assert (omega.diff() > 0).all()


def test_rounding_of_a_clock_is_no_gap():
    clock = 1.7e9 + times(0.0, 1.0, 1.0 + 2.4e-7, 10.0)
    assert clock.unique().numel() == 4
    assert frequency_grid(clock, 2, tau_min=1e-9, gain=0.5)[-1].item() == pytest.approx(2 * math.pi * 0.5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gain": 0.0}, r"frequency_gain must lie in \(0, 1\]"),
        ({"gain": 1.5}, r"frequency_gain must lie in \(0, 1\]"),
        ({"tau_min": 0.0}, "tau_min must be"),
        ({"tau_min": math.nan}, "tau_min must be"),
        ({"separation": -0.1}, "separation must be"),
        ({"separation": math.inf}, "separation must be"),
        ({"count": -1}, "count of frequencies"),
        ({"count": 2.5}, "count of frequencies"),
        ({"timestamps": times(0, math.nan)}, "timestamps must be finite"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    arguments = {"timestamps": times(0, 1), "count": 3, "tau_min": 1.0, "gain": 0.5} | change
    with pytest.raises(ValueError, match=message):
        frequency_grid(**arguments)


def test_default_time_constant_follows_the_sampling():
    assert default_tau_min(times(0, 2, 4, 6, 7)) == 2
    assert default_tau_min(torch.arange(0, 10001.0)) == 50  # span / 200


def test_neighbours_complete_half_a_cycle_more_over_the_record():
    """24 on one cycle to 15.9: crowded below, where neighbours are 1.13 times each other, and as they were above."""
    timestamps = torch.arange(0, 1001, 2.0, dtype=torch.float64)
    every, apart = (frequency_grid(timestamps, 24, 10.0, HALF_POWER, separation) for separation in (0.0, 0.5))
    kept, asked = (omega * 1000 / (2 * math.pi) for omega in (apart, every))
    assert kept[0] == asked[0] and torch.isin(kept, asked).all()
    assert (kept.diff() >= 0.5).all()
    above = asked[:, None] - kept[None]
    assert (torch.where(above >= 0, above, math.inf).min(1).values < 0.5).all()  # none that had room was left out
    assert torch.equal(apart, frequency_grid(timestamps, 24, 10.0, HALF_POWER))


def condition(timestamps, omega):
    phases = timestamps[:, None] * omega
    return torch.linalg.cond(torch.cat([phases.sin(), phases.cos()], 1)).item()


def test_a_record_tells_separate_frequencies_apart_and_close_ones_not():
    """The record of 72 frames that the synthetic scene has: rounding has the last word on what 24 harmonics mean."""
    timestamps = torch.linspace(0, 1800, 72, dtype=torch.float64)
    found = {
        separation: frequency_grid(timestamps, 24, default_tau_min(timestamps), HALF_POWER, separation)
        for separation in (0.0, 0.5, 1.0)
    }
    assert [len(omega) for omega in found.values()] == [24, 14, 9]
    assert condition(timestamps, found[0.0]) > 1e14
    assert condition(timestamps, found[0.5]) < 1e4
    assert condition(timestamps, found[1.0]) < 3


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    st.lists(st.floats(-1e6, 1e6, allow_subnormal=False), max_size=20),
    st.integers(0, 40),
    st.floats(1e-6, 1e6),
    st.floats(1e-3, 1),
)
def test_any_timestamps_give_an_ascending_finite_grid(values, count, tau_min, gain):
    moments = torch.tensor(values, dtype=torch.float64)
    omega = frequency_grid(moments, count, tau_min, gain)
    assert len(omega) <= count
    assert set(omega.tolist()) <= set(frequency_grid(moments, count, tau_min, gain, 0.0).tolist())
    assert omega.isfinite().all()
    assert (omega > 0).all()
    assert (omega.diff() > 0).all()
    if count and max(values, default=0) - min(values, default=0) > 1e-4:
        assert len(omega) >= 1
