"""The commands for N3DV and Meet Room of the documentation, on short clips with the names and files
of these.
"""

import re
import shlex
import shutil
from pathlib import Path

import pytest

import morgs_mi
from morgs_mi.platform.bounded import read_json
from tests.scenes.captures import write_poses_bounds

PAGE = Path(__file__).parents[2] / "docs/experiments/real.md"
FRAMES = 3
# Appended to the fits, which then take seconds.
SMALLER = "--num-gaussians 2500 --first-frame-steps 200 --epochs 1"


def stand_in(path, width, height, number):
    """Write videos with camera numbers in this format, and `poses_bounds.npy`, as these recordings
    have them.
    """
    morgs_mi.synthesize(
        "random",
        path,
        morgs_mi.SynthConfig(
            cameras=8, frames=FRAMES, width=width, height=height, seed=3, lossless=False
        ),
    )
    write_poses_bounds(path / "poses_bounds.npy", morgs_mi.load_capture(path).cameras)
    for extra in ("sparse", "truth"):
        shutil.rmtree(path / extra)
    (path / "capture.json").unlink()
    for camera, clip in enumerate(sorted(path.glob("*.mp4"))):
        clip.rename(path / number.format(camera))
    assert {file.suffix for file in path.iterdir()} == {".mp4", ".npy"}


@pytest.mark.slow
def test_commands_for_public_recordings__give_scores_of_camera_0(tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stand_in(tmp_path / "N3DV/cut_roasted_beef", 320, 240, "cam{:02d}.mp4")
    stand_in(tmp_path / "MeetRoom/discussion", 160, 120, "cam_{}.mp4")
    block = PAGE.read_text().partition("<!-- commands: recordings -->\n")[2]
    commands = re.findall(r"^    morgs-mi (.*)$", block, re.MULTILINE)
    assert len(commands) == 7
    for command in commands:
        smaller = command.replace("--frames 300", f"--frames {FRAMES} {SMALLER}")
        status, _, error = run(*shlex.split(smaller))
        assert status == 0, error
    for name, held_out in (("cut_roasted_beef", "cam00"), ("discussion", "cam_0")):
        scores = read_json(tmp_path / "out" / name / "eval.json")
        assert scores["held_out"] is True
        assert [*scores["views"]] == [held_out]
        assert scores["psnr"]["mean"] > 25
