import time

from heatsplat.training.clocks import CLOCKS, read_clock


def test_waiting_is_wall_time_and_no_processor_time():
    before = [read_clock(name) for name in CLOCKS]
    time.sleep(0.05)
    wall, processor = (read_clock(name) - then for name, then in zip(CLOCKS, before, strict=True))
    assert wall >= 0.05 and processor < 0.04


def test_work_is_both():
    before = [read_clock(name) for name in CLOCKS]
    while read_clock("cpu_seconds") - before[1] < 0.02:
        sum(range(1000))
    assert read_clock("train_seconds") - before[0] > 0.019
