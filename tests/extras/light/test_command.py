"""`morgs-mi render --insert`."""

import pytest

from morgs_mi.io.exr import read_exr
from tests.cli.commands import assert_refused


@pytest.mark.parametrize(
    ("args", "parts"),
    [
        (["--camera", "0", "--insert", "no.xml"], ("no.xml", "expected a scene to insert")),
        (
            ["--camera", "0", "--at", "1"],
            ("--at: expected an inserted scene, got none; add --insert FILE",),
        ),
        (
            ["--insert", "no.py"],
            ("--insert: expected one camera, got none; add --camera CAMERA",),
        ),
        (
            ["--camera", "0", "--insert", "no.py", "--background", "transparent"],
            ("--insert: expected a background behind the Gaussians, got --background transparent",),
        ),
    ],
)
def test_render__rejects_bad_input_in_one_sentence(stream, tmp_path, run, args, parts):
    assert_refused(run("render", stream, *args), *parts)
    assert list(tmp_path.iterdir()) == [stream]


@pytest.mark.slow
def test_render__inserts_a_scene_into_some_frames(stream, tmp_path, run):
    (tmp_path / "ball.py").write_text(
        'def build(frame, time):\n    return {"ball": {"type": "sphere"}}\n'
    )
    args = ("--camera", 0, "--insert", tmp_path / "ball.py", "--at", 1, "--samples", 1)
    assert run("render", stream, tmp_path / "exr", *args)[0] == 0
    assert [path.name for path in (tmp_path / "exr").iterdir()] == ["0001.exr"]
    assert {"R", "A", "depth.Y"} <= read_exr(tmp_path / "exr" / "0001.exr").keys()
