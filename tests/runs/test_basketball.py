"""CMU Panoptic's basketball from its folder to the committed quality: 30 frames, four held-out
cameras, and a resume.

The recording is not in the repository (docs/experiments/real.md says where it is); a variable names
its folder:

MORGS_MI_BASKETBALL=FOLDER pytest -m slow tests/runs/test_basketball.py
"""

import os
import shutil

import numpy as np
import pytest

from morgs_mi.cli.main import main
from morgs_mi.codec.reader import StreamReader
from morgs_mi.platform.bounded import read_json

FOLDER = os.environ.get("MORGS_MI_BASKETBALL")
FRAMES = 30
# Index of a frame in which the fit is cut off.
CUT = 27


@pytest.mark.slow
@pytest.mark.skipif(not FOLDER, reason="needs a recording: set MORGS_MI_BASKETBALL to its folder")
def test_basketball__is_fitted_to_the_committed_quality_and_resumes_to_the_byte(tmp_path):
    out = tmp_path / "out"
    command = [
        "fit",
        FOLDER or "",
        str(out),
        "--frames",
        str(FRAMES),
        "--epochs",
        "2",
    ]
    assert main(command) == 0
    assert main(["eval", str(out), "--json", str(tmp_path / "eval.json")]) == 0
    result = read_json(tmp_path / "eval.json")
    assert set(result["views"]) == {"0", "10", "15", "30"}
    # The committed run, docs/experiments/real.md, less the spread of fits.
    assert min(scores["psnr"] for scores in result["views"].values()) > 24
    assert result["frames"][0]["psnr"] > 28
    assert result["frames"][-1]["psnr"] > 27
    rows = read_json(out / "report.json")["frames"]
    assert np.mean([row["active"]["gaussians"] for row in rows[1:]]) < 0.35
    assert np.mean([row["num_bytes"] for row in rows[1:]]) < 270e3

    whole = (out / "stream.morgs").read_bytes()
    offset = next(
        offset for _, frame, offset in StreamReader(out / "stream.morgs").index() if frame == CUT
    )
    shutil.copytree(out, tmp_path / "cut")
    (tmp_path / "cut" / "stream.morgs").write_bytes(whole[: offset + 100])
    assert (
        main(
            [*(str(tmp_path / "cut") if part == str(out) else part for part in command), "--resume"]
        )
        == 0
    )
    assert (tmp_path / "cut" / "stream.morgs").read_bytes() == whole
