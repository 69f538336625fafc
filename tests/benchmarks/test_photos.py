"""Photos from their folder to the committed figures.

The photos are not in the repository (docs/experiments/real.md says where they are); a variable
names their folder, with a folder for each set:

MORGS_MI_PHOTOS=FOLDER pytest -m slow tests/benchmarks/test_photos.py
"""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks.pages.results import committed
from benchmarks.reports import real
from morgs_mi.cli.main import main
from morgs_mi.platform.bounded import read_json

FOLDER = os.environ.get("MORGS_MI_PHOTOS")
# Number of photos, and whether each has a principal point of its own.
SETS = {
    "fern": (20, "own"),
    "flower": (25, "own"),
    "kitchen": (25, "shared"),
    "sceaux": (11, "shared"),
}


@pytest.mark.slow
@pytest.mark.skipif(
    not FOLDER, reason="needs photos: set MORGS_MI_PHOTOS to the folder of their sets"
)
@pytest.mark.parametrize("name", SETS)
def test_photos__are_calibrated_and_reach_the_committed_quality(name, tmp_path):
    photos = tmp_path / name
    count, points = SETS[name]
    photos.mkdir()
    for path in sorted((Path(FOLDER or ".") / name).iterdir()):
        if path.suffix.lower() in (".jpg", ".png"):
            shutil.copy(path, photos)
    assert main(["calibrate", str(photos), "--shared-intrinsics"]) == 0
    real.Options(json=tmp_path / "out.json", captures=(photos,)).run()
    (row,) = read_json(tmp_path / "out.json")["fits"]
    assert row["views"] + row["held_out_views"] == count, "every photo is registered"
    assert row["principal_points"] == points
    fits = [
        f for f in committed("real")["fits"] if (f["set"], f["principal_points"]) == (name, points)
    ]
    # Two fits of Sceaux, with one held-out photo, differ by 1 dB, the others by 0.4 dB at most.
    assert row["held_out"] > np.mean([fit["held_out"] for fit in fits]) - 1
