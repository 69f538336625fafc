"""True tracks: annotations of TAPVid-3D in world units, and the tracks of synthetic captures as
views see them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.capture.truth import Tracks, save_tracks
from morgs_mi.studio.measures.track_truth import (
    TrackTruth,
    read_annotation,
    synthetic_tracks,
    tapvid3d_tracks,
)
from tests.assertions import assert_close
from tests.scenes import captures as layouts
from tests.scenes.annotations import PATHS, QUERIES, VISIBLE, annotated
from tests.scenes.captures import HEIGHT, WIDTH, rig


def test_tapvid3d_tracks__finds_files_in_the_capture_and_beside_it(tmp_path: Path) -> None:
    """The file of a camera that the rig does not have, and files of other captures, are ignored."""
    path = annotated(tmp_path / "juggle", ("1", "10"))
    (path / "juggle_10.npz").rename(tmp_path / "juggle_10.npz")
    (tmp_path / "juggle_7.npz").write_bytes(b"")
    (tmp_path / "boxes_2.npz").write_bytes(b"")
    tracks = tapvid3d_tracks(load_capture(path))
    assert [truth.cameras[0].name for truth in tracks] == ["1", "10"]
    assert tapvid3d_tracks(load_capture(path, reading=ReadConfig(offset={"1": 1}))) == []
    assert tapvid3d_tracks(load_capture(layouts.nerfstudio(tmp_path / "boxes"))) == []


def test_read_annotation__converts_the_tracks_to_the_world(tmp_path: Path) -> None:
    path = annotated(tmp_path / "juggle", ("1",))
    (truth,) = tapvid3d_tracks(load_capture(path))
    assert_close(truth.points, PATHS, atol=1e-6)
    np.testing.assert_array_equal(truth.visible, VISIBLE)
    assert truth.queries.tolist() == QUERIES.tolist()


def test_read_annotation__names_what_is_wrong(tmp_path: Path) -> None:
    path = annotated(tmp_path / "juggle", ("1",)) / "juggle_1.npz"
    camera = rig(("2", "1"), shift=3)[1]
    good = dict(np.load(path, allow_pickle=True))
    for name, value, message in (
        (
            "visibility",
            good["visibility"][:2],
            r"expected `visibility` \[4, 3\] with 4 frames and 3 points, got bool \[2",
        ),
        ("tracks_XYZ", good["tracks_XYZ"][0], r"expected `tracks_XYZ` \[0, 0, 3\]"),
        (
            "fx_fy_cx_cy",
            2 * good["fx_fy_cx_cy"],
            "expected the intrinsics of camera 1, .* use the annotation of this",
        ),
        ("queries_xyt", good["queries_xyt"] + 4, "frames in `queries_xyt` below 4"),
        ("tracks_XYZ", np.nan * good["tracks_XYZ"], "`tracks_XYZ` must be finite"),
    ):
        np.savez(path, **{**good, name: value})
        with pytest.raises(ValueError, match=message):
            read_annotation(path, camera)
    path.write_bytes(b"no archive")
    with pytest.raises(
        ValueError,
        match=r"juggle_1.npz: expected an array `tracks_XYZ` in a NumPy archive, got a broken",
    ):
        read_annotation(path, camera)


def test_pixel__is_depth_over_focal_length_at_256_pixels() -> None:
    """At half the resolution, the shorter side of an image has 46 pixels: f is 256 / 46 times as
    long.
    """
    camera = rig(("a",))[0]
    points = camera.unproject(np.array([[(3.0, 4.0), (50, 20)]]), np.array([[2.0, 5.0]]))
    for view in (camera, camera.resized(2 * WIDTH, 2 * HEIGHT)):
        pixel = TrackTruth((view,), points, None, np.zeros(1, int)).pixel
        assert pixel is not None
        assert_close(pixel, np.array([[2, 5]]) / (camera.K[0, 0] * 256 / HEIGHT), atol=1e-12)
    assert TrackTruth((camera, camera), points, None, np.zeros(1, int)).pixel is None


def test_synthetic_tracks__start_where_a_view_first_sees_them(
    fitted_clip: Path, tmp_path: Path
) -> None:
    capture = load_capture(fitted_clip / "capture")
    (unknown,) = synthetic_tracks(capture, [0])
    assert unknown.visible is None
    assert unknown.queries.tolist() == [0, 0, 0]
    visibility = {"cam0": ["001", "000", "000"], "cam1": ["010", "110", "000"]}
    masks = {
        name: np.array([[c == "1" for c in row] for row in rows])
        for name, rows in visibility.items()
    }
    save_tracks(tmp_path, Tracks(unknown.points, np.zeros(3, np.int32), masks))
    capture = type(capture)(**{**vars(capture), "truth": tmp_path})
    (both,) = synthetic_tracks(capture, [0, 1])
    assert (both.queries.tolist(), len(both.points)) == ([1, 0], 2)
    (first,) = synthetic_tracks(capture, [0])
    assert first.queries.tolist() == [2]
    np.testing.assert_array_equal(first.points, unknown.points[:1])
    assert synthetic_tracks(type(capture)(**{**vars(capture), "truth": None}), [0]) == []
