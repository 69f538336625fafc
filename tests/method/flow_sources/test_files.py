"""Flow from files: reading inverts writing, and errors name the file."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from morgs_mi.io.exr import write_exr
from morgs_mi.method.flow import observe_key_views
from morgs_mi.method.flow_sources.files import FlowFolder, read_flow
from morgs_mi.method.flow_sources.flow_registry import FLOW_SOURCES, FramePair


def random_flow(height=6, width=9, seed=0):
    return np.random.default_rng(seed).normal(0, 30, (height, width, 2)).astype(np.float32)


def write_flow(path: Path, flow: np.ndarray) -> None:
    """Write a flow as OpenCV does, or as an EXR file."""
    if path.suffix == ".exr":
        write_exr(path, dict(zip(("flow.X", "flow.Y"), np.moveaxis(flow, 2, 0), strict=True)))
    else:
        cv2.writeOpticalFlow(str(path), flow)


@pytest.fixture
def folder(tmp_path):
    """Flow of one camera between frames 0, 1 and 2, named as flow tools do."""
    for direction, frames in (("forward", (0, 1)), ("backward", (1, 2))):
        (tmp_path / "cam00" / direction).mkdir(parents=True)
        for frame in frames:
            seed = frame + 10 * (direction == "forward")
            write_flow(
                tmp_path / "cam00" / direction / f"v2_frame_{frame:04d}.flo", random_flow(seed=seed)
            )
    return tmp_path


@pytest.mark.parametrize("name", ["a.flo", "a.exr", "A.FLO"])
@pytest.mark.parametrize("size", [(6, 9), (1, 1), (33, 2)])
def test_read_flow__reads_files_of_opencv_and_exr_files(tmp_path, name, size):
    flow = random_flow(*size)
    write_flow(tmp_path / name, flow)
    read = read_flow(tmp_path / name)
    np.testing.assert_array_equal(read, flow)
    assert read.dtype == np.float32


@pytest.mark.parametrize("names", ["XY", "uv", "RG", "RGB"])
def test_read_flow__accepts_exr_channels_of_other_programs(tmp_path, names):
    flow = random_flow()
    x = flow[..., 0]
    y = flow[..., 1]
    write_exr(tmp_path / "a.exr", dict(zip(names, (x, y, 0 * x), strict=False)))
    np.testing.assert_array_equal(read_flow(tmp_path / "a.exr"), flow)


def test_flow_source__reads_both_directions_of_a_frame(folder):
    for file in list(folder.rglob("*.flo")):
        file.with_name(f"._{file.name}").touch()  # macOS adds these
    for frame in (1, 2):
        images = np.zeros((2, 6, 9, 3), np.uint8)
        pair = FramePair(*images, camera="cam00", frame=frame)
        back, forward_flow = FLOW_SOURCES.make(f"files:{folder}")(pair)
        np.testing.assert_array_equal(back, random_flow(seed=frame))
        np.testing.assert_array_equal(forward_flow, random_flow(seed=frame - 1 + 10))


def test_observe_key_views__negates_and_checks_flow_from_files(tmp_path):
    forward_flow = np.full((40, 60, 2), (3, 1), np.float32)
    back = -forward_flow
    back[:, :10] = (5, 5)  # the forward flow there does not lead back
    for direction, frame, flow in (("backward", 7, back), ("forward", 6, forward_flow)):
        (tmp_path / "cam01" / direction).mkdir(parents=True)
        write_flow(tmp_path / "cam01" / direction / f"{frame}.exr", flow)
    images = np.zeros((2, 40, 60, 3), np.uint8)
    pair = FramePair(*images, camera="cam01", frame=7)
    observation = observe_key_views({5: pair}, f"files:{tmp_path}")[5]
    np.testing.assert_array_equal(observation.motion[:, 10:], forward_flow[:, 10:])
    np.testing.assert_array_equal(observation.forward_flow, forward_flow)
    assert observation.reliable[3:, 12:].all()
    assert not observation.reliable[:, :10].any()


def flo(magic=202021.25, width=3, height=2, values=12):
    header = np.array([magic], "<f4").tobytes() + np.array([width, height], "<i4").tobytes()
    return header + np.zeros(values, "<f4").tobytes()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (flo(magic=1.0), "begins with the float 202021.25, got b'"),
        (b"", "begins with the float 202021.25"),
        (flo()[:8], "12 bytes for 3x0 pixels, got 8"),
        (flo(values=11), "60 bytes for 3x2 pixels, got 56; the file may be cut short"),
        (flo(values=14), "60 bytes for 3x2 pixels, got 68"),
        (flo(width=-3), "for -3x2 pixels"),
        (flo()[:-4] + np.float32(np.nan).tobytes(), "none at 1 of 6, the first at x=2, y=1"),
        (flo()[:-4] + np.float32(1.7e9).tobytes(), "none at 1 of 6"),
    ],
)
def test_read_flow__rejects_a_broken_flo_file(tmp_path, content, message):
    (tmp_path / "bad.flo").write_bytes(content)
    with pytest.raises(ValueError, match=rf"bad\.flo: expected (.* )?{message}"):
        read_flow(tmp_path / "bad.flo")


def test_read_flow__rejects_missing_and_foreign_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="expected a flow file, found none"):
        read_flow(tmp_path / "none.flo")
    with pytest.raises(ValueError, match=r"must end in \.flo or \.exr, got 'a\.png'"):
        read_flow(tmp_path / "a.png")
    (tmp_path / "a.exr").write_bytes(b"no image")
    with pytest.raises(OSError, match="cannot read"):
        read_flow(tmp_path / "a.exr")


@pytest.mark.parametrize(
    "names",
    [
        ("motion.X", "motion.Y"),
        ("B", "G", "R", "motion.X", "motion.Y"),
        ("X", "Y", "u", "v"),
        ("u",),
    ],
)
def test_read_flow__rejects_channels_that_are_not_flow(tmp_path, names):
    # The renderer's motion points the other way, and the colours beside it are not flow.
    write_exr(tmp_path / "b.exr", dict.fromkeys(names, np.zeros((2, 2))))
    with pytest.raises(ValueError, match=rf"flow\.X/flow\.Y.*, got {', '.join(names)}\."):
        read_flow(tmp_path / "b.exr")


@pytest.mark.parametrize(
    ("camera", "frame", "size", "exception", "message"),
    [
        (
            "cam00",
            3,
            (6, 9),
            FileNotFoundError,
            "cam00/backward: .* of frame 3, found files of frames 1 to 2; name",
        ),
        (
            "cam01",
            1,
            (6, 9),
            FileNotFoundError,
            "cam01/backward: .* of frame 1, found no flow at all",
        ),
        (
            "cam00",
            1,
            (9, 6),
            ValueError,
            r"0001\.flo: expected 6x9 pixels as the images of cam00 have, got 9x6",
        ),
    ],
)
def test_flow_folder__rejects_missing_frames_and_other_sizes(
    folder, camera, frame, size, exception, message
):
    with pytest.raises(exception, match=message):
        FlowFolder(folder).flows(camera, frame, size)


def test_flow_folder__rejects_two_files_of_one_frame(folder):
    write_flow(folder / "cam00/backward/frame_1.exr", random_flow())
    with pytest.raises(ValueError, match=r"one file of number 1, got frame_1 and v2_frame_0001"):
        FlowFolder(folder).flows("cam00", 1, (6, 9))


def test_flow_source__rejects_a_missing_flow_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match="expected a folder of flow files, found none"):
        FLOW_SOURCES.make(f"files:{tmp_path / 'flow'}")


def test_FlowFolder__lists_a_folder_again_only_for_a_file_that_was_added(folder, monkeypatch):
    listed = []
    iterdir = Path.iterdir
    monkeypatch.setattr(Path, "iterdir", lambda path: [listed.append(path), *iterdir(path)][1:])
    flows = FlowFolder(folder)
    for frame in (1, 2, 1, 2):
        flows.flows("cam00", frame, (6, 9))
    assert len(listed) == 2
    write_flow(folder / "cam00" / "backward" / "3.flo", random_flow())
    write_flow(folder / "cam00" / "forward" / "2.flo", random_flow())
    flows.flows("cam00", 3, (6, 9))
    assert len(listed) == 4
