"""Live sources: iterators and anything that FFmpeg opens, processed like the rig's clips, in a
loop.
"""

import re
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.calibration import CalibratedImage
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.lens import Lens
from morgs_mi.extras.live.sources import live_frames
from morgs_mi.io.video_writer import write_video
from tests.scenes import captures as layouts
from tests.scenes.live_clip import connection

NAMES = ("cam1", "cam2", "cam3")


@pytest.fixture
def rig(tmp_path, small_images):
    """Three cameras at half size, the second with lens distortion."""
    first, second, third = layouts.rig(NAMES)
    second = CalibratedImage(second, Lens("SIMPLE_RADIAL", (0.2,)))
    write_colmap(tmp_path / "rig/sparse/0", [first, second, third])
    for name in NAMES:
        write_video(tmp_path / "rig" / f"{name}.mkv", clip(), 25)
    return load_capture(tmp_path / "rig", downscale=2)


def clip():
    size = (3, layouts.HEIGHT, layouts.WIDTH, 3)
    return list(np.random.default_rng(3).integers(0, 256, size, np.uint8))


def assert_as_recorded(rig, frames):
    for live, recorded in zip(frames, rig.frames(), strict=True):
        assert live.index == recorded.index
        for a, b in zip(live.images, recorded.images, strict=True):
            assert_array_equal(a, b)


def test_live_frames__process_iterators_and_files_like_clips(rig):
    assert_as_recorded(rig, live_frames(rig, [iter(clip()), clip(), rig.path / "cam3.mkv"]))


def test_live_frames__leave_out_a_source_that_misses_a_timestamp_or_ends(rig):
    a, b, c = clip()
    frames = list(live_frames(rig, [[a, None, c], [a, b], clip()]))
    assert [[image is not None for image in frame.images] for frame in frames] == [
        [1, 1, 1],
        [0, 1, 1],
        [1, 0, 1],
    ]
    assert [frame.problems for frame in frames] == [(), ("cam1: no image",), ("cam2: no image",)]


@pytest.mark.parametrize(
    ("sources", "error", "message"),
    [
        (
            [[]],
            ValueError,
            r"`sources` must be one for each of 3 cameras \(cam1, cam2, cam3\), got 1",
        ),
        (
            [63, [], []],
            OSError,
            "cannot open the source 63; check that it exists and is not in use",
        ),
        ([[], [], "/nowhere/cam.sdp"], OSError, "cannot open the source /nowhere/cam.sdp"),
        (
            [[np.zeros((8, 8, 3), np.uint8)], [], []],
            ValueError,
            r"of cam1 must be uint8 \[46, 62, 3\] as in its clip",
        ),
    ],
)
def test_live_frames__refuse_bad_sources(rig, sources, error, message):
    with pytest.raises(error, match=message):
        list(live_frames(rig, sources))


def test_live_page__loop_runs(rig, monkeypatch):
    """The loop over live frames in docs/live.md, with clips in place of connections."""
    text = (Path(__file__).parents[3] / "docs" / "live.md").read_text(encoding="utf-8")
    *_, example = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    opens = Mock(side_effect=[connection(*clip()) for _ in NAMES])
    loop = Mock(
        **{"return_value.push.return_value": (None, Mock(frame=0, seconds=0.0, missing_views=()))}
    )
    monkeypatch.setattr(cv2, "VideoCapture", opens)
    monkeypatch.setattr("morgs_mi.StreamLoop", loop)
    monkeypatch.setattr("morgs_mi.load_capture", lambda path, downscale: rig)
    monkeypatch.setattr("mitsuba.set_variant", lambda name: None)
    exec(compile(example, "live.md", "exec"), {})
    addresses = [call.args[0] for call in opens.call_args_list]
    assert addresses == [f"rtsp://10.0.0.{k}/live" for k in (10, 11, 12)]
    pushed = [call.args[0] for call in loop().push.call_args_list]
    assert len(pushed) == 3
    assert all(view.image.shape == (23, 31, 3) for view in pushed[0])
