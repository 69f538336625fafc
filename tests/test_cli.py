"""The command line: from a scene to an evaluation, options and config files, and bad input with one sentence each."""

from __future__ import annotations

import json
import os
import re
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import tomllib
from dataclasses import asdict, replace
from functools import reduce
from pathlib import Path
from typing import Any, get_type_hints

import cv2
import numpy as np
import pytest

from morgs_mi import cli
from morgs_mi.capture.capture import Capture
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.cli.settings import SETTINGS, Reading
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import keyframe_packet, play, reemitted_keyframe
from morgs_mi.codec.reader import StreamReader
from morgs_mi.config import StreamConfig, apply_values, config_toml
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.demo import DemoConfig
from morgs_mi.io.exr import read_exr
from morgs_mi.io.video_writer import write_video
from morgs_mi.stream_loop import StreamLoop
from tests.scenes.cameras import look_at_cameras
from tests.scenes.captures import colmap
from tests.scenes.changing_splats import write_stream
from tests.scenes.gaussians import isotropic

WIDTH, HEIGHT, FRAMES = 48, 32, 3
NAMES = ("cam0", "cam1", "cam2")
# The smallest possible fit.
QUICK = ["--num-gaussians", "120", "--first-frame-steps", "4", "--epochs", "1", "--sh-degree", "0"]


def run(capsys: pytest.CaptureFixture[str], *args: object) -> tuple[int, str, str]:
    status = cli.main([str(a) for a in args])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def rig() -> list[Camera]:
    return look_at_cameras([(x, 0, -3) for x in (-0.4, 0, 0.4)], 60, WIDTH, HEIGHT)


def clip(count: int = FRAMES) -> list[np.ndarray]:
    return [
        np.roll(np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8), t, 1) for t in range(count)
    ]


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Three cameras with moving noise, as .mkv, which stays readable up to where it is cut off."""
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
    splat = isotropic([[0, 0, 0]], 0.3, 0.9, (1.0, 0, 0))
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


# Each breaks the capture and returns parts of the expected message.
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
def test_main__names_what_is_broken_in_a_capture(capture: Path, tmp_path: Path, capsys, spoil) -> None:
    parts = spoil(capture)
    for args in (("info", capture), ("fit", capture, tmp_path / "out", *QUICK)):
        status, _, error = run(capsys, *args)
        assert status == 1
        assert_one_sentence(error, *parts)
    assert not (tmp_path / "out").exists()


def test_fit__continues_without_a_camera_whose_clip_is_cut_off_meanwhile(
    capture: Path, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    truncated_clip(capture)
    monkeypatch.setattr("morgs_mi.io.video._frame_times", lambda path: np.arange(FRAMES) / 25)
    assert run(capsys, "fit", capture, tmp_path / "out", *QUICK)[0] == 0
    frames = json.loads((tmp_path / "out" / "report.json").read_text())["frames"]
    assert [frame["missing_views"] for frame in frames] == [[], ["cam1"], ["cam1"]]
    assert "cam1.mkv: frame 1 of 3 cannot be decoded" in frames[2]["status"]
    assert run(capsys, "eval", tmp_path / "out", "--json", tmp_path / "eval.json")[0] == 0
    frames = json.loads((tmp_path / "eval.json").read_text())["frames"]
    assert [frame["views"]["cam1"]["psnr"] is None for frame in frames] == [False, True, True]
    assert all(frame["psnr"] > 0 for frame in frames)


def test_fit__and_eval_use_the_same_instants(capture: Path, tmp_path: Path, capsys) -> None:
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


def test_fit__leaves_a_stream_marked_as_unfinished_when_interrupted(
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
        (["--frames", "0"], ("--frames must be at least 1, got 0",)),
        (["--downscale", "0.5"], ("--downscale must be at least 1, got 0.5",)),
        (["--test-view", "3"], ("--test-view must be an index in 0..2, one of cam0, cam1, cam2, or none", "got 3")),
        (["--offset", "cam9", "1"], ("--offset must name cameras of cam0, cam1, cam2, got cam9",)),
        (["--num-gaussians", "0"], ("--num-gaussians must be at least 1, got 0",)),
        (["--epochs", "0", "--preset", "s"], ("--epochs must be at least 1, got 0",)),
        (["--sh-degree", "4"], ("--sh-degree must be 0 to 3, got 4",)),
        (["--key-views", "0"], ("--key-views must be at least 1, got 0",)),
        (["--quality", "nan"], ("--quality must be positive and finite, got nan",)),
        (["--target-size", "-1"], ("--target-size must not be negative, got -1",)),
        (["--flow", "none"], ("--flow must be one of dis,", "got 'none'")),
        (["--flow", "files:nowhere"], ("nowhere",)),
        (["--masks", "some"], ("--masks must be one of none,", "got 'some'")),
        (["--config", "nowhere.toml"], ("nowhere.toml: expected a TOML file with settings, found none",)),
        (["--config", "[fit"], ("bad.toml: expected valid TOML",)),
        (["--config", "[fit]\na = " + "[" * 5000], ("bad.toml: expected valid TOML",)),
        (["--config", "[fit]\na = " + "9" * 5000], ("bad.toml: expected valid TOML",)),
        (["--config", "[fit]\nepoch = 1"], ("bad.toml: `fit.epoch` is unknown, expected `fit.epochs`",)),
        (["--config", "[fit]\nepochs = 'many'"], ("bad.toml: `fit.epochs` must be a whole number, got 'many'",)),
        (["--config", "[fit.rates]\nmeans = nan"], ("bad.toml: `fit.rates.means` must be finite and not negative",)),
        (["--config", "[render]\nblock_width = 17"], ("bad.toml: `render.block_width` must be 4, 8, 12 or 16",)),
        (["--config", "[motion]\nflow_method = 'no'"], ("bad.toml: `motion.flow_method` must be one of dis,",)),
        (["--config", "[motion]\nmask_method = 'no'"], ("bad.toml: `motion.mask_method` must be one of none,",)),
        (["--variant", "cuda_ad_rgb"], ("--variant cuda_ad_rgb cannot be used here", "llvm_ad_rgb")),
    ],
)
def test_fit__rejects_bad_input_in_one_sentence(capture: Path, tmp_path: Path, capsys, args, parts) -> None:
    if "cuda_ad_rgb" in args and Path("/dev/nvidiactl").exists():
        pytest.skip("this machine has a GPU")
    option, value, *more = args
    if option == "--config" and "[" in value:
        value = tmp_path / "bad.toml"
        value.write_text(args[1])
    status, _, error = run(capsys, "fit", capture, tmp_path / "out", option, value, *more)
    assert status == 1
    assert_one_sentence(error, *parts)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("folders", [(), ("capture",)])
def test_fit__asks_for_its_folders(folders: tuple[str, ...], capsys) -> None:
    status, _, error = run(capsys, "fit", *folders)
    assert status == 1
    assert_one_sentence(error, "expected the folders CAPTURE and OUT")


@pytest.mark.parametrize(
    ("args", "part"),
    [
        (["--epochs", "many"], "many"),
        (["--epochs", "None"], "--epochs"),
        (["--preset", "xl"], "xl"),
        (["--nonsense"], "--nonsense"),
        (["--fit.epochs", "1"], "--fit.epochs"),
    ],
)
def test_fit__rejects_arguments_that_cannot_be_parsed(capture: Path, tmp_path: Path, capsys, args, part) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["fit", str(capture), str(tmp_path / "out"), *args])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert part in " ".join(error.replace("│", " ").split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("args", "parts"),
    [
        (("synth", "spheres", "OUT", "--cameras", 1), ("--cameras must be at least 2, got 1",)),
        (("synth", "spheres", "OUT", "--frames", 0), ("--frames must be at least 1, got 0",)),
        (("synth", "spheres", "OUT", "--width", 3), ("--width and --height must be even, got 3x240",)),
        (("synth", "spheres", "OUT", "--noise", 2), ("--noise must be at least 0 and below 1, got 2",)),
        (("demo", "OUT", "--cameras", 1), ("--cameras must be at least 2, got 1",)),
        (("demo", "OUT", "--seed", -1), ("--seed must be at least 0, got -1",)),
        (("demo", "OUT", "--config", "nowhere.toml"), ("nowhere.toml: expected a TOML file with settings",)),
    ],
)
def test_main__names_options_not_arguments(tmp_path: Path, capsys, args, parts) -> None:
    out = tmp_path / "out"
    status, _, error = run(capsys, *(out if arg == "OUT" else arg for arg in args))
    assert status == 1
    assert_one_sentence(error.splitlines()[-1], *parts)
    assert not out.exists()


def printed_config(capsys, *args: object) -> StreamConfig:
    status, text, error = run(capsys, "fit", *args, "--print-config")
    assert (status, error) == (0, "")
    return apply_values(StreamConfig(), tomllib.loads(text))


@pytest.mark.parametrize(
    ("args", "key", "expected"),
    [
        ((), "fit.epochs", 8),
        (("--preset", "s"), "fit.epochs", 5),
        (("--preset", "s", "--config", "FILE"), "fit.epochs", 3),
        (("--config", "FILE", "--epochs", "2", "--preset", "s"), "fit.epochs", 2),
        (("--preset", "paper", "--epochs", "2"), "fit.epochs", 2),
        (("--preset", "paper", "--epochs", "2"), "motion.lift_flow", False),
        (("--preset", "paper", "--config", "FILE"), "motion.lift_flow", False),
        (("--config", "FILE"), "codec.quality", 2.5),
        (("--config", "FILE", "--quality", "0.5"), "codec.quality", 0.5),
        (("--config", "FILE", "--quality", "0.5"), "render.block_width", 4),
        (("--config", "FILE"), "render.reproducible", True),
        (("--config", "FILE", "--flow", "dis"), "motion.flow_method", "dis"),
        (("--config", "FILE", "--target-size", "0"), "codec.target_size", 0),
    ],
)
def test_fit__overrides_defaults_by_preset_by_file_by_options(tmp_path: Path, capsys, args, key, expected) -> None:
    file = tmp_path / "a.toml"
    file.write_text(
        "[fit]\nepochs = 3\n[motion]\nflow_method = 'files:nowhere'\n[codec]\nquality = 2.5\ntarget_size = 9\n"
        "[render]\nreproducible = true\nblock_width = 4\n"
    )
    config = printed_config(capsys, *(file if arg == "FILE" else arg for arg in args))
    assert reduce(getattr, key.split("."), config) == expected


@pytest.mark.parametrize(
    "args",
    [
        (),
        ("--preset", "paper"),
        (
            *("--seed", 3, "--num-gaussians", 7, "--first-frame-steps", 5, "--epochs", 4, "--sh-degree", 2),
            *("--key-views", 3, "--flow", "farneback", "--masks", "none", "--quality", 0.3, "--target-size", 99),
            *("--keyframe-interval", 0, "--reproducible"),
        ),
    ],
)
def test_fit__prints_a_config_that_it_reads_back(tmp_path: Path, capsys, args: tuple[object, ...]) -> None:
    config = printed_config(capsys, *args)
    (tmp_path / "a.toml").write_text(config_toml(config))
    assert printed_config(capsys, "--config", tmp_path / "a.toml") == config
    if len(args) > 2:
        default, given = (flattened(asdict(c)) for c in (StreamConfig(), config))
        assert {key for key in given if given[key] != default[key]} == set(SETTINGS.values())


def flattened(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    pairs = [
        flattened(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
        for name, value in values.items()
    ]
    return {key: value for part in pairs for key, value in part.items()}


COMMANDS = ("synth", "info", "calibrate", "fit", "render", "import", "view", "eval", "salvage", "demo")
EXPORTS = ("ply", "gltf", "usd", "video", "tracks")


@pytest.mark.parametrize("command", [*((name,) for name in COMMANDS), *(("export", name) for name in EXPORTS)])
def test_main__has_at_most_30_options_per_command(command: tuple[str, ...], capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main([*command, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    options = re.findall(r"^[│ ] (?:-\w, )?(--[\w.-]+|\[?[A-Z]+\]?)[, ]", text, re.MULTILINE)
    assert "--help" in options
    assert "--variant" in options
    assert command not in [("fit",), ("eval",)] or any("OUT" in option for option in options)
    assert len(options) <= 30
    assert not any("." in option for option in options)


def test_fit__shows_the_defaults_of_its_options(capsys) -> None:
    with pytest.raises(SystemExit):
        cli.main(["fit", "--help"])
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for option, key in SETTINGS.items():
        shown = (
            rf"--{option.replace('_', '-')} (?:(?!--).)*\(default: {reduce(getattr, key.split('.'), StreamConfig())}\)"
        )
        assert option == "reproducible" or re.search(shown, text), option
    assert "None)" not in text


def test_Reading__has_the_fields_of_the_config() -> None:
    assert get_type_hints(Reading) == get_type_hints(ReadConfig)
    assert Reading().read_config() == ReadConfig()


def test_demo__passes_its_options_on(tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[DemoConfig] = []

    def stop(out: Path, config: DemoConfig, progress: object) -> None:
        calls.append(config)
        raise KeyboardInterrupt

    monkeypatch.setattr("morgs_mi.demo.run_demo", stop)
    (tmp_path / "a.toml").write_text("seed = 7\n[fit]\nepochs = 2\n")
    assert run(capsys, "demo", tmp_path)[0] == 130
    options = ("--scene", "arm", "--cameras", 4, "--frames", 5, "--width", 64, "--height", 48, "--spp", 2)
    assert run(capsys, "demo", tmp_path, *options, "--config", tmp_path / "a.toml")[0] == 130
    assert run(capsys, "demo", tmp_path, "--config", tmp_path / "a.toml", "--seed", 1)[0] == 130
    default, small, seeded = calls
    assert default == DemoConfig()
    assert (small.scene, small.stream.seed, small.stream.fit.epochs) == ("arm", 7, 2)
    assert small.clip == replace(default.clip, num_cameras=4, num_frames=5, width=64, height=48, spp=2)
    assert small.stream.fit.first_frame_steps == default.stream.fit.first_frame_steps
    assert (seeded.stream.seed, seeded.stream.fit.epochs) == (1, 2)


def test_main__runs_as_a_module() -> None:
    result = subprocess.run([sys.executable, "-m", "morgs_mi", "fit"], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (1, "")
    assert_one_sentence(result.stderr, "expected the folders CAPTURE and OUT")


def test_main__names_an_output_that_cannot_be_written(capture: Path, stream: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "file").write_text("")
    size = ("--cameras", 2, "--frames", 1, "--width", 16, "--height", 16)
    for folder in (tmp_path / "file", Path("/sys")):  # /sys accepts no new files, even from root
        for args in (
            ("fit", capture, folder / "out", *QUICK),
            ("synth", "spheres", folder / "out", *size),
            ("render", stream, "--camera", 0, "--output", folder / "a.mp4"),
            ("render", stream, "--camera", 0, "--output", folder / "exr"),
            ("export", "ply", stream, "--output", folder / "ply"),
            ("export", "tracks", stream, "--output", folder / "a.npz"),
            ("salvage", stream, folder / "a.morgs"),
            ("info", capture, "--no-check", "--plot", folder / "rig.png"),
            ("demo", folder / "out"),
        ):
            status, _, error = run(capsys, *args)
            assert status == 1
            assert_one_sentence(
                error.splitlines()[-1], "Cannot write ", str(folder), "check that its folder is writable"
            )
            assert "Errno" not in error
    for args in (("fit", capture, tmp_path / "file", *QUICK), ("demo", tmp_path / "file")):
        status, _, error = run(capsys, *args)
        assert status == 1
        assert_one_sentence(error, f"{tmp_path / 'file'} is a file; name a folder")


def test_main__writes_nothing_into_a_capture(capture: Path, stream: Path, tmp_path: Path, capsys) -> None:
    (capture / "capture.json").write_text('{"fps": 25}')
    place = tmp_path / "link"
    place.symlink_to(capture)
    before = tree(capture)
    for args in (
        ("fit", capture, capture, *QUICK),
        ("fit", capture, place, *QUICK, "--resume"),
        ("fit", capture, capture / "new" / "out", *QUICK),
        ("demo", place),
        ("synth", "spheres", place / "clip"),
        ("render", stream, "--camera", 0, "--output", place / "cam0.mkv.mp4"),
        ("render", stream, "--camera", 0, "--output", place / "cam0"),
        ("export", "ply", stream, "--output", place / "ply"),
        ("export", "gltf", stream, "--output", place / "gltf"),
        ("export", "usd", stream, place / "a.usda"),
        ("export", "video", stream, "--output", place / "cam0.mp4"),
        ("import", tmp_path, place / "new.morgs"),
        ("export", "tracks", stream, "--output", place / "a.npz"),
        ("eval", stream, "--capture", capture, "--json", place / "capture.json"),
        ("eval", stream, "--capture", capture, "--figures", place / "figures"),
        ("info", capture, "--plot", place / "cam0.png"),
        ("salvage", stream, place / "capture.json"),
    ):
        status, _, error = run(capsys, *args)
        assert status == 1
        assert_one_sentence(
            error, "expected an output outside of captures, which stay as they were recorded, got one in"
        )
    status, _, error = run(capsys, "synth", "spheres", capture, "--overwrite")
    assert status == 1
    assert_one_sentence(error, f"{capture} is not a synthetic capture")
    assert tree(capture) == before


def tree(path: Path) -> dict[str, bytes | None]:
    """Return the content of every file below `path` by its name, None for folders."""
    return {str(p.relative_to(path)): p.read_bytes() if p.is_file() else None for p in sorted(path.rglob("*"))}


def test_eval__replaces_no_file_of_the_fit(stream: Path, tmp_path: Path, capsys) -> None:
    for name in ("good.morgs", "report.json", "capture.json"):
        status, _, error = run(capsys, "eval", stream, "--json", tmp_path / name)
        assert status == 1
        assert_one_sentence(error, f"{name}: expected a new file, got one that the fit has written")


@pytest.mark.parametrize(("view", "test_view"), [("cam1", 1), ("2", 2), ("none", None), ("None", None), ("auto", None)])
def test_fit__takes_the_held_out_camera_by_index_or_name(
    capture: Path, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch, view: str, test_view: int | None
) -> None:
    assert fitted_capture(monkeypatch, capsys, capture, tmp_path, "--test-view", view).test_view == test_view


def fitted_capture(monkeypatch: pytest.MonkeyPatch, capsys, capture: Path, out: Path, *args: object) -> Capture:
    """Return the capture that `morgs-mi fit` passes on."""
    passed: list[Capture] = []

    def stop(capture: Capture, *_: object) -> None:
        passed.append(capture)
        raise KeyboardInterrupt

    monkeypatch.setattr("morgs_mi.recorder.stream_capture", stop)
    assert run(capsys, "fit", capture, out, *args)[0] == 130
    return passed[0]


def test_fit__refuses_to_leave_fewer_than_32_pixels(tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    clip = colmap(tmp_path / "clip")  # 62x46
    status, _, error = run(capsys, "fit", clip, tmp_path / "out", "--downscale", 1.5)
    assert status == 1
    assert_one_sentence(
        error, "--downscale must leave images of at least 32 pixels on each side, got 1.5; use at most 1.43."
    )
    assert fitted_capture(monkeypatch, capsys, clip, tmp_path / "out", "--downscale", 1.43).cameras[0].height == 32


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_fit__names_what_stands_and_how_to_go_on_when_interrupted(
    capture: Path, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    push = StreamLoop.push

    def interrupted(loop: StreamLoop, *args: Any):
        if loop.state.frame == 2:
            os.kill(os.getpid(), number)
        return push(loop, *args)

    monkeypatch.setattr(StreamLoop, "push", interrupted)
    args = ["fit", str(capture), str(tmp_path / "my out"), *QUICK]
    status, _, error = run(capsys, *args)
    again = shlex.join(["morgs-mi", *args, "--resume"])
    stands = f"Interrupted. {tmp_path / 'my out'}/stream.morgs holds frames 0 to 1 of 3; continue with `{again}`."
    assert (status, error) == (130, f"{stands}\n")


def test_fit__does_not_offer_to_resume_a_stream_of_an_earlier_fit(
    capture: Path, stream: Path, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "out").mkdir()
    stream.rename(tmp_path / "out" / "stream.morgs")
    monkeypatch.setattr("morgs_mi.recorder.StreamLoop", interrupt)
    status, _, error = run(capsys, "fit", capture, tmp_path / "out", *QUICK)
    assert (status, error) == (130, "Interrupted.\n")
    assert len(StreamReader(tmp_path / "out" / "stream.morgs").index()) == 2


def interrupt(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def test_main__reports_a_full_standard_output_in_one_sentence(capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert run(capsys, "fit", "--print-config")[::2] == (1, "standard output: No space left on device.\n")


@pytest.mark.parametrize("option", ["--no-check", "--help"])
def test_info__names_standard_output_if_it_is_full(capture: Path, option: str) -> None:
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "morgs_mi", "info", str(capture), option]
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (result.returncode, result.stderr) == (1, "standard output: No space left on device.\n")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 100_000, "expected JSON, got a broken file"),
        ("[]", "expected a fit's report, got a broken one"),
        (f'{{"frames": [{{"frame": 0, "seconds": {10**400}}}]}}', "expected a fit's report, got a broken one"),
    ],
)
def test_eval__reports_a_hostile_report_in_one_sentence(
    fitted_clip: Path, tmp_path: Path, capsys, text: str, message: str
) -> None:
    shutil.copy(fitted_clip / "stream.morgs", tmp_path)
    (tmp_path / "report.json").write_text(text)
    status, _, error = run(capsys, "eval", tmp_path, "--capture", fitted_clip / "capture")
    assert status == 1
    assert_one_sentence(error, f"report.json: {message}")


@pytest.mark.parametrize("text", ["[" * 100_000, "[]"])
def test_synth__replaces_no_folder_with_a_hostile_description(tmp_path: Path, capsys, text: str) -> None:
    (tmp_path / "capture.json").write_text(text)
    status, _, error = run(capsys, "synth", "arm", tmp_path, "--overwrite")
    assert status == 1
    assert_one_sentence(error, "is not a synthetic capture")


def test_main__reports_an_unexpected_error_in_one_sentence(capture: Path, capsys, monkeypatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise AttributeError("'NoneType' object has no attribute 'a'")

    monkeypatch.setattr("morgs_mi.cli.info.load_capture", fail)
    status, _, error = run(capsys, "info", capture)
    assert status == 1
    assert_one_sentence(error, "Unexpected AttributeError: 'NoneType' object has no attribute 'a'", "--debug")


def test_fit__reports_progress_before_the_first_frame(capture: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    write_colmap(capture / "sparse" / "0", rig(), np.zeros((0, 3)), np.zeros((0, 3)))
    now = iter(range(0, 10**9, 40))
    monkeypatch.setattr("morgs_mi.cli.console.time.monotonic", lambda: float(next(now)))
    monkeypatch.setattr("morgs_mi.recorder.StreamLoop", interrupt)
    status, _, error = run(capsys, "fit", capture, tmp_path / "out", *QUICK)
    assert status == 130
    assert error.startswith("Matching views: 0/3, 0:00:00 elapsed.\nMatching views: 1/3, ")
    assert "Triangulating points: 0/1, " in error


@pytest.mark.parametrize(
    ("damage", "parts"),
    [
        (lambda data: b"", ("the header is missing",)),
        (lambda data: b"not a stream", ("expected a stream that starts with",)),
        (lambda data: data[:-75], ("truncated or still written", "packet 2", "2 packets before it are intact")),
        (lambda data: data[:-5] + b"\1" * 5, ("the bytes are damaged",)),
    ],
)
def test_main__names_what_is_broken_in_a_stream(stream: Path, tmp_path: Path, capsys, damage, parts) -> None:
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
        (
            ["--camera", "0", "--channels", "confidence"],
            ("channel 'confidence' requires Gaussians with `logit_confidence`",),
        ),
        (["--camera", "0", "--output", "a.gif"], ("must be FILE.mp4, or a folder", "'.gif'")),
    ],
)
def test_render__rejects_bad_input_in_one_sentence(stream: Path, tmp_path: Path, capsys, args, parts) -> None:
    status, _, error = run(capsys, "render", stream, *args)
    assert status == 1
    assert_one_sentence(error, *parts)
    assert list(tmp_path.iterdir()) == [stream]


def test_main__names_a_missing_or_empty_stream(stream: Path, tmp_path: Path, capsys) -> None:
    status, _, error = run(capsys, "render", tmp_path, "--camera", 0)
    assert status == 1
    assert_one_sentence(error, "stream.morgs: expected a stream, found none")
    status, _, error = run(capsys, "eval", stream)
    assert status == 1
    assert_one_sentence(error, "expected the path of its capture", "--capture")
    with StreamWriter(stream, rig(), 25):
        pass
    for output in (tmp_path / "a.mp4", tmp_path / "exr"):
        status, _, error = run(capsys, "render", stream, "--camera", 0, "--output", output)
        assert status == 1
        assert_one_sentence(error, "at least one frame was expected, got none")
        assert not output.exists()


def test_salvage__writes_the_intact_frames_and_lists_the_lost_ones(tmp_path: Path, capsys) -> None:
    path, new = tmp_path / "stream.morgs", tmp_path / "new.morgs"
    states = write_stream(path, 5)
    packets = list(StreamReader(path))
    with StreamWriter(path, rig(), 25, {"num_frames": 5}) as writer:
        for packet in packets:
            writer.write(packet)
    index, data = StreamReader(path).index(), bytearray(path.read_bytes())
    data[index[2][2] + 40] ^= 1
    path.write_bytes(data)
    status, output, _ = run(capsys, "salvage", tmp_path, new)
    assert status == 0
    damaged, after, *_, result, lost = output.splitlines()
    assert damaged == f"{path}: bytes {index[2][2]} to {index[3][2]}: the bytes are damaged."
    assert f"bytes {index[3][2]} to {index[4][2]}: intact packet 3, frame 3: it does not continue" in after
    assert result == f"{new}: 2 frames, 0 to 1."
    assert lost.startswith("3 frames cannot be played, 2 to 4: their packets are damaged, missing, or continue one")
    assert [frame for frame, _ in play(StreamReader(new))] == [0, 1]

    # Playback continues at the keyframes after the missing frames.
    with StreamWriter(path, rig(), 25, {"num_frames": 6}) as writer:
        for state in (states[0], states[3], states[4]):
            writer.write(reemitted_keyframe(state))
    status, output, _ = run(capsys, "salvage", tmp_path, new)
    assert (status, output.splitlines()[0]) == (0, f"{new}: 3 frames, 0, 3 to 4.")
    assert "3 frames cannot be played, 1 to 2, 5: " in output

    # Metadata may have any type and size.
    for total, named in ((10**18, f", 5 to {10**18 - 1}: "), ("many", ", 1 to 2: "), (2, ", 1 to 2: ")):
        with StreamWriter(path, rig(), 25, {"num_frames": total}) as writer:
            for state in (states[0], states[3], states[4]):
                writer.write(reemitted_keyframe(state))
        status, output, _ = run(capsys, "salvage", tmp_path, new)
        assert status == 0
        assert named in output

    status, _, error = run(capsys, "salvage", tmp_path, path)
    assert status == 1
    assert_one_sentence(error, "expected a new file, got the damaged stream itself")


def test_render__draws_a_stream_without_gaussians_black(tmp_path: Path, capsys) -> None:
    empty = Gaussians(*(np.zeros((0, *tail)) for tail in ((3,), (3,), (4,), (), (1, 3))))
    with StreamWriter(tmp_path / "s.morgs", rig(), 25) as writer:
        writer.write(keyframe_packet(empty, 0))
    assert run(capsys, "render", tmp_path / "s.morgs", "--camera", 0, "--output", tmp_path / "exr")[0] == 0
    assert not any(channel.any() for channel in read_exr(tmp_path / "exr" / "0000.exr").values())


def test_fit__ends_with_a_whole_packet_on_a_full_disk(capture: Path, tmp_path: Path) -> None:
    """The second packet does not fit: the file ends with the first and still has the intended number of frames."""
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
    assert_one_sentence(result.stderr, "stream.morgs", "could not be written", "free space on the disk. ", "--resume`.")
    assert "Errno" not in result.stderr
    reader = StreamReader(tmp_path / "out" / "stream.morgs")
    assert len(list(reader)) == 1
    assert reader.metadata["num_frames"] == FRAMES


@pytest.mark.parametrize("name", ["a.mp4", "exr", "png"])
def test_render__removes_its_output_on_a_full_disk(stream: Path, tmp_path: Path, capsys, name: str) -> None:
    run(
        capsys, "render", stream, "--camera", 0, "--output", tmp_path / f"warm-{name}"
    )  # compiled kernels are cached on disk too
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, hard))
    try:
        status, _, error = run(capsys, "render", stream, "--camera", 0, "--output", tmp_path / name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert status == 1
    assert_one_sentence(error, name)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["good.morgs", f"warm-{name}"]


def test_render__removes_its_output_when_interrupted(
    stream: Path, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("morgs_mi.playback.player.rasterize", interrupt)
    status, _, error = run(capsys, "render", stream, "--camera", 0)
    assert status == 130
    assert_one_sentence(error, "Interrupted")
    assert list(tmp_path.iterdir()) == [stream]


def test_fit__resumes_a_stream_to_the_same_bytes(capture: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    fit = ("fit", capture, out, *QUICK, "--reproducible")
    assert run(capsys, *fit)[0] == 0
    whole = (out / "stream.morgs").read_bytes()
    (out / "stream.morgs").write_bytes(whole[: len(whole) * 3 // 4])
    status, output, _ = run(capsys, *fit, "--resume")
    assert status == 0
    assert f"stream.morgs: {FRAMES} frames" in output
    assert (out / "stream.morgs").read_bytes() == whole
    status, _, error = run(capsys, *fit, "--resume", "--seed", 1)
    assert status == 1
    assert_one_sentence(error, "stream.morgs: expected to resume", "config.seed = 0, got 1")


def test_main__prints_a_traceback_with_debug(tmp_path: Path, capsys) -> None:
    status, _, error = run(capsys, "info", tmp_path / "nothing", "--debug")
    assert status == 1
    assert "Traceback" in error
    assert "load_capture" in error


def test_info__lists_the_cameras_of_a_capture(capture: Path, capsys) -> None:
    status, out, _ = run(capsys, "info", capture)
    assert status == 0
    assert all(f"{name} {WIDTH}x{HEIGHT}" in " ".join(out.split()) for name in NAMES)
    assert f"{FRAMES} frames at 25 fps, 150 points, without ground truth." in out


def test_main__goes_from_a_scene_to_an_evaluation(tmp_path: Path, capsys) -> None:
    clip, out = tmp_path / "clip", tmp_path / "out"
    size = ("--width", 64, "--height", 48, "--spp", 4)
    assert run(capsys, "synth", "spheres", clip, "--cameras", 4, "--frames", 3, *size)[0] == 0
    fit = ("--test-view", 0, "--num-gaussians", 600, "--first-frame-steps", 60, "--epochs", 2)
    status, output, _ = run(capsys, "fit", clip, out, *fit)
    assert status == 0
    assert "stream.morgs: 3 frames" in output

    status, output, _ = run(capsys, "eval", out, "--json", "-")
    assert status == 0
    result = json.loads(output)
    assert (result["held_out"], list(result["views"]), result["num_frames"]) == (True, ["cam00"], 3)
    assert result["psnr"]["mean"] > 15
    assert result["bytes"]["file"] == (out / "stream.morgs").stat().st_size
    assert 0 < result["frames"][1]["motion_error_moving"] < 10
    assert result["frames"][1]["seconds"] > 0
    more = ("--json", tmp_path / "eval.json", "--figures", tmp_path / "figures")
    status, output, _ = run(capsys, "eval", out, *more)
    assert status == 0
    assert "held-out view cam00" in output
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"slice.png", "motion.png", "confidence.png"}
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
