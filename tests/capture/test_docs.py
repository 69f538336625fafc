"""The example in docs/captures.md is read as the page describes."""

import re
from pathlib import Path

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from plyfile import PlyData, PlyElement

from morgs_mi.capture.capture import load_capture
from morgs_mi.io.video_writer import write_video

TEXT = (Path(__file__).parents[2] / "docs" / "captures.md").read_text(encoding="utf-8")
(TRANSFORMS,) = re.findall(r"```json\n(.*?)```", TEXT, re.DOTALL)


def test_captures_page__nerfstudio_example_is_read_as_described(tmp_path):
    (tmp_path / "transforms.json").write_text(TRANSFORMS)
    PlyData(
        [PlyElement.describe(np.array([(1, 2, 3)], [(a, "f4") for a in "xyz"]), "vertex")]
    ).write(str(tmp_path / "points.ply"))
    write_video(tmp_path / "cam01", [np.zeros((720, 1280, 3), np.uint8)], 30)
    capture = load_capture(tmp_path)
    camera = capture.cameras[0]
    assert_allclose(camera.position, (5, 6, 7))
    right, down, forward = camera.viewmat[:3, :3]
    assert_allclose(forward, (0, 1, 0), atol=1e-12)
    assert_allclose(-down, (0, 0, 1), atol=1e-12)
    assert_allclose(right, (1, 0, 0), atol=1e-12)
    assert capture.metadata()["cameras"][0]["distortion"] == [-0.05, 0.01, 0, 0]
    assert_array_equal(capture.points, [[1, 2, 3]])
    assert_array_equal(capture.point_colors, [[0.5, 0.5, 0.5]])
