"""Clocks that run back, repeats and gaps are found."""

from dataclasses import replace

from materials import checks, clean


def test_clocks_that_run_back_repeats_and_gaps_are_found():
    times = [10.0 * i for i in range(len(clean().names))]
    assert "times" not in checks(replace(clean(), times_s=times))
    assert "times" in checks(replace(clean(), times_s=[t if i < 8 else t - 55 for i, t in enumerate(times)]))
    assert "times" in checks(replace(clean(), times_s=[t if i < 8 else t + 500 for i, t in enumerate(times)]))
    assert "times" in checks(replace(clean(), times_s=[t - t % 20 for t in times]))
