"""Interruptions: found in what libraries make of them, raised again where they are swallowed,
without memory left.
"""

import signal
import time
import weakref

import pytest

from morgs_mi.platform.interrupts import (
    interruptible,
    interrupts_raised,
    is_interruption,
    postponed,
)


def chained(kind, explicit):
    """Return an error that was raised because of, or while handling, an interruption."""
    try:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as interruption:
            if explicit:
                raise kind("callback") from interruption
            raise kind("cleaning up") from None
    except kind as error:
        return error


@pytest.mark.parametrize(
    "error",
    [
        KeyboardInterrupt(),
        chained(RuntimeError, True),
        chained(OSError, False),
        ExceptionGroup("tasks", [ValueError(), chained(RuntimeError, True)]),
    ],
)
def test_is_interruption__follows_causes_contexts_and_groups(error):
    assert is_interruption(error)


def test_is_interruption__is_false_for_other_errors_and_ends_in_a_cycle():
    first = ValueError()
    second = OSError()
    first.__cause__ = second
    second.__cause__ = first
    assert not is_interruption(first)


class Thing:
    """An object that can be referred to weakly."""


def test_interrupts_raised__releases_the_variables_of_what_was_interrupted():
    references = []

    def interrupted():
        thing = Thing()
        cycle = []
        cycle.append((cycle, thing))
        references.append(weakref.ref(thing))
        raise chained(RuntimeError, True)

    with pytest.raises(KeyboardInterrupt) as caught:
        interrupts_raised()(interrupted)()
    assert references[0]() is None
    assert caught.value is not None


def test_interrupts_raised__leaves_other_errors_as_they_are():
    error = ValueError("other")
    with pytest.raises(ValueError, match="other") as caught, interrupts_raised():
        raise error
    assert caught.value is error


class Swallowing:
    """An object that is interrupted where Python ignores every error."""

    def __del__(self):
        signal.raise_signal(signal.SIGINT)


def plainly():
    signal.raise_signal(signal.SIGTERM)


def in_a_destructor():
    Swallowing()


@pytest.mark.parametrize("interrupt", [plainly, in_a_destructor])
def test_interruptible__raises_once_for_each_signal(heeds_interrupts, interrupt):
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]

    def wait():
        with interruptible():
            interrupt()
            time.sleep(10)

    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        wait()
    assert time.monotonic() - start < 5
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers


def test_interruptible__raises_what_was_swallowed_at_the_end(heeds_interrupts):
    with pytest.raises(KeyboardInterrupt), interruptible():
        in_a_destructor()


def test_postponed__raises_at_its_end(heeds_interrupts):
    stages = []

    def interrupted():
        with postponed():
            plainly()
            stages.append("done")

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert stages == ["done"]


def test_interruptible__lets_a_background_process_ignore_ctrl_c():
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with interruptible():
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, handler)
