"""What a job does when it is told to stop, and who hears of it."""

import os
import signal

import pytest

from heatsplat.runs.signals import stoppable


@pytest.mark.parametrize("ctrl_c", [signal.default_int_handler, signal.SIG_IGN], ids=["terminal", "background job"])
@pytest.mark.parametrize("name", ["SIGTERM", "SIGUSR2"])
def test_who_asked_a_job_to_stop_hears_of_it_when_it_has(name, ctrl_c):
    heard, number = [], signal.Signals[name]
    before = signal.signal(number, lambda got, _: heard.append(got))
    before_ctrl_c = signal.signal(signal.SIGINT, ctrl_c)
    try:
        with pytest.raises(KeyboardInterrupt), stoppable():
            os.kill(os.getpid(), number)
            assert heard == [], "heard before the job had stopped"
            signal.pause()
        assert heard == [number]
        os.kill(os.getpid(), number)
        assert heard == [number, number], "the listener was not put back"
    finally:
        signal.signal(number, before)
        signal.signal(signal.SIGINT, before_ctrl_c)


def test_ctrl_c_is_nobody_elses():
    heard = []
    before = signal.signal(signal.SIGTERM, lambda got, _: heard.append(got))
    try:
        with pytest.raises(KeyboardInterrupt), stoppable():
            raise KeyboardInterrupt
        assert heard == []
    finally:
        signal.signal(signal.SIGTERM, before)
