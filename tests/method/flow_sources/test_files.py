"""Flow from files: reading inverts writing, and errors name the file."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.io.exr import write_exr
from morgs_mi.method.flow import observe_key_views
from morgs_mi.method.flow_sources.files import read_flow
from morgs_mi.method.flow_sources.flow_registry import FLOW_SOURCES, FramePair


def random_flow(height=6, width=9, seed=0):
    return np.random.default_rng(seed).normal(0, 30, (height, width, 2)).astype(np.float32)


def write_flow(path, flow):
    """Write a flow as OpenCV does, or as an EXR file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".exr":
        write_exr(path, dict(zip(("flow.X", "flow.Y"), np.moveaxis(flow, 2, 0), strict=True)))
    else:
        cv2.writeOpticalFlow(str(path), flow)


def pair_of(camera="cam00", frame=1, size=(6, 9)):
    return FramePair(*np.zeros((2, *size, 3), np.uint8), camera=camera, frame=frame)


@pytest.fixture
def folder(tmp_path):
    """Flow of one camera between frames 0, 1 and 2, named as flow tools do."""
    for direction, frames in (("forward", (0, 1)), ("backward", (1, 2))):
        for frame in frames:
            flow = random_flow(seed=frame + 10 * (direction == "forward"))
            write_flow(tmp_path / "cam00" / direction / f"v2_frame_{frame:04d}.flo", flow)
    return tmp_path


@pytest.mark.parametrize("name", ["a.exr", "A.FLO"])
@pytest.mark.parametrize("size", [(1, 1), (33, 2)])
def test_read_flow__reads_files_of_opencv_and_exr_files(tmp_path, name, size):
    flow = random_flow(*size)
    write_flow(tmp_path / name, flow)
    read = read_flow(tmp_path / name)
    assert_array_equal(read, flow)
    assert read.dtype == np.float32


@pytest.mark.parametrize("names", ["XY", "uv", "RGB"])
def test_read_flow__accepts_exr_channels_of_other_programs(tmp_path, names):
    flow = random_flow()
    x, y = np.moveaxis(flow, 2, 0)
    write_exr(tmp_path / "a.exr", dict(zip(names, (x, y, 0 * x), strict=False)))
    assert_array_equal(read_flow(tmp_path / "a.exr"), flow)


def test_flow_source__reads_both_directions_of_a_frame(folder):
    for file in list(folder.rglob("*.flo")):
        file.with_name(f"._{file.name}").touch()  # macOS adds these
    for frame in (1, 2):
        back, forward_flow = FLOW_SOURCES.make(f"files:{folder}")(pair_of(frame=frame))
        assert_array_equal(back, random_flow(seed=frame))
        assert_array_equal(forward_flow, random_flow(seed=frame - 1 + 10))


def test_observe_key_views__negates_and_checks_flow_from_files(tmp_path):
    forward_flow = np.full((40, 60, 2), (3, 1), np.float32)
    back = -forward_flow
    back[:, :10] = (5, 5)  # the forward flow there does not lead back
    write_flow(tmp_path / "cam01/backward/7.exr", back)
    write_flow(tmp_path / "cam01/forward/6.exr", forward_flow)
    pair = pair_of("cam01", 7, (40, 60))
    observation = observe_key_views({5: pair}, f"files:{tmp_path}")[5]
    assert_array_equal(observation.motion[:, 10:], forward_flow[:, 10:])
    assert_array_equal(observation.forward_flow, forward_flow)
    assert observation.reliable[3:, 12:].all()
    assert not observation.reliable[:, :10].any()


def flo(magic=202021.25, width=3, height=2, values=12):
    header = np.array([magic], "<f4").tobytes() + np.array([width, height], "<i4").tobytes()
    return header + np.zeros(values, "<f4").tobytes()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (flo(magic=1.0), "begins with the float 202021.25, got b'"),
        (flo(values=11), "60 bytes for 3x2 pixels, got 56; the file may be cut short"),
        (flo(width=-3), "for -3x2 pixels"),
        (flo()[:-4] + np.float32(np.nan).tobytes(), "none at 1 of 6, the first at x=2, y=1"),
    ],
)
def test_read_flow__rejects_a_broken_flo_file(tmp_path, content, message):
    (tmp_path / "bad.flo").write_bytes(content)
    with pytest.raises(ValueError, match=rf"bad\.flo: expected (.* )?{message}"):
        read_flow(tmp_path / "bad.flo")


@pytest.mark.parametrize("names", [("B", "G", "R", "motion.X", "motion.Y"), ("X", "Y", "u", "v")])
def test_read_flow__rejects_channels_that_are_not_flow(tmp_path, names):
    # The renderer's motion points the other way, and the colours beside it are not flow.
    write_exr(tmp_path / "b.exr", dict.fromkeys(names, np.zeros((2, 2))))
    with pytest.raises(ValueError, match=rf"flow\.X/flow\.Y.*, got {', '.join(names)}\."):
        read_flow(tmp_path / "b.exr")


@pytest.mark.parametrize(
    ("pair", "exception", "message"),
    [
        (
            pair_of(frame=3),
            FileNotFoundError,
            "cam00/backward: .* of frame 3, found files of frames 1 to 2; name",
        ),
        (
            pair_of("cam01"),
            FileNotFoundError,
            "cam01/backward: .* of frame 1, found no flow at all",
        ),
        (
            pair_of(size=(9, 6)),
            ValueError,
            r"0001\.flo: expected 6x9 pixels as the images of cam00 have, got 9x6",
        ),
        (pair_of("cam02"), ValueError, "one number .* got a_1.exr followed by b_1.flo"),
    ],
)
def test_flow_source__rejects_missing_and_broken_files_and_other_sizes(
    folder, pair, exception, message
):
    for name in ("cam02/backward/a_1.exr", "cam02/backward/b_1.flo"):
        write_flow(folder / name, random_flow())
    with pytest.raises(exception, match=message):
        FLOW_SOURCES.make(f"files:{folder}")(pair)


def test_flow_source__rejects_a_missing_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match="expected a folder of flow files, found none"):
        FLOW_SOURCES.make(f"files:{tmp_path / 'flow'}")
