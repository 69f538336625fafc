"""Outputs must lie outside of captures."""

import pytest

from morgs_mi.capture.outputs import check_output
from tests.scenes.captures import (
    anipose,
    colmap,
    dynamic3dgs,
    easymocap,
    meet_room,
    n3dv,
    nerfstudio,
    qualisys,
)


@pytest.mark.parametrize(
    "build", [colmap, nerfstudio, dynamic3dgs, n3dv, meet_room, anipose, qualisys, easymocap]
)
def test_check_output__refuses_captures_of_every_layout(tmp_path, build):
    capture = build(tmp_path / "clip")
    (tmp_path / "link").symlink_to(capture)
    for path in (
        capture,
        capture / "new",
        tmp_path / "link" / "a" / "b.mp4",
        f"{capture}/../clip/c",
    ):
        with pytest.raises(
            ValueError,
            match=f"expected an output outside of captures, .* in the capture {capture};",
        ):
            check_output(path)


def test_check_output__accepts_the_folder_around_a_capture(tmp_path):
    colmap(tmp_path / "clip")
    for path in (tmp_path, tmp_path / "clip-fit", tmp_path / "clip.mp4"):
        assert check_output(path) == path


def test_check_output__ignores_other_toml_files_around(tmp_path):
    """They may be broken, or not be files at all."""
    (tmp_path / "pyproject.toml").write_bytes(b"\xff[[")
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / "secret.toml").symlink_to(tmp_path / "nowhere")
    (tmp_path / "file").touch()
    assert check_output(tmp_path / "file" / "new") == tmp_path / "file" / "new"
