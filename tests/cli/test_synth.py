"""`morgs-mi synth`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.commands import assert_refused


@pytest.mark.parametrize("text", ["[" * 100_000, "[]"])
def test_synth__replaces_no_folder_with_a_hostile_description(tmp_path: Path, run, text: str) -> None:
    (tmp_path / "capture.json").write_text(text)
    assert_refused(run("synth", "arm", tmp_path, "--overwrite"), "is not a synthetic capture")
