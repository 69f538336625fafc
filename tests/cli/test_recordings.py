"""Real recordings at the default settings. They are not in the repository: a variable names the
folder that holds them.

MORGS_MI_RECORDINGS=FOLDER pytest -m slow tests/cli/test_recordings.py
"""

import os
from pathlib import Path

import pytest

from morgs_mi.platform.bounded import read_json

FOLDER = os.environ.get("MORGS_MI_RECORDINGS")
CAPTURES = sorted(path for path in Path(FOLDER).iterdir() if path.is_dir()) if FOLDER else []
FRAMES = 3


@pytest.mark.slow
@pytest.mark.skipif(
    not CAPTURES, reason="needs recordings: set MORGS_MI_RECORDINGS to their folder"
)
@pytest.mark.parametrize("capture", CAPTURES, ids=lambda path: path.name)
def test_recording__is_fitted_evaluated_and_exported_by_default(capture, tmp_path, run):
    out = tmp_path / "out"
    for command in (
        ("info", capture),
        ("fit", capture, out, "--frames", FRAMES, "--downscale", 4),
        ("eval", out, "--json", tmp_path / "eval.json"),
        ("render", out, tmp_path / "frames", "--camera", 0),
        ("export", "web", out, tmp_path / "page.html"),
    ):
        status, _, error = run(*command)
        assert status == 0, f"{command}\n{error}"
    scores = read_json(tmp_path / "eval.json")
    assert scores["num_frames"] == FRAMES
    assert scores["psnr"]["mean"] > 25, "of the training views, or of one between many"
