"""`morgs-mi`: from a scene to an evaluation, help, and what all commands refuse with one sentence
each.
"""

import os
import re
import subprocess
import sys

import pytest

from morgs_mi.cli.export import EXPORTS
from morgs_mi.cli.main import COMMANDS, main
from morgs_mi.codec.container import StreamWriter
from tests.cli.commands import assert_one_sentence, assert_refused
from tests.platform.test_files import tree
from tests.quick import OPTIONS
from tests.scenes.noise_capture import rig

COMMON = {"--help", "--variant", "--debug"}


@pytest.mark.parametrize(
    ("args", "parts"),
    [
        (
            ("synth", "spheres", "OUT", "--width", 3),
            ("`width` must be at least 2 and a multiple of 2, got 3",),
        ),
        (("demo", "OUT", "--cameras", 1), ("`cameras` must be at least 2, got 1",)),
    ],
)
def test_main__names_arguments_without_functions(tmp_path, run, args, parts):
    out = tmp_path / "out"
    status, _, error = run(*(out if arg == "OUT" else arg for arg in args))
    assert status == 1
    assert_one_sentence(error.splitlines()[-1], *parts)
    assert not out.exists()


@pytest.mark.parametrize(
    "command",
    [*((name,) for name in COMMANDS if name != "export"), *(("export", name) for name in EXPORTS)],
)
def test_main__has_fewer_than_30_options_of_its_own_per_command(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([*command, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    options = re.findall(r"^[│ ] (?:-\w, )?(--[\w.-]+|\[?[A-Z]+\]?)[, ]", text, re.MULTILINE)
    assert "--help" in options
    assert "--variant" in options
    positional = {("fit",): "[OUT]", ("eval",): "SOURCE"}.get(command, "--help")
    assert positional in options
    own_options = {option for option in options if option.startswith("--")} - COMMON
    assert len(own_options) < 30
    assert not any("." in option for option in options)


def test_main__runs_as_a_module():
    result = subprocess.run(
        [sys.executable, "-m", "morgs_mi", "fit"], capture_output=True, text=True, check=False
    )
    assert (result.returncode, result.stdout) == (1, "")
    assert_one_sentence(result.stderr, "expected two folders, CAPTURE with")


def writing_commands(capture, stream, place):
    """Return commands that write into a folder."""
    size = ("--cameras", 2, "--frames", 1, "--width", 16, "--height", 16)
    return [
        ("fit", capture, place / "new" / "out", *OPTIONS),
        ("synth", "spheres", place / "clip", *size),
        ("render", stream, place / "a.mp4", "--camera", 0),
        ("render", stream, place / "exr", "--camera", 0),
        ("export", "ply", stream, place / "ply"),
        ("export", "web", stream, place / "page.html"),
        ("info", capture, "--no-check", "--plot", place / "rig.png"),
        ("demo", place / "out"),
    ]


@pytest.mark.slow
def test_main__writes_nothing_into_a_capture(capture, stream, tmp_path, run):
    (capture / "capture.json").write_text('{"fps": 25}')
    place = tmp_path / "link"
    place.symlink_to(capture)
    old_tree = tree(capture)
    for args in (
        *writing_commands(capture, stream, place),
        ("fit", capture, capture, *OPTIONS),
        ("fit", capture, place, *OPTIONS, "--resume"),
        ("render", stream, place / "cam0", "--camera", 0),
        ("export", "gltf", stream, place / "gltf"),
        ("export", "usd", stream, place / "a.usda"),
        ("import", tmp_path, place / "new.morgs"),
        ("export", "video", stream, place / "cam0.mp4"),
        ("export", "web", stream, place / "page"),
        ("eval", stream, "--capture", capture, "--json", place / "capture.json"),
    ):
        assert_refused(
            run(*args),
            "expected an output outside of captures, which stay as they were recorded, got one in",
        )
    assert_refused(
        run("synth", "spheres", capture, "--overwrite"), f"{capture} is not a synthetic capture"
    )
    assert tree(capture) == old_tree


@pytest.mark.slow
def test_main__prints_any_path_to_an_ascii_or_a_closed_standard_output(
    capture, tmp_path, monkeypatch
):
    command = [
        sys.executable,
        "-m",
        "morgs_mi",
        "fit",
        str(capture.rename(tmp_path / "撮影")),
        "出力",
    ]
    command += OPTIONS
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    result = subprocess.run(command, capture_output=True, cwd=tmp_path, check=False)
    assert (result.returncode, result.stderr) == (0, b"")
    assert rb"\u51fa\u529b" in result.stdout
    closed = subprocess.run(
        command, stderr=-1, preexec_fn=lambda: os.close(1), cwd=tmp_path, check=False
    )
    assert (closed.returncode, closed.stderr) == (0, b"")


def test_main__is_interrupted_while_the_variant_is_set(capture, run, monkeypatch):
    def interrupted(*_):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise ImportError("cannot import the variant") from error

    monkeypatch.setattr("mitsuba.set_variant", interrupted)
    assert run("info", capture) == (130, "", "Interrupted.\n")


def test_main__reports_an_unexpected_error_in_one_sentence(capture, run, monkeypatch):
    def fail(*_, **__):
        raise AttributeError("'NoneType' object has no attribute 'a'")

    monkeypatch.setattr("morgs_mi.extras.calibration.command.load_capture", fail)
    assert_refused(
        run("info", capture),
        "Unexpected AttributeError: 'NoneType' object has no attribute 'a'",
        "--debug",
    )


def test_main__names_a_missing_empty_or_truncated_stream(stream, tmp_path, run):
    assert_refused(
        run("render", tmp_path, "--camera", 0), "stream.morgs: expected a stream, found none"
    )
    assert_refused(run("eval", stream), "expected the path of its capture", "--capture")
    stream.write_bytes(stream.read_bytes()[:-75])
    parts = ("truncated or still written", "packet 2", "2 packets before it can be read")
    assert_refused(run("render", stream, tmp_path / "a.mp4", "--camera", 0), str(stream), *parts)
    with StreamWriter(stream, rig(), 25):
        pass
    for output in (tmp_path / "a.mp4", tmp_path / "exr"):
        assert_refused(
            run("render", stream, output, "--camera", 0),
            "expected at least one frame, got a header alone",
        )
        assert not output.exists()


def test_main__prints_a_traceback_with_debug(tmp_path, run):
    status, _, error = run("info", tmp_path / "nothing", "--debug")
    assert status == 1
    assert "Traceback" in error
    assert "load_capture" in error
