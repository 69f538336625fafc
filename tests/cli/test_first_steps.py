"""First steps and first mistakes on the command line."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from morgs_mi.cli.export import EXPORTS
from morgs_mi.cli.main import main
from morgs_mi.codec.container import MAGIC
from morgs_mi.io.ply import write_ply
from morgs_mi.platform.checks import quantity
from morgs_mi.playback.export.formats import VIDEO, WEB, destination
from morgs_mi.playback.streams import stream_path
from tests.cli.commands import assert_refused
from tests.scenes.gaussians import make_unit_scene, to_gaussians


def test_stream_path__finds_the_stream_in_the_folder_of_a_fit(tmp_path):
    for name in ("stream", "stream_plain"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "stream.morgs").write_bytes(MAGIC)
    assert stream_path(tmp_path / "stream") == tmp_path / "stream/stream.morgs"
    with pytest.raises(ValueError, match="got a folder with stream, stream_plain; name one of"):
        stream_path(tmp_path)
    with pytest.raises(FileNotFoundError, match="typo: no such file or folder; check the path"):
        stream_path(tmp_path / "typo")


def test_destination__is_named_after_its_source(tmp_path):
    names = [
        destination(tmp_path / source, None, formats, "orbit")[0].name
        for source in ("guitar.compressed.ply", "stream.morgs")
        for formats in (WEB, VIDEO)
    ]
    assert names == ["guitar-player.html", "guitar-orbit.mp4", "player.html", "orbit.mp4"]


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (("render", "a.ply", "--path", "orbi"), ("orbi", "(orbit, between or a JSON file)")),
        (("export", "video", "a.ply", "--path", "orbi"), ("(orbit, between or a JSON file)",)),
        (("render", "picture.png"), ("picture.png: expected a stream, or Gaussians as .ply",)),
        (("info", "clip.mp4"), ("clip.mp4: expected a stream, or Gaussians as .ply",)),
        (("eval", "a.ply"), ("a.ply: expected the stream of a fit", "morgs-mi accuracy")),
        (("view", "clip"), ("if clip is a capture, fit it first: morgs-mi fit clip OUT",)),
        (
            ("render", "a.ply", "a.gif"),
            ("FILE.mp4 or FILE.webm or", "got '.gif'; name"),
        ),
        (("fit",), ("CAPTURE with a video or a folder of images for each camera", "got none")),
        (("fit", "clip.mp4"), ("for each camera", "OUT for the result, got clip.mp4")),
        (
            ("fit", "clip.mp4", "out"),
            ("found a file; name one that has a video, or a folder of images",),
        ),
    ],
)
def test_commands__name_what_was_expected_in_a_first_mistake(
    words, parts, tmp_path, run, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    write_ply("a.ply", to_gaussians(make_unit_scene()))
    Path("picture.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    Path("clip.mp4").touch()
    Path("clip").mkdir()
    assert_refused(run(*words), *parts)
    assert not Path("out").exists()


@pytest.mark.parametrize("name", ["info", "calibrate", "fit", "live"])
def test_commands__name_the_field_of_cameras_that_are_left_out(name, capture, tmp_path, run):
    out = tmp_path / "out"
    words = {
        "info": (capture,),
        "calibrate": (capture, "--overwrite"),
        "fit": (capture, out),
        "live": (out, "--camera", 0),
    }[name]
    status, _, error = run(name, *words, "--exclude", "nobody")
    assert status == 1
    assert "`without` must name cameras of " in error.splitlines()[-1]


def test_commands__name_no_folder_in_the_help_that_they_have_no_argument_for(capsys):
    places = (["render"], ["accuracy"], *(["export", name] for name in EXPORTS))
    for words in places:
        with pytest.raises(SystemExit):
            main([*words, "--help"])
        assert "OUT/" not in capsys.readouterr().out


def test_quantity__has_a_plural_unless_it_is_one():
    assert [quantity(count, "frame") for count in range(3)] == ["0 frames", "1 frame", "2 frames"]


def test_info__describes_a_file_of_gaussians(tmp_path, capsys):
    file = tmp_path / "scene.ply"
    write_ply(file, to_gaussians(make_unit_scene()))
    assert main(["info", str(file)]) == 0
    output, error = capsys.readouterr()
    size = f"{file.stat().st_size / 1e6:.1f} MB"
    assert re.fullmatch(
        rf"{file}: [\d,]+ Gaussians, SH degree \d, still, .* x .* x .* units, {size}\.",
        output.splitlines()[0],
    )
    assert "fps" not in output
    assert "camera" not in output
    assert output.splitlines()[-1] == f"Next: morgs-mi view {file}"
    assert error == ""


@pytest.mark.parametrize("inner", ["stream/stream.morgs", "0000.ply"])
def test_stream_path__names_what_a_folder_has_in_place_of_a_stream(tmp_path, run, inner):
    file = tmp_path / "demo" / inner
    file.parent.mkdir(parents=True)
    file.touch()
    name = inner.partition("/")[0]
    for command in ("view", "render"):
        assert_refused(run(command, tmp_path / "demo"), f"got a folder with {name}; name one of")
