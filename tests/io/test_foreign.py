"""Formats of Gaussians that are not read are named with what converts them."""

import pytest

from morgs_mi.io.splats import read_splats
from morgs_mi.playback.streams import open_stream

FILES = {
    "a.spz": "splat-transform",
    "meta.json": "SuperSplat",
    "e.ply.gz": "unpack it",
    "a.GLB": "export it as .ply",
    "g.splat": "rename it to .ply",
    "chkpnt30000.pth": "export it as .ply",
}


@pytest.mark.parametrize("name", FILES)
def test_refuse_foreign__names_the_remedy_at_every_door(tmp_path, name):
    (tmp_path / name).write_bytes(b"ply\nformat ascii 1.0\n" if name == "g.splat" else b"")
    for door in (open_stream, read_splats):
        with pytest.raises(
            ValueError, match=rf"{name}: expected Gaussians as \.ply.*{FILES[name]}"
        ):
            door(tmp_path / name)


def test_open_stream__names_what_to_do_with_a_folder_of_gaussians(tmp_path):
    (tmp_path / "1.ply").touch()
    with pytest.raises(
        ValueError, match=r"got a folder with 1\.ply; name one of them, or .*import"
    ):
        open_stream(tmp_path)
    (tmp_path / "meta.json").write_text("{}")
    with pytest.raises(ValueError, match="SuperSplat"):
        open_stream(tmp_path)
