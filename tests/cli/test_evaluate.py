"""`morgs-mi eval`: its files."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.cli.commands import assert_refused


def test_eval__replaces_no_file_of_the_fit(stream: Path, tmp_path: Path, run) -> None:
    for name in ("good.morgs", "report.json", "capture.json"):
        assert_refused(
            run("eval", stream, "--json", tmp_path / name),
            f"{name}: expected a new file, got one that the fit has written",
        )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 100_000, "expected JSON, got a broken file"),
        ("[]", "expected a fit's report, got a broken one"),
        ('{"frames": [{"frame": 0, "seconds": 1, "validation": 5}]}', "expected a fit's report, got a broken one"),
        (f'{{"frames": [{{"frame": 0, "seconds": {10**400}}}]}}', "expected a fit's report, got a broken one"),
    ],
)
def test_eval__reports_a_hostile_report_in_one_sentence(
    fitted_clip: Path, tmp_path: Path, run, text: str, message: str
) -> None:
    shutil.copy(fitted_clip / "stream.morgs", tmp_path)
    (tmp_path / "report.json").write_text(text)
    assert_refused(run("eval", tmp_path, "--capture", fitted_clip / "capture"), f"report.json: {message}")
