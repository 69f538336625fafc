"""`morgs-mi synth`."""

from __future__ import annotations

from pathlib import Path

from tests.cli.commands import assert_refused

SIZE = ("--cameras", 2, "--frames", 2, "--width", 32, "--height", 24, "--spp", 1)


def test_synth__names_wrong_options(tmp_path: Path, run) -> None:
    assert_refused(
        run("synth", "spheres", tmp_path / "out", *SIZE, "--rolling-shutter", 2),
        "--rolling-shutter must be at least 0 and at most 1, got 2.0",
    )
    assert not (tmp_path / "out").exists()
