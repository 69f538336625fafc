"""The demonstration at a small size: its files exist and are consistent."""

from dataclasses import replace

import cv2
import pytest

from morgs_mi import StreamLoop
from morgs_mi.capture.capture import load_capture
from morgs_mi.extras.synth.demo import DemoConfig, _synthesize_clip, run_demo
from morgs_mi.extras.synth.synth_config import SynthConfig
from morgs_mi.io.clip_readers import open_frames
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.platform.bounded import read_json
from morgs_mi.platform.files import locked_folder
from morgs_mi.playback.streams import open_stream
from tests.quick import quick

SMALL = DemoConfig(
    clip=SynthConfig(cameras=6, frames=4, width=64, height=48, spp=4),
    plain_frames=3,
    stream=quick(num_gaussians=500, first_frame_steps=20),
)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    steps = []
    run_demo(folder, SMALL, lambda step, done, total: steps.append(step))
    fits = [f"Fitting: {stage}" for stage in ("balancing cameras", "first frame", "later frames")]
    plain = [
        f"Fitting without ML, MO, MC: {stage}"
        for stage in ("reading the fitted frames", "later frames")
    ]
    assert list(dict.fromkeys(steps))[:6] == ["Path-tracing the clip", *fits, *plain]
    return folder


def test_run_demo__report_is_consistent(out):
    report = read_json(out / "report.json")
    assert (report["full"]["num_frames"], report["plain"]["num_frames"]) == (4, 3)
    comparison = report["comparison"]
    assert comparison["frames"] == [1, 2], (
        "the first frame has no motion, the plain fit no fourth frame"
    )
    errors = [row["motion_error_moving"] for row in report["full"]["frames"][1:3]]
    assert comparison["full"]["motion_error_moving"] == pytest.approx(sum(errors) / 2)
    assert report["full"]["held_out"]
    assert report["full"]["bytes"]["file"] == (out / "stream" / "stream.morgs").stat().st_size
    assert {"machine", "versions", "seed", "seconds"} <= set(report)


def test_run_demo__fits_the_first_frame_once(out):
    """It does not depend on the parts of the motion."""
    first, plain = (next(iter(open_stream(out / name))) for name in ("stream", "stream_plain"))
    capture = load_capture(out / "capture")
    images = next(capture.frames(0, 1)).images
    off = MotionConfig(learn_motion=False, learn_offset=False, learn_confidence=False)
    loop = StreamLoop.of(capture, replace(SMALL.stream, motion=off))
    packet, _ = loop.push([images[view] for view in capture.train_views])
    assert first.encoded == plain.encoded == packet.encoded


def test_run_demo__writes_a_video_and_a_contact_sheet(out):
    images = list(open_frames(out / "side_by_side.mp4").frames())
    assert [image.shape for image in images] == [(48, 4 * 64 + 3 * 4, 3)] * 4
    # Three frames of the full fit and, in the last row, one of the plain fit.
    sheet = cv2.imread(str(out / "contact_sheet.png"))
    assert sheet.shape == (4 * 48 + 3 * 4, 6 * 64 + 5 * 4, 3)


def test_run_demo__reuses_a_clip_with_the_same_settings(out):
    marker = out / "capture" / "marker"
    marker.touch()
    for frames in (4, 1):
        config = replace(SMALL, clip=replace(SMALL.clip, frames=frames))
        _synthesize_clip(out / "capture", config, lambda done, total: None)
        assert marker.exists() == (frames == 4)


def test_run_demo__refuses_a_folder_into_which_another_demo_writes(tmp_path):
    with (
        locked_folder(tmp_path, "test()"),
        pytest.raises(
            BlockingIOError, match="expected a folder into which nothing else is written"
        ),
    ):
        run_demo(tmp_path, SMALL)
    assert list(tmp_path.iterdir()) == []
