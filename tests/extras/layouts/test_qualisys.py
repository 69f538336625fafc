"""Calibrations of Qualisys: projections, units, and which cameras have clips."""

import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.extras.layouts.qualisys import read_qualisys
from morgs_mi.io.video_writer import write_video
from morgs_mi.testing import assert_close
from tests.scenes import captures as layouts
from tests.scenes.captures import (
    COUNT,
    DOT,
    FPS,
    LENS,
    assert_dot_is_shown,
    assert_is_rig,
    dot_clips,
    frames,
)

NAMES = ("trial_Miqus_0_26580", "trial_Miqus_1_28984", "trial_Miqus_2_29005")


def test_qualisys__reads_the_cameras_that_have_a_clip(tmp_path, caplog):
    capture = load_capture(layouts.qualisys(tmp_path / "a"))
    assert "no clip is named after 31111: left out." in caplog.text
    assert (capture.layout, capture.names) == ("Qualisys", NAMES)
    assert_is_rig(capture)


def test_qualisys__projects_by_the_conventions_of_the_file(tmp_path):
    """A camera 2 m above the origin looks down, with the world's x axis to its right; the image is
    100 x 80 pixels.
    """
    (tmp_path / "rig.qca.txt").write_text(
        '<calibration><cameras><camera active="1" serial="7" viewrotation="0"><fov_video left="0" '
        'top="0" right="99" bottom="79"/><transform x="0" y="0" z="2000" r11="1" r12="0" r13="0" '
        'r21="0" r22="1" r23="0" r31="0" r32="0" r33="1"/><intrinsic focalLengthU="6400" '
        'focalLengthV="6400" centerPointU="3200" centerPointV="2560" skew="0" '
        'radialDistortion1="-0.1" radialDistortion2="0" radialDistortion3="0" '
        'tangentalDistortion1="0" tangentalDistortion2="0"/></camera></cameras></calibration>'
    )
    (image,) = read_qualisys(tmp_path / "rig.qca.txt")
    camera = image.camera
    assert (camera.width, camera.height, camera.name) == (100, 80, "7")
    pixels, depths = camera.project(np.array([(0, 0, 0), (0.2, 0, 0), (0, 0.2, 1)]))
    # f = 100 px: 0.2 m to the right at 2 m are 10 px; 0.2 m up in the image at 1 m are 20 px.
    assert_close(pixels, np.array([(50, 40), (60, 40), (50, 20)]), atol=1e-9)
    assert depths.tolist() == [2, 2, 1]
    assert image.lens.distortion == (-0.1, 0, 0, 0), "coefficients have no unit"


def test_qualisys__undistorts_a_dot_to_where_the_camera_projects_it(tmp_path):
    path = layouts.qualisys(tmp_path / "a", LENS[:4])
    for file in path.glob("*.mkv"):
        file.unlink()
    dot_clips(path, NAMES, DOT, LENS[:4])
    assert_dot_is_shown(load_capture(path))


def test_qualisys__takes_precedence_over_a_converted_toml(tmp_path):
    """Pose2Sim converts the file into a TOML file, with other distortion coefficients."""
    path = layouts.qualisys(tmp_path / "a")
    (path / "Calib.toml").write_text(
        (layouts.anipose(tmp_path / "b") / "calibration.toml").read_text()
    )
    assert load_capture(path).layout == "Qualisys"


def test_qualisys__warns_of_rotated_views_and_ignores_inactive_cameras(tmp_path, caplog):
    path = layouts.qualisys(tmp_path / "a")
    text = (path / "rig.qca.txt").read_text()
    head, second = text.split('serial="28984"')
    text = (
        head.replace('active="1"', 'active="0"', 1)
        + 'serial="28984"'
        + second.replace('ion="0"', 'ion="180"', 1)
    )
    (path / "rig.qca.txt").write_text(text)
    images = read_qualisys(path / "rig.qca.txt")
    assert [image.name for image in images] == ["28984", "29005", "31111"]
    assert "QTM displays 28984 rotated (viewrotation)" in caplog.text


def test_qualisys__names_the_serial_numbers_if_no_clip_has_one(tmp_path):
    path = layouts.qualisys(tmp_path / "a")
    for file in path.glob("*.mkv"):
        file.unlink()
    write_video(path / "left.mkv", frames(0, COUNT), FPS)
    with pytest.raises(
        FileNotFoundError, match=r"named after its cameras 26580, .*, found left; name the"
    ):
        load_capture(path)
