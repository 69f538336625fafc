"""Calibrations of EasyMocap and EasyVolcap: forms of the files, and projections against OpenCV."""

import cv2
import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
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
    videos,
)

EXTRINSICS = """\
%YAML:1.0
---
names:
  - "01"
R_01: !!opencv-matrix
  rows: 3
  cols: 1
  dt: d
  data: [0.0, 0.0, 0.0]
T_01: !!opencv-matrix
  rows: 3
  cols: 1
  dt: d
  data: [0.0, 0.0, 4.0]
"""


@pytest.mark.parametrize("clips", [layouts.folder_per_camera, videos])
def test_easymocap__reads_cameras_and_their_clips(tmp_path, caplog, clips):
    path = layouts.easymocap(tmp_path / "a", clips=clips)
    capture = load_capture(path)
    assert (capture.layout, capture.names) == ("EasyMocap", ("1", "2", "10"))
    assert (capture.num_frames, len(capture.points)) == (layouts.COUNT, 0)
    assert_is_rig(capture)
    assert caplog.messages == [f"{path / 'extri.yml'}: no clip is named after 31: left out."]


@pytest.mark.parametrize(
    ("lens", "key"), [(LENS[:4], "dist"), (LENS, "D"), ((*LENS, 0.02, 0.01, 0.005), "dist")]
)
def test_easymocap__undistorts_a_dot_to_where_the_camera_projects_it(tmp_path, lens, key):
    path = layouts.easymocap(
        tmp_path / "a", lens, lambda folder, names: dot_clips(folder, names, DOT, lens), key
    )
    assert_dot_is_shown(load_capture(path))


def test_easymocap__reads_rotation_vectors_and_no_lens(tmp_path):
    path = layouts.easymocap(tmp_path / "a")
    for name, old, new in (("extri", "Rot_", "P_"), ("intri", "dist_", "P_")):
        file = path / f"{name}.yml"
        file.write_text(file.read_text().replace(old, new))
    capture = load_capture(path)
    assert_is_rig(capture)
    assert {camera["lens"] for camera in capture.metadata()["cameras"]} == {"PINHOLE"}


def test_easymocap__reads_the_sizes_of_easyvolcap_and_scales_the_clips(tmp_path):
    path = layouts.easymocap(tmp_path / "a")
    with (path / "intri.yml").open("a") as file:
        file.write(f"W_2: {2.0 * WIDTH}\nH_2: {2 * HEIGHT}\n")
    first, second, _ = load_capture(path).cameras
    assert second.size == first.size
    assert_close(first.K[:2, 2], (WIDTH / 2 + 3, HEIGHT / 2 - 3), atol=1e-6)
    assert_close(second.K[:2, 2], (WIDTH / 4 + 1.5, HEIGHT / 4 - 1.5), atol=1e-6)


def test_easymocap__prefers_the_optimised_cameras_of_selfcap(tmp_path):
    path = layouts.easymocap(tmp_path / "a")
    broken = (path / "extri.yml").read_text()[:100]
    (path / "optimized").mkdir()
    for name in ("intri.yml", "extri.yml"):
        (path / name).rename(path / "optimized" / name)
        (path / name).write_text(broken)
    assert_is_rig(load_capture(path))


def test_easymocap__uses_no_silhouettes_as_masks(tmp_path, caplog):
    path = layouts.easymocap(tmp_path / "a")
    (path / "masks" / "2").mkdir(parents=True)
    silhouette = np.zeros((HEIGHT, WIDTH), np.uint8)
    silhouette[10:20, 20:40] = 255
    cv2.imwrite(str(path / "masks" / "2" / "000000.png"), silhouette)
    assert load_capture(path).masks == (None, None, None)
    assert f"{path / 'masks'}: not used, because masks of each frame are not read." in caplog.text


def test_easymocap__reads_files_as_the_page_describes_them(tmp_path):
    (tmp_path / "extri.yml").write_text(EXTRINSICS)
    (tmp_path / "intri.yml").write_text(
        "%YAML:1.0\n---\nK_01: !!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n"
        "  data: [900., 0., 639.5, 0., 900., 359.5, 0., 0., 1.]\n"
    )
    layouts.write_image(tmp_path / "images" / "01" / "000000.jpg", 0, 0)
    (camera,) = load_capture(tmp_path).cameras
    assert (camera.name, camera.size) == ("01", (WIDTH, HEIGHT))
    assert_close(camera.position, (0, 0, -4), atol=1e-12)
    assert camera.K[:2, 2].tolist() == [640, 360]
