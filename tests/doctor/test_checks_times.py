"""Clocks that run back, repeats and gaps are found."""

from dataclasses import replace

from materials import checks, clean

from heatsplat.doctor.checks.times import find


def test_clocks_that_run_back_repeats_and_gaps_are_found():
    times = [10.0 * i for i in range(len(clean().names))]
    assert "times" not in checks(replace(clean(), times_s=times), only="times")
    assert "times" in checks(
        replace(clean(), times_s=[t if i < 8 else t - 55 for i, t in enumerate(times)]), only="times"
    )
    assert "times" in checks(
        replace(clean(), times_s=[t if i < 8 else t + 500 for i, t in enumerate(times)]), only="times"
    )
    assert "times" in checks(replace(clean(), times_s=[t - t % 20 for t in times]), only="times")


def test_names_that_count_without_leading_zeros_are_in_the_order_of_their_numbers():
    count = len(clean().names)
    counted = replace(
        clean(), names=[f"image ({i + 1}).tiff" for i in range(count)], times_s=[10.0 * i for i in range(count)]
    )
    assert not find(counted)
    assert find(replace(counted, times_s=[10.0 * i if i < 8 else 10.0 * i - 55 for i in range(count)]))


def test_a_second_camera_that_began_earlier_is_no_clock_that_runs_back():
    count = len(clean().names)
    of_two = replace(clean(), times_s=[10.0 * i if i < 8 else 10.0 * i - 75 for i in range(count)])
    assert find(of_two)
    assert not find(replace(of_two, lenses=[int(i >= 8) for i in range(count)]))
    in_folders = [f"{'left' if i < 8 else 'right'}/{name}" for i, name in enumerate(of_two.names)]
    assert not find(replace(of_two, names=in_folders))


def test_gaps_are_told_in_the_unit_that_people_would_take():
    times = [0.04 * i if i < 8 else 0.04 * i + 57_920.0 for i in range(len(clean().names))]
    (found,) = find(replace(clean(), times_s=times))
    assert "of 16.1 h (usual: 0.04 s)" in found.what
    times = [10.0 * i if i < 8 else 10.0 * i + 490.0 for i in range(len(clean().names))]
    (found,) = find(replace(clean(), times_s=times))
    assert "of 8.33 min (usual: 10 s)" in found.what


def test_cameras_that_are_triggered_together_repeat_no_time():
    count = len(clean().names)
    together = replace(clean(), times_s=[10.0 * (i // 2) for i in range(count)])
    assert any("have the time of another one" in one.what for one in find(together))
    assert not any("another one" in one.what for one in find(replace(together, lenses=[i % 2 for i in range(count)])))
    in_folders = [f"{i % 2}/{name}" for i, name in enumerate(together.names)]
    assert not any("another one" in one.what for one in find(replace(together, names=in_folders)))
