"""Interruptions: found in what libraries make of them, raised again where they are swallowed,
without memory left.
"""

import os
import signal
import subprocess
import sys
import time
import weakref

import pytest

from morgs_mi.core.interrupts import interruptible, interrupts_raised, is_interruption, postponed
from tests.scenes.programs import run_script


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


STARTING = """
import builtins, signal, sys
sys.argv = ["/usr/bin/morgs-mi", "info", "nothing"]
signal.signal(signal.{number}, signal.SIG_DFL)  # which nohup ignores
load = builtins.__import__

def interrupted(name, *args, **more):
    if name == "{module}":
        signal.raise_signal(signal.{number})
    return load(name, *args, **more)

builtins.__import__ = interrupted
from morgs_mi.cli.main import main
sys.exit(main())
"""


@pytest.mark.parametrize(
    ("module", "number"), [("numpy", "SIGINT"), ("drjit", "SIGTERM"), ("tyro", "SIGHUP")]
)
def test_begin_command__ends_quietly_while_libraries_are_imported(module, number):
    script = STARTING.format(module=module, number=number)
    result = run_script(script)
    assert (result.returncode, result.stdout, result.stderr) == (130, "", "Interrupted.\n")


@pytest.mark.parametrize("closed", [0, 1, 2])
def test_begin_command__replaces_a_closed_standard_stream(closed):
    """Otherwise the next file that is opened would be the standard stream of libraries."""
    script = (
        "import os, sys; sys.argv = ['morgs-mi']; import morgs_mi; sys.exit(os.fstat({0}).st_rdev "
        "!= {1})"
    )
    null = os.stat(os.devnull).st_rdev
    args = [sys.executable, "-c", script.format(closed, null)]
    assert subprocess.run(args, preexec_fn=lambda: os.close(closed), check=False).returncode == 0


def test_begin_command__changes_nothing_in_other_programs():
    script = (
        "import signal; import morgs_mi; print(signal.getsignal(signal.SIGTERM) == signal.SIG_DFL)"
    )
    assert run_script(script, check=True).stdout == "True\n"
