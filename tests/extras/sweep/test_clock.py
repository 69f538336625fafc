"""The clock of fits: seconds of this process and of others, and a sentence on a busy machine."""

import time

import pytest

from morgs_mi.extras.sweep.clock import Clock, busy_sentence, load_average, moment, stopwatch


def test_stopwatch__measures_wall_and_processor_seconds():
    stop = stopwatch("call", 0.5)
    while stop().processor_seconds < 0.05:
        pass
    time.sleep(0.1)
    clock = stop()
    assert 0.05 <= clock.processor_seconds < clock.wall_seconds
    assert (clock.call, clock.load) == ("call", 0.5)
    assert not clock.other_cores < 0
    assert clock.date <= moment()
    assert not load_average() < 0


@pytest.mark.parametrize(
    ("clock", "numbers"),
    [
        (Clock(load=0.2, other_cores=0.01), None),
        (Clock(), None),
        (Clock(load=900, other_cores=0.01), "900.0 before the fits"),
        (Clock(load=0.2, other_cores=700), "others used up to 700.0 of"),
    ],
)
def test_busy_sentence__names_load_and_others(clock, numbers):
    sentence = busy_sentence([Clock(load=0.1, other_cores=0), clock])
    assert (numbers is None) == (sentence == "")
    assert (numbers or "") in sentence


def test_busy_sentence__is_empty_without_fits():
    assert busy_sentence([]) == ""
