"""`morgs-mi view`: its end."""

from __future__ import annotations

import os
import signal

import pytest

from morgs_mi.cli.view import _stopped_by_interrupt


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_View__stops_before_it_raises(number: signal.Signals) -> None:
    steps, before = [], signal.getsignal(number)

    def view() -> None:
        with _stopped_by_interrupt(lambda: steps.append("stop")):
            os.kill(os.getpid(), number)
            steps.append("after")

    with pytest.raises(KeyboardInterrupt):
        view()
    assert steps == ["stop", "after"]
    assert signal.getsignal(number) is before
