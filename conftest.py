"""What `pytest` prints at the end of a run."""

from __future__ import annotations

import pytest


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print one line if browser tests were skipped."""
    skipped = terminalreporter.stats.get("skipped", [])
    if any(
        "Chromium" in str(report.longrepr) or "morgs-mi[browser]" in str(report.longrepr)
        for report in skipped
    ):
        terminalreporter.write_line(
            "The browser tests were skipped: run tools/setup_browser.sh to install Chromium."
        )
