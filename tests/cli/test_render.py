"""`morgs-mi render`: bad input, and outputs that could not be finished."""

import cv2
import numpy as np
import pytest

from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import keyframe_packet
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.io.exr import read_exr
from tests.cli.commands import assert_one_sentence, assert_refused, interrupt
from tests.scenes.changing_splats import write_stream
from tests.scenes.full_disk import files_end_at
from tests.scenes.noise_capture import rig


@pytest.mark.parametrize(
    ("args", "parts"),
    [
        (["--camera", "3"], ("index in 0..2 or one of cam0, cam1, cam2, got '3'",)),
        (
            ["--camera", "0", "--channels", "confidence"],
            ("channel 'confidence' requires Gaussians with `logit_confidence`",),
        ),
    ],
)
def test_render__rejects_bad_input_in_one_sentence(stream, tmp_path, run, args, parts):
    assert_refused(run("render", stream, *args), *parts)
    assert list(tmp_path.iterdir()) == [stream]


def test_render__draws_a_stream_without_gaussians_black(tmp_path, run):
    empty = Gaussians(*(np.zeros((0, *tail)) for tail in ((3,), (3,), (4,), (), (1, 3))))
    with StreamWriter(tmp_path / "s.morgs", rig(), 25) as writer:
        writer.write(keyframe_packet(empty, 0))
    assert run("render", tmp_path / "s.morgs", tmp_path / "exr", "--camera", 0)[0] == 0
    assert not any(channel.any() for channel in read_exr(tmp_path / "exr" / "0000.exr").values())


def test_render__draws_motion_over_the_grey_colour_also_alone(stream, tmp_path, run):
    args = ("--camera", "cam0", "--channels")
    assert run("render", stream, tmp_path / "motion_png", *args, "motion")[0] == 0
    assert run("render", stream, tmp_path / "both_png", *args, "motion", "color")[0] == 0
    motion = cv2.imread(str(tmp_path / "motion_png" / "0001.png"))
    both = cv2.imread(str(tmp_path / "both_png" / "0001.png"))
    assert motion.shape[1] < both.shape[1] / 2
    np.testing.assert_array_equal(motion, both[:, : motion.shape[1]])


@pytest.mark.parametrize(
    "args",
    [
        ("render", "--path", "between", "--width", 16),
        ("export", "video", "--width", 16, "--least-seconds", 0),
        ("export", "web"),
    ],
    ids=lambda args: " ".join(args[:2]),
)
def test_outputs_between_the_cameras__say_once_what_the_fit_expects(
    stream, tmp_path, run, far_cameras, args
):
    command, *options = args
    kind = [options.pop(0)] if command == "export" else []
    assert "between the cameras" not in run(command, *kind, stream, *options)[1]
    (tmp_path / "report.json").write_text(far_cameras)
    status, output, _ = run(command, *kind, stream, *options)
    assert status == 0
    assert output.count("Views between the cameras: poor (58 degrees apart).") == 1


@pytest.mark.parametrize("name", ["a.mp4", "exr"])
def test_render__removes_its_output_on_a_full_disk(stream, tmp_path, run, name):
    # Compiled kernels are cached on disk too.
    run("render", stream, tmp_path / f"warm-{name}", "--camera", 0)
    with files_end_at(200):
        status, _, error = run("render", stream, tmp_path / name, "--camera", 0)
    assert status == 1
    assert_one_sentence(error, name)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["good.morgs", f"warm-{name}"]


def test_render__removes_its_output_when_interrupted(stream, tmp_path, run, monkeypatch):
    monkeypatch.setattr("morgs_mi.playback.player.rasterize", interrupt)
    status, _, error = run("render", stream, "--camera", 0)
    assert status == 130
    assert_one_sentence(error, "Interrupted")
    assert list(tmp_path.iterdir()) == [stream]


def test_render__skips_damaged_frames_when_asked(tmp_path, run, caplog):
    path = tmp_path / "stream.morgs"
    write_stream(path, 6, keyframe_interval=3)
    _, _, offset = next(entry for entry in StreamReader(path).index() if entry[1] == 1)
    data = bytearray(path.read_bytes())
    data[offset + 40] ^= 1
    path.write_bytes(data)
    render = ("render", path, tmp_path / "png", "--camera", 0, "--width", 32)
    assert_refused(
        run(*render), f"packet 2 at byte {offset}: ", "the bytes are damaged", "up to frame 0"
    )
    assert run(*render, "--skip-damaged")[0] == 0
    assert sorted(image.name for image in (tmp_path / "png").iterdir()) == [
        "0000.png",
        *(f"000{k}.png" for k in (3, 4, 5)),
    ]
    assert caplog.messages == [f"{path}: the damaged frames 1, 2 are skipped."]


def test_render__warns_of_the_end_of_a_stream_that_was_not_closed(stream, tmp_path, run, caplog):
    stream.write_bytes(stream.read_bytes()[: StreamReader(stream).index()[1][2] + 30])
    assert (
        run("render", stream, tmp_path / "png", "--camera", 0, "--width", 32, "--skip-damaged")[0]
        == 0
    )
    assert caplog.messages == [
        f"{stream}: it ends after 1 packet without an index, and may lack later frames."
    ]
