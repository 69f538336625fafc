"""First steps and first mistakes on the command line."""

from __future__ import annotations

import shutil
import subprocess
import sys

import pytest

from morgs_mi.cli.main import main
from morgs_mi.io.ply import write_ply
from morgs_mi.playback.export.formats import VIDEO, WEB, destination
from morgs_mi.playback.streams import stream_path
from tests.scenes.gaussians import make_unit_scene, to_gaussians


def test_stream_path__finds_the_fit_in_a_folder(tmp_path):
    for name in ("stream", "stream_plain"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "stream.morgs").write_bytes(b"\x89MORGS\r\n")
    assert stream_path(tmp_path).parent == tmp_path / "stream"
    (tmp_path / "stream").rename(tmp_path / "other")
    with pytest.raises(FileNotFoundError, match="expected a stream, found none"):
        stream_path(tmp_path)  # either may be meant
    (tmp_path / "other/stream.morgs").unlink()
    assert stream_path(tmp_path).parent == tmp_path / "stream_plain"
    with pytest.raises(FileNotFoundError, match="typo: no such file or folder; check the path"):
        stream_path(tmp_path / "typo")


def test_destination__is_named_after_its_source(tmp_path):
    names = [
        destination(tmp_path / source, None, formats, "orbit")[0].name
        for source in ("guitar.compressed.ply", "stream.morgs")
        for formats in (WEB, VIDEO)
    ]
    assert names == ["guitar-player.html", "guitar-orbit.mp4", "player.html", "orbit.mp4"]


def test_info__describes_a_file_of_gaussians(tmp_path, capsys):
    file = tmp_path / "scene.ply"
    write_ply(file, to_gaussians(make_unit_scene()))
    assert main(["info", str(file)]) == 0
    output, error = capsys.readouterr()
    assert "Gaussians(N=" in output
    assert "MB of memory" in output
    assert output.splitlines()[-1] == f"Next: morgs-mi view {file}"
    assert error == ""


def test_info__finds_the_fit_in_a_folder(fitted_clip, tmp_path, capsys):
    shutil.copytree(fitted_clip, tmp_path / "demo" / "stream")
    assert main(["info", str(tmp_path / "demo")]) == 0
    assert "stream.morgs: " in capsys.readouterr().out


def test_commands__without_llvm_print_a_sentence():
    program = """
import sys, types
module = types.ModuleType("morgs_mi.core.llvm")
def ensure_llvm():
    raise RuntimeError("Dr.Jit's CPU backend needs LLVM.")
module.ensure_llvm = ensure_llvm
sys.modules["morgs_mi.core.llvm"] = module
sys.argv = ["/usr/bin/morgs-mi", "demo"]
import morgs_mi
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False)
    assert (result.returncode, result.stderr) == (1, b"Dr.Jit's CPU backend needs LLVM.\n")
