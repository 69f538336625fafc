"""`morgs-mi info` for a capture."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.scenes.noise_capture import FRAMES, HEIGHT, NAMES, WIDTH


@pytest.mark.parametrize("option", ["--no-check", "--help"])
def test_info__names_standard_output_if_it_is_full(capture: Path, option: str) -> None:
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "morgs_mi", "info", str(capture), option]
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (result.returncode, result.stderr) == (1, "standard output: No space left on device.\n")


def test_info__lists_the_cameras_of_a_capture(capture: Path, run) -> None:
    status, out, _ = run("info", capture)
    assert status == 0
    assert all(f"{name} {WIDTH}x{HEIGHT}" in " ".join(out.split()) for name in NAMES)
    assert f"{FRAMES} frames at 25 fps, 150 points, without ground truth." in out
