"""Calibrations of Anipose, Pose2Sim, caliscope and FreeMoCap: forms of the file, and projections
against OpenCV.
"""

import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.clips import clip_of_camera
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.extras.layouts.anipose import read_anipose
from morgs_mi.io.video_writer import write_video
from morgs_mi.testing import assert_close
from tests.scenes import captures as layouts
from tests.scenes.captures import (
    DOT,
    HEIGHT,
    LENS,
    WIDTH,
    assert_dot_is_shown,
    assert_is_rig,
    dot_clips,
    rig,
)

EXAMPLE = """
[cam_0]
name = "camA"
size = [1280, 720]
matrix = [[900.0, 0.0, 639.5], [0.0, 900.0, 359.5], [0.0, 0.0, 1.0]]
distortions = [-0.05, 0.01, 0.0, 0.0, 0.0]
rotation = [0.0, 0.0, 0.0]
translation = [0.0, 0.0, 4.0]

[metadata]
adjusted = false
"""
NAMES = ("trial_1-camA", "trial_1-camB", "trial_1-camC")


def test_anipose__reads_cameras_and_their_clips(tmp_path):
    capture = load_capture(layouts.anipose(tmp_path / "a"))
    assert (capture.layout, capture.names, len(capture.points)) == ("Anipose", NAMES, 0)
    assert_is_rig(capture)
    assert capture.metadata()["cameras"][0]["lens"] == "OPENCV"


@pytest.mark.parametrize("lens", [LENS[:4], (*LENS, 0.02, 0.01, 0.005)])
def test_anipose__undistorts_a_dot_to_where_the_camera_projects_it(tmp_path, lens):
    path = layouts.anipose(
        tmp_path / "a", lens, lambda folder, names: dot_clips(folder, names, DOT, lens)
    )
    capture = load_capture(path)
    assert_dot_is_shown(capture)
    model = "OPENCV" if len(lens) == 4 else "FULL_OPENCV"
    assert capture.metadata()["cameras"][0]["lens"] == model


def test_anipose__reads_a_fisheye_lens(tmp_path):
    path = layouts.anipose(tmp_path / "a", LENS[:4])
    file = path / "calibration.toml"
    file.write_text(file.read_text().replace('name = "camB"', 'name = "camB"\nfisheye = true'))
    cameras = load_capture(path).metadata()["cameras"]
    assert [camera["lens"] for camera in cameras] == ["OPENCV", "OPENCV_FISHEYE", "OPENCV"]
    assert cameras[1]["distortion"] == list(LENS[:4])


def test_anipose__reads_the_tables_of_caliscope(tmp_path):
    """They are nested and have no names; older files have rotation matrices."""
    path = layouts.anipose(tmp_path / "a")
    camera = rig(NAMES, shift=3)[1]
    rotation = camera.viewmat[:3, :3].tolist()
    (path / "calibration.toml").write_text(
        f"[cameras.1]\ncam_id = 1\nsize = [{WIDTH}, {HEIGHT}]\nmatrix = {(camera.K).tolist()}\n"
        f"distortions = [0.0, 0.0, 0.0, 0.0, 0.0]\nrotation = {rotation}\n"
        f"translation = {camera.viewmat[:3, 3].tolist()}\n"
    )
    (result,) = read_anipose(path / "calibration.toml")
    assert result.name == "cam_1"
    assert_close(result.camera.viewmat, camera.viewmat, atol=1e-9)


def test_anipose__leaves_out_cameras_that_caliscope_ignores(tmp_path, caplog):
    path = layouts.anipose(tmp_path / "a")
    file = path / "calibration.toml"
    text = file.read_text().replace('name = "camC"', 'name = "camC"\nignore = false')
    file.write_text(text.replace('name = "camB"', 'name = "camB"\nignore = true'))
    assert load_capture(path).names == NAMES[::2]
    assert caplog.messages == [
        f"{file}: tables with `ignore = true` are left out: cam_1.",
        f"{file} does not calibrate trial_1-camB: not used.",
    ]
    reading = ReadConfig(without=(NAMES[1],))
    assert load_capture(path, reading=reading).names == NAMES[::2]
    file.write_text(text.replace("size =", "ignore = true\nsize =").replace("ignore = false", ""))
    with pytest.raises(ValueError, match=r"expected a table .* without `ignore = true`, got none"):
        load_capture(path)


def test_anipose__finds_the_calibration_of_pose2sim_and_ignores_other_toml_files(tmp_path):
    path = layouts.anipose(tmp_path / "a")
    (path / "calibration").mkdir()
    (path / "calibration.toml").rename(path / "calibration" / "Calib_scene.toml")
    (path / "Config.toml").write_text('[project]\nrotation = "none"\n')
    assert load_capture(path).names == NAMES
    (path / "old.toml").write_text((path / "calibration" / "Calib_scene.toml").read_text())
    with pytest.raises(
        ValueError, match=r"expected one calibration in TOML, got old.toml, Calib_scene.toml; keep"
    ):
        load_capture(path)


def test_clip_of_camera__finds_a_word_in_one_name():
    clips = ("vid1-camA", "vid1-camB", "cam_1", "cam_10", "x_2", "2_y")
    expected = {
        "camA": "vid1-camA",
        "cam_1": "cam_1",
        "cam_10": "cam_10",
        "10": "cam_10",
        "cam": None,
        "2": None,
    }
    assert {name: clip_of_camera(clips, name) for name in expected} == expected


def test_anipose__reads_a_file_as_the_page_describes_it(tmp_path):
    (tmp_path / "calibration.toml").write_text(EXAMPLE)
    write_video(tmp_path / "trial_1-camA", [np.zeros((720, 1280, 3), np.uint8)], 30)
    (camera,) = load_capture(tmp_path).cameras
    assert camera.name == "trial_1-camA"
    assert_close(camera.position, (0, 0, -4), atol=1e-12)
    assert_close(camera.viewmat[2, :3], (0, 0, 1), atol=1e-12)
    assert camera.K[:2, 2].tolist() == [640, 360]
