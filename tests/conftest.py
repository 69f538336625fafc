"""One Mitsuba variant for all tests, a capture with a stream that reproduces it exactly, and one of
textured planes.
"""

import json
import os
import signal

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import morgs_mi  # noqa: F401  (finds a usable LLVM before the variant is set)
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.points import match_capture
from morgs_mi.capture.truth import GroundTruth, Tracks, save_tracks, save_truth
from morgs_mi.core.attributes import BY_ACTIVATED_NAME
from morgs_mi.io.video_writer import write_video
from morgs_mi.playback.visualise import to_uint8
from morgs_mi.render.rasterize import rasterize
from morgs_mi.testing import mitsuba_variant  # noqa: F401
from tests.scenes import textured
from tests.scenes.gaussians import NEW_ATTRIBUTES
from tests.scenes.moving_splats import CAMERAS, DISTANCE, FRAMES, PIXELS, STEP, moved, write_stream

# One for all tests, which then share its kernels.
mi.set_variant(os.environ.get("MORGS_MI_TEST_VARIANT", "llvm_ad_rgb"))
# With a single one, Mitsuba waits forever when it writes an EXR file (docs/limits.md).
dr.set_thread_count(max(2, dr.thread_count()))


@pytest.fixture
def heeds_interrupts():
    """Python's handler of SIGINT, which a shell ignores for the processes that it starts in the
    background.
    """
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, handler)


@pytest.fixture
def small_images(monkeypatch):
    """Accept downscaled images that are too small for a fit, which makes tests fast."""
    monkeypatch.setattr("morgs_mi.capture.capture.MIN_SIDE", 1)


@pytest.fixture
def new_attributes(monkeypatch):
    """Add two rows to the table of attributes."""
    for attribute in NEW_ATTRIBUTES:
        monkeypatch.setitem(BY_ACTIVATED_NAME, attribute.activated_name, attribute)


@pytest.fixture(scope="session")
def fitted_clip(tmp_path_factory):
    """A folder with a capture, its ground truth and its stream; all images are rendered from the
    stream.
    """
    folder = tmp_path_factory.mktemp("clip")
    capture = folder / "capture"
    write_colmap(capture / "sparse", CAMERAS)
    for camera in CAMERAS:
        images = [rasterize(moved(t), camera) for t in range(FRAMES)]
        write_video(capture / camera.name, [to_uint8(np.array(i.color)) for i in images], 25)
        for t, image in enumerate(images):
            covered = np.array(image.alpha)[..., 0] > 0
            motion = covered[..., None] * np.float32([PIXELS, 0]) * (t > 0)
            truth = GroundTruth(
                motion, np.float32(DISTANCE * covered), np.where(covered, 0, -1), covered
            )
            save_truth(capture / "truth", camera.name, t, truth)
    steps = np.arange(FRAMES)[:, None] * (STEP, 0, 0)
    corners = np.array([(0.0, 0, 0), (1, 0, 0), (0, 1, 0)])
    tracks = Tracks(corners[:, None] + steps, np.zeros(3, np.int32), {})
    save_tracks(capture / "truth", tracks)
    write_stream(folder / "stream.morgs", {"downscale": 1, "test_view": 0})
    (folder / "capture.json").write_text(json.dumps({"capture": str(capture)}))
    rows = [{"frame": t, "seconds": 3.0 - t} for t in range(FRAMES)]
    (folder / "report.json").write_text(json.dumps({"frames": rows}))
    return folder


@pytest.fixture(scope="session")
def textured_capture(tmp_path_factory):
    """Six cameras in front of textured planes."""
    return textured.write_capture(tmp_path_factory.mktemp("rig"))


@pytest.fixture(scope="session")
def textured_features(textured_capture):
    """The features of `textured_capture` and their matches."""
    return match_capture(textured_capture)
