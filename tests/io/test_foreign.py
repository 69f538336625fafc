"""Formats of Gaussians that are not read: recognised by content and by name, and named with what
converts them.
"""

from __future__ import annotations

import gzip
import zipfile
from io import BytesIO

import pytest

from morgs_mi.extras.imports.import_frames import import_frames
from morgs_mi.io.splats import read_splats
from morgs_mi.playback.streams import open_stream

SPZ = gzip.compress(b"NGSP" + bytes(100))


def archive(*names: str) -> bytes:
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        for name in names:
            file.writestr(name, "{}")
    return buffer.getvalue()


FILES = {
    "a.spz": (SPZ, "SPZ", "splat-transform"),
    "c.ply": (SPZ, "SPZ", "splat-transform"),
    "d.bin": (b"NGSP" + bytes(60), "SPZ", "splat-transform"),
    "a.ksplat": (bytes(99), "KSPLAT", "SuperSplat"),
    "b.ply": (archive("meta.json", "means_l.webp"), "SOG", "SuperSplat"),
    "meta.json": (b"{}", "SOG", "SuperSplat"),
    "e.ply.gz": (gzip.compress(b"ply\n"), "an archive", "unpack it"),
    "a.glb": (b"glTF" + bytes(20), "glTF", "export it as .ply"),
    "a.gltf": (b'{"extensionsUsed": ["KHR_gaussian_splatting"]}', "glTF", "export it as .ply"),
    "g.splat": (b"ply\nformat ascii 1.0\n", "PLY", "rename it to .ply"),
    "a.usdz": (archive("a.usdc"), "OpenUSD", "export it as .ply"),
    "params.npz": (archive("means.npy"), "an archive of NumPy", "export it as .ply"),
    "chkpnt30000.pth": (archive("data.pkl"), "a checkpoint", "export it as .ply"),
}


@pytest.mark.parametrize("name", FILES)
def test_refuse_foreign__names_format_and_remedy_at_every_door(tmp_path, name):
    content, kind, remedy = FILES[name]
    (tmp_path / name).write_bytes(content)
    for door in (open_stream, read_splats, lambda path: import_frames([path], tmp_path / "out")):
        with pytest.raises(
            ValueError, match=rf"{name}: expected Gaussians as \.ply.*, got {kind}.*{remedy}"
        ):
            door(tmp_path / name)


def test_open_stream__names_what_to_do_with_a_folder_of_gaussians(tmp_path):
    (tmp_path / "1.ply").touch()
    with pytest.raises(
        ValueError, match=r"got a folder with 1 files of Gaussians.*1\.ply, or run .*import"
    ):
        open_stream(tmp_path)
    (tmp_path / "meta.json").write_text("{}")
    with pytest.raises(ValueError, match="got SOG"):
        open_stream(tmp_path)
