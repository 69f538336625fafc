"""Figures of a stream: names, sizes, and content compared with the truth."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.evaluate.figures import draw_stream, motion_scale
from morgs_mi.playback.streams import open_stream
from morgs_mi.playback.visualise import GAP
from tests.assertions import assert_close
from tests.scenes.moving_splats import FRAMES, HEIGHT, PIXELS, WIDTH, write_stream

LEGEND = 96


def test_draw_stream__writes_every_figure(fitted_clip, tmp_path):
    done = []
    paths = draw_stream(fitted_clip, tmp_path / "new", progress=lambda *count: done.append(count))
    assert [path.name for path in paths] == ["slice.png", "motion.png", "confidence.png"]
    assert done == [(t + 1, FRAMES) for t in range(FRAMES)]
    slices, motion, confidence = (cv2.imread(str(path))[..., ::-1] for path in paths)
    # Three frames fill 320 pixels when each is repeated 107 times; the recording is the rendering.
    assert slices.shape == (HEIGHT, WIDTH + 2 * (GAP + 321), 3)
    recorded = slices[:, WIDTH + GAP :][:, :321]
    rendered = slices[:, -321:]
    np.testing.assert_array_equal(recorded[20:], rendered[20:])
    # Two frames after the first: truth, rendering, and a legend beside the first row.
    assert (
        motion.shape == confidence.shape == (LEGEND + GAP + HEIGHT, 2 * (WIDTH + GAP) + LEGEND, 3)
    )
    mask = confidence[LEGEND + GAP + 15 :, :WIDTH].max(-1) > 128
    true, picture = (
        motion[LEGEND + GAP + 15 :, x : x + WIDTH][mask[: HEIGHT - 15]] for x in (0, WIDTH + GAP)
    )
    assert_close(picture, true, atol=2)


def test_draw_stream__draws_the_stream_alone_without_truth(fitted_clip, tmp_path):
    shutil.copytree(
        fitted_clip / "capture", tmp_path / "capture", ignore=shutil.ignore_patterns("truth")
    )
    paths = draw_stream(fitted_clip, tmp_path, tmp_path / "capture")
    assert cv2.imread(str(paths[1])).shape == (LEGEND + GAP + HEIGHT, WIDTH + GAP + LEGEND, 3)
    for folder, scale in ((fitted_clip, PIXELS), (tmp_path, 0.03 * WIDTH)):
        capture = load_capture(folder / "capture")
        assert motion_scale(capture, capture.cameras[0]) == pytest.approx(scale)


def test_draw_stream__draws_offsets_beside_the_whole_motion(fitted_clip, tmp_path):
    write_stream(tmp_path / "s.morgs", open_stream(fitted_clip).metadata, offset=0.05)
    path = draw_stream(tmp_path / "s.morgs", tmp_path)[-1]
    assert path.name == "offset.png"
    sheet = cv2.imread(str(path))[..., ::-1].astype(int)
    # Two frames after the first: motion, its offset and both legends beside the first row.
    assert sheet.shape == (LEGEND + GAP + HEIGHT, 2 * (WIDTH + GAP) + 2 * LEGEND + GAP, 3)
    motion, offset = (
        sheet[LEGEND + GAP + 15 :, x : x + WIDTH][: HEIGHT - 15] for x in (0, WIDTH + GAP)
    )
    mask = motion[..., 1] < 128  # red: to the right, at full saturation
    assert mask.any()
    # A twentieth of it at a tenth of the scale is half saturated.
    assert np.abs(offset[mask] - (255, 127, 127)).max() <= 3
