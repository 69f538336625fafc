"""The command line: the whole way from a scene to figures, and bad input that gets one sentence."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from morgs_mi import cli
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import keyframe_packet, play, reemitted_keyframe
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.io.exr import read_exr
from morgs_mi.io.video_writer import write_video
from morgs_mi.stream_loop import StreamLoop
from tests.export.streams import write_stream

WIDTH, HEIGHT, FRAMES = 48, 32, 3
NAMES = ("cam0", "cam1", "cam2")
# As little work as a fit can do.
QUICK = ["--fit.num-gaussians", "120", "--fit.first-frame-steps", "4", "--fit.epochs", "1", "--fit.sh-degree", "0"]


def run(capsys: pytest.CaptureFixture[str], *args: object) -> tuple[int, str, str]:
    status = cli.main([str(a) for a in args])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def rig() -> list[Camera]:
    places = [(-0.4, 0, -3), (0, 0, -3), (0.4, 0, -3)]
    return [Camera.look_at(p, (0, 0, 0), (0, -1, 0), 60, WIDTH, HEIGHT, n) for p, n in zip(places, NAMES, strict=True)]


def clip(count: int = FRAMES) -> list[np.ndarray]:
    return [
        np.roll(np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8), t, 1) for t in range(count)
    ]


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Three cameras that see noise go by, in .mkv, whose frames before a cut can be read."""
    path = tmp_path / "capture"
    points = np.random.default_rng(1).uniform(-1, 1, (150, 3))
    write_colmap(path / "sparse" / "0", rig(), points, np.abs(points))
    for name in NAMES:
        write_video(path / f"{name}.mkv", clip(), 25)
    return path


@pytest.fixture
def stream(tmp_path: Path) -> Path:
    """A stream of one splat in two frames."""
    path = tmp_path / "good.morgs"
    splat = Gaussians.from_activated([[0, 0, 0]], [[0.3] * 3], [[1, 0, 0, 0]], [0.9], [[[1.0, 0, 0]]])
    with StreamWriter(path, rig(), 25) as writer:
        writer.write(keyframe_packet(splat, 0))
        writer.write(keyframe_packet(splat, 1))
    return path


def assert_one_sentence(error: str, *parts: str) -> None:
    lines = [line for line in error.splitlines() if line.strip() and "━" not in line]
    assert len(lines) == 1, error
    assert "Traceback" not in error
    for part in parts:
        assert part in lines[0]


# What is done to the capture, and what the sentence about it must hold.
def no_capture(path: Path) -> tuple[str, ...]:
    path.rename(path.with_name("elsewhere"))
    return "expected a capture folder", str(path)


def no_clip(path: Path) -> tuple[str, ...]:
    (path / "cam1.mkv").unlink()
    return "its image 'cam1.png' needs a clip called cam1", "found cam0, cam2"


def no_calibration(path: Path) -> tuple[str, ...]:
    (path / "sparse").rename(path / "dense")
    return ("expected a calibration",)


def other_length(path: Path) -> tuple[str, ...]:
    write_video(path / "cam2.mkv", clip(FRAMES + 2), 25)
    return "the same number of frames", "cam2.mkv 5"


def empty_clip(path: Path) -> tuple[str, ...]:
    (path / "cam1.mkv").write_bytes(b"")
    return "cam1.mkv", "got an empty file"


def no_video(path: Path) -> tuple[str, ...]:
    (path / "cam1.mkv").write_bytes(b"no video" * 100)
    return "cam1.mkv", "truncated or no video"


def truncated_clip(path: Path) -> tuple[str, ...]:
    data = (path / "cam1.mkv").read_bytes()
    (path / "cam1.mkv").write_bytes(data[: len(data) * 2 // 3])
    return "cam1.mkv: frame ", "cannot be read", "truncated"


def broken_json(path: Path) -> tuple[str, ...]:
    (path / "capture.json").write_text("{")
    return ("capture.json: expected JSON",)


BROKEN = [no_capture, no_clip, no_calibration, other_length, empty_clip, no_video, truncated_clip, broken_json]


@pytest.mark.parametrize("spoil", BROKEN)
def test_a_broken_capture(capture: Path, tmp_path: Path, capsys, spoil) -> None:
    parts = spoil(capture)
    for args in (("info", capture), ("fit", capture, tmp_path / "out", *QUICK)):
        status, _, error = run(capsys, *args)
        assert status == 1
        assert_one_sentence(error, *parts)
    assert not (tmp_path / "out").exists()


def test_a_clip_cut_off_meanwhile_leaves_its_camera_out_of_the_rest(
    capture: Path, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    truncated_clip(capture)
    monkeypatch.setattr("morgs_mi.io.video._count_packets", lambda path: FRAMES)
    assert run(capsys, "fit", capture, tmp_path / "out", *QUICK)[0] == 0
    frames = json.loads((tmp_path / "out" / "report.json").read_text())["frames"]
    assert [frame["left_out"] for frame in frames] == [[], ["cam1"], ["cam1"]]
    assert "cam1.mkv: frame 1 of 3 cannot be decoded" in frames[2]["status"]
    assert run(capsys, "eval", tmp_path / "out", "--json", tmp_path / "eval.json")[0] == 0
    frames = json.loads((tmp_path / "eval.json").read_text())["frames"]
    assert [frame["views"]["cam1"]["psnr"] is None for frame in frames] == [False, True, True]
    assert all(frame["psnr"] > 0 for frame in frames)


def test_a_fit_and_its_evaluation_put_the_clips_on_the_same_clock(capture: Path, tmp_path: Path, capsys) -> None:
    other_length(capture)
    out, options = tmp_path / "out", ("--offset", "cam1", "-1", "cam2", "1", "--exposure")
    assert run(capsys, "info", capture, "--no-check", *options)[1].count("2 frames at 25 fps") == 1
    assert run(capsys, "fit", capture, out, *options, *QUICK)[0] == 0
    record = json.loads((out / "capture.json").read_text())
    assert (record["frames"], record["reading"]["offset"]) == (2, {"cam1": -1, "cam2": 1})
    assert [camera["first_frame"] for camera in record["cameras"]] == [1, 0, 2]
    assert run(capsys, "eval", out, "--json", tmp_path / "eval.json")[0] == 0
    result = json.loads((tmp_path / "eval.json").read_text())
    assert (result["complete"], result["num_frames"]) == (True, 2)


def test_an_interrupted_fit_leaves_a_stream_that_says_it_is_not_whole(
    capture: Path, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    push = StreamLoop.push

    def interrupted(loop: StreamLoop, *args: object):
        if loop.state.frame == 2:
            raise KeyboardInterrupt
        return push(loop, *args)

    monkeypatch.setattr(StreamLoop, "push", interrupted)
    assert run(capsys, "fit", capture, tmp_path / "out", *QUICK)[0] == 130
    status, _, error = run(capsys, "eval", tmp_path / "out", "--json", tmp_path / "eval.json")
    assert status == 0
    assert "the fit was not finished" in error
    assert not json.loads((tmp_path / "eval.json").read_text())["complete"]


@pytest.mark.parametrize(
    ("args", "parts"),
    [
        (["--frames", "0"], ("`max_frames` must be at least 1 or None, got 0",)),
        (["--downscale", "0.5"], ("`downscale` must be at least 1, got 0.5",)),
        (["--test-view", "3"], ("`test_view` must be in 0..2", "got 3")),
        (["--preset", "s", "--fit.epochs", "3"], ("preset 's' sets `epochs` to 5", "given as 3")),
        (["--variant", "cuda_ad_rgb"], ("--variant cuda_ad_rgb cannot be used here", "llvm_ad_rgb")),
    ],
)
def test_bad_settings(capture: Path, tmp_path: Path, capsys, args, parts) -> None:
    if "cuda_ad_rgb" in args and Path("/dev/nvidiactl").exists():
        pytest.skip("this machine has a GPU")
    status, _, error = run(capsys, "fit", capture, tmp_path / "out", *args)
    assert status == 1
    assert_one_sentence(error, *parts)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("args", "part"),
    [
        (["--fit.num-gaussians", "0"], "`num_gaussians` must be at least 1, got 0"),
        (["--motion.flow-method", "none"], "`flow_method` must be one of"),
        (["--render.block-width", "17"], "`block_width` must be 4, 8, 12 or 16"),
        (["--fit.rates.means", "nan"], "`means` must be finite and not negative"),
        (["--fit.epochs", "many"], "many"),
        (["--nonsense"], "--nonsense"),
    ],
)
def test_arguments_that_the_parser_refuses(capture: Path, tmp_path: Path, capsys, args, part) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["fit", str(capture), str(tmp_path / "out"), *args])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert part in " ".join(error.replace("│", " ").split())
    assert not (tmp_path / "out").exists()


def test_an_output_that_cannot_be_written(capture: Path, stream: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "file").write_text("")
    for args in (
        ("fit", capture, tmp_path / "file" / "out", *QUICK),
        ("synth", "spheres", tmp_path / "file" / "out", "--cameras", 2, "--frames", 1, "--width", 16, "--height", 16),
        ("render", stream, "--camera", 0, "--output", tmp_path / "file" / "a.mp4"),
        ("render", stream, "--camera", 0, "--output", tmp_path / "file" / "exr"),
        ("demo", tmp_path / "file" / "out"),
    ):
        status, _, error = run(capsys, *args)
        assert status == 1
        assert_one_sentence(error, str(tmp_path / "file"))


@pytest.mark.parametrize(
    ("damage", "parts"),
    [
        (lambda data: b"", ("the header is missing",)),
        (lambda data: b"not a stream", ("expected a stream that starts with",)),
        (lambda data: data[:-75], ("truncated or still written", "packet 2", "2 packets before it are intact")),
        (lambda data: data[:-5] + b"\1" * 5, ("the bytes are damaged",)),
    ],
)
def test_a_broken_stream(stream: Path, tmp_path: Path, capsys, damage, parts) -> None:
    stream.write_bytes(damage(stream.read_bytes()))
    outputs = [tmp_path / "a.mp4", tmp_path / "exr", tmp_path / "png"]
    commands = [("render", stream, "--camera", 0, "--output", output) for output in outputs]
    for args in (*commands, ("eval", stream, "--capture", tmp_path)):
        status, _, error = run(capsys, *args)
        assert status == 1
        assert_one_sentence(error, str(stream), *parts)
    assert list(tmp_path.iterdir()) == [stream]


@pytest.mark.parametrize(
    ("args", "parts"),
    [
        (["--camera", "3"], ("index in 0..2 or one of cam0, cam1, cam2, got '3'",)),
        (["--camera", "cam9"], ("got 'cam9'",)),
        (["--camera", "0", "--channels", "confidence"], ("channel 'confidence' needs Gaussians that carry it",)),
        (["--camera", "0", "--output", "a.gif"], ("must be FILE.mp4, or a folder", "'.gif'")),
    ],
)
def test_a_bad_request_to_render(stream: Path, tmp_path: Path, capsys, args, parts) -> None:
    status, _, error = run(capsys, "render", stream, *args)
    assert status == 1
    assert_one_sentence(error, *parts)
    assert list(tmp_path.iterdir()) == [stream]


def test_other_bad_streams(stream: Path, tmp_path: Path, capsys) -> None:
    status, _, error = run(capsys, "render", tmp_path, "--camera", 0)
    assert status == 1
    assert_one_sentence(error, "stream.morgs: expected a stream, found none")
    status, _, error = run(capsys, "eval", stream)
    assert status == 1
    assert_one_sentence(error, "its header names no capture", "--capture")
    with StreamWriter(stream, rig(), 25):
        pass
    for output in (tmp_path / "a.mp4", tmp_path / "exr"):
        status, _, error = run(capsys, "render", stream, "--camera", 0, "--output", output)
        assert status == 1
        assert_one_sentence(error, "at least one frame was expected, got none")
        assert not output.exists()


def test_a_damaged_stream_is_salvaged_and_what_is_lost_is_named(tmp_path: Path, capsys) -> None:
    path, new = tmp_path / "stream.morgs", tmp_path / "new.morgs"
    states = write_stream(path, 5)
    packets = list(StreamReader(path))
    with StreamWriter(path, rig(), 25, {"num_frames": 5}) as writer:
        for packet in packets:
            writer.write(packet)
    index, data = StreamReader(path).index(), bytearray(path.read_bytes())
    data[index[2][2] + 40] ^= 1
    path.write_bytes(data)
    status, said, _ = run(capsys, "salvage", tmp_path, new)
    assert status == 0
    gap, behind, *_, result, lost = said.splitlines()
    assert gap == f"{path}: bytes {index[2][2]} to {index[3][2]}: the bytes are damaged."
    assert f"bytes {index[3][2]} to {index[4][2]}: packet of frame 3: it does not continue the state after" in behind
    assert result == f"{new}: 2 frames, 0 to 1."
    assert lost.startswith("3 frames cannot be played, 2 to 4: their packets are damaged, missing, or continue one")
    assert [frame for frame, _ in play(StreamReader(new))] == [0, 1]

    # Keyframes behind what is missing: it plays on.
    with StreamWriter(path, rig(), 25, {"num_frames": 6}) as writer:
        for state in (states[0], states[3], states[4]):
            writer.write(reemitted_keyframe(state))
    status, said, _ = run(capsys, "salvage", tmp_path, new)
    assert (status, said.splitlines()[0]) == (0, f"{new}: 3 frames, 0, 3 to 4.")
    assert "3 frames cannot be played, 1 to 2, 5: " in said

    # The metadata may say anything.
    for total, named in ((10**30, f", 5 to {10**30 - 1}: "), ("many", ", 1 to 2: "), (2, ", 1 to 2: ")):
        with StreamWriter(path, rig(), 25, {"num_frames": total}) as writer:
            for state in (states[0], states[3], states[4]):
                writer.write(reemitted_keyframe(state))
        status, said, _ = run(capsys, "salvage", tmp_path, new)
        assert status == 0
        assert named in said

    status, _, error = run(capsys, "salvage", tmp_path, path)
    assert status == 1
    assert_one_sentence(error, "expected a new file, got the damaged stream itself")


def test_a_stream_of_no_gaussians_is_black(tmp_path: Path, capsys) -> None:
    empty = Gaussians(*(np.zeros((0, *tail)) for tail in ((3,), (3,), (4,), (), (1, 3))))
    with StreamWriter(tmp_path / "s.morgs", rig(), 25) as writer:
        writer.write(keyframe_packet(empty, 0))
    assert run(capsys, "render", tmp_path / "s.morgs", "--camera", 0, "--output", tmp_path / "exr")[0] == 0
    assert not any(channel.any() for channel in read_exr(tmp_path / "exr" / "0000.exr").values())


def test_a_full_disk_while_fitting(capture: Path, tmp_path: Path) -> None:
    """The second packet finds no room: the file ends with the first, and says how many there should be."""
    script = (
        "import resource, sys; from morgs_mi.codec import container; from morgs_mi import cli\n"
        "write = container.StreamWriter.write\n"
        "def limited(writer, packet):\n"
        "    if packet.frame:\n"
        "        resource.setrlimit(resource.RLIMIT_FSIZE, (writer.num_bytes + 9,) * 2)\n"
        "    return write(writer, packet)\n"
        "container.StreamWriter.write = limited\n"
        "sys.exit(cli.main(sys.argv[1:]))\n"
    )
    args = [sys.executable, "-c", script, "fit", str(capture), str(tmp_path / "out"), *QUICK]
    result = subprocess.run(args, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert_one_sentence(result.stderr, "stream.morgs", "could not be written", "free space on the disk")
    reader = StreamReader(tmp_path / "out" / "stream.morgs")
    assert len(list(reader)) == 1
    assert reader.metadata["num_frames"] == FRAMES


@pytest.mark.parametrize("name", ["a.mp4", "exr", "png"])
def test_a_full_disk_while_rendering(stream: Path, tmp_path: Path, capsys, name: str) -> None:
    run(capsys, "render", stream, "--camera", 0, "--output", tmp_path / f"warm-{name}")  # kernels are on the disk too
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, hard))
    try:
        status, _, error = run(capsys, "render", stream, "--camera", 0, "--output", tmp_path / name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert status == 1
    assert_one_sentence(error, name)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["good.morgs", f"warm-{name}"]


def test_an_interruption(stream: Path, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*args: object, **more: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("morgs_mi.playback.player.rasterize", interrupt)
    status, _, error = run(capsys, "render", stream, "--camera", 0)
    assert status == 130
    assert_one_sentence(error, "Interrupted")
    assert list(tmp_path.iterdir()) == [stream]


def test_a_fit_that_was_cut_off_is_resumed(capture: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    fit = ("fit", capture, out, *QUICK, "--render.reproducible")
    assert run(capsys, *fit)[0] == 0
    whole = (out / "stream.morgs").read_bytes()
    (out / "stream.morgs").write_bytes(whole[: len(whole) * 3 // 4])
    status, said, _ = run(capsys, *fit, "--resume")
    assert status == 0
    assert f"stream.morgs: {FRAMES} frames" in said
    assert (out / "stream.morgs").read_bytes() == whole
    status, _, error = run(capsys, *fit, "--resume", "--seed", 1)
    assert status == 1
    assert_one_sentence(error, "stream.morgs: expected to resume", "config.seed = 0, got 1")


def test_debug_shows_where_an_error_came_from(tmp_path: Path, capsys) -> None:
    status, _, error = run(capsys, "info", tmp_path / "nothing", "--debug")
    assert status == 1
    assert "Traceback" in error
    assert "load_capture" in error


def test_the_cameras_of_a_capture_are_listed(capture: Path, capsys) -> None:
    status, out, _ = run(capsys, "info", capture)
    assert status == 0
    assert all(f"{name} {WIDTH}x{HEIGHT}" in " ".join(out.split()) for name in NAMES)
    assert f"{FRAMES} frames at 25 fps, 150 points, without ground truth." in out


def test_from_a_scene_to_figures(tmp_path: Path, capsys) -> None:
    clip, out = tmp_path / "clip", tmp_path / "out"
    size = ("--width", 64, "--height", 48, "--spp", 4)
    assert run(capsys, "synth", "spheres", clip, "--cameras", 4, "--frames", 3, *size)[0] == 0
    fit = ("--test-view", 0, "--fit.num-gaussians", 600, "--fit.first-frame-steps", 60, "--fit.epochs", 2)
    status, said, _ = run(capsys, "fit", clip, out, *fit)
    assert status == 0
    assert "stream.morgs: 3 frames" in said

    status, said, _ = run(capsys, "eval", out, "--json", "-")
    assert status == 0
    result = json.loads(said)
    assert (result["held_out"], list(result["views"]), result["num_frames"]) == (True, ["cam00"], 3)
    assert result["psnr"]["mean"] > 15
    assert result["bytes"]["file"] == (out / "stream.morgs").stat().st_size
    assert 0 < result["frames"][1]["motion_error_moving"] < 10
    assert result["frames"][1]["seconds"] > 0
    more = ("--json", tmp_path / "eval.json", "--pictures", tmp_path / "pictures")
    status, said, _ = run(capsys, "eval", out, *more)
    assert status == 0
    assert "held-out view cam00" in said
    assert {path.name for path in (tmp_path / "pictures").iterdir()} == {"slice.png", "motion.png", "confidence.png"}
    assert 0 < result["motion_3d"]["num_gaussians"] <= 600
    status, _, error = run(capsys, "eval", out, "--lpips", tmp_path / "none.onnx")
    assert (status, "expected an LPIPS network as ONNX, found none" in error) == (1, True)
    assert json.loads((tmp_path / "eval.json").read_text())["psnr"] == result["psnr"]

    assert run(capsys, "render", out, "--camera", "cam02")[0] == 0
    video = cv2.VideoCapture(str(out / "cam02.mp4"))
    assert [video.read()[1].shape for _ in range(3)] == [(48, 64, 3)] * 3
    assert not video.read()[0]
    assert run(capsys, "render", out, "--camera", 0, "--output", tmp_path / "exr")[0] == 0
    channels = read_exr(tmp_path / "exr" / "0002.exr")
    assert set(channels) == {"R", "G", "B", "motion.X", "motion.Y", "depth.Y", "confidence.Y"}
    both = ("--channels", "color", "depth", "--output", tmp_path / "png")
    assert run(capsys, "render", out, "--camera", 0, *both)[0] == 0
    assert cv2.imread(str(tmp_path / "png" / "0002.png")).shape == (48, 132, 3)
