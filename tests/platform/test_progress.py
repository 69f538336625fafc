"""Progress bars in notebooks, on terminals and elsewhere."""

import io
import sys

from morgs_mi.platform import progress
from morgs_mi.platform.progress import Progress, ProgressBar, name_of, time_left


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_bar__draws_on_a_terminal_and_ends_the_line(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    bar = ProgressBar("Evaluating")
    for done in range(1, 5):
        bar(done, 4)
    lines = sys.stderr.getvalue().split("\r")
    assert lines[1].startswith("Evaluating")
    assert "1/4, 0 s" in lines[1]
    assert "━" * 30 + " 4/4" in lines[-1]
    assert lines[-1].endswith("\n")
    assert len(lines) == 3, "updates in quick succession are left out"


def test_progress_bar__time_left_is_at_the_pace_since_the_first_report(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    moments = iter([0.0, 0.0, 10.0, 20.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(moments))
    bar = ProgressBar("Fitting")
    for done in (6, 7, 8):
        bar(done, 10)
    assert "8/10, about 20 s left" in sys.stderr.getvalue()


def test_progress_bar__writes_nothing_into_a_file(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    ProgressBar("Fitting").report("First frame", 1, 1)
    assert sys.stderr.getvalue() == ""


def test_progress__reports_its_stage():
    reported = []
    progress = Progress(lambda *state: reported.append(state))
    progress.of("Trial")(1, 4)
    progress.of("Later frames").part(2, 9)(3, 6)
    Progress()(1, 2)  # reports nothing
    assert reported == [("Trial", 1, 4), ("Later frames", 2.5, 9)]


def test_time_left__is_known_after_three_percent():
    assert time_left(10, 3, 100) is None
    assert time_left(10, 4, 100) == 240
    assert time_left(10, 60, 100, base=50) == 40
    assert time_left(10, 100, 100, base=100) is None


def test_progress__shows_a_forecast_until_the_pace_is_known():
    reported = []
    progress = Progress(lambda *state: reported.append(state)).forecast(
        "First frame", ", about 42 s"
    )
    for done in (0, 3, 4):
        progress(done, 100)
    assert [stage for stage, *_ in reported] == [*2 * ["First frame, about 42 s"], "First frame"]
    assert {name_of(stage) for stage, *_ in reported} == {"First frame"}
