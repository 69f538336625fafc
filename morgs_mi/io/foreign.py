"""Files of Gaussians in other formats than those that are read, recognised by their names and their
first bytes.

The first bytes of a file decide before its name, because files are renamed.
"""

from __future__ import annotations

import re
import zlib
from contextlib import suppress
from pathlib import Path

_CONVERTERS = (
    "convert it to .ply with SuperSplat (superspl.at/editor) or splat-transform "
    "(@playcanvas/splat-transform)"
)
_EXPORT = "export it as .ply in the layout of 3D Gaussian Splatting from the program that wrote it"
_HEAD = 4096


# Formats: in words, ends of the names of files, pattern of their first bytes, and how to get a file
# that is read.
_FORMATS = (
    ("SPZ (Niantic's compressed format)", (".spz",), b"NGSP", _CONVERTERS),
    ("KSPLAT (of GaussianSplats3D)", (".ksplat",), None, _CONVERTERS),
    (
        "SOG (PlayCanvas' compressed format)",
        (".sog", ".sogs", "meta.json"),
        rb"PK\x03\x04.*meta\.json",
        _CONVERTERS,
    ),
    ("LCC (of XGRIDS)", (".lcc",), None, _CONVERTERS),
    ("SPLATV (a moving scene in several timestamps)", (".splatv",), None, _EXPORT),
    ("a compressed format of Gaussians", (".gsz", ".rad", ".splatz", ".cply"), None, _EXPORT),
    (
        "glTF (KHR_gaussian_splatting)",
        (".glb", ".gltf"),
        b"glTF|.*KHR_gaussian_splatting",
        _EXPORT,
    ),
    ("OpenUSD", (".usd", ".usda", ".usdc", ".usdz"), b"PXR-USDC|#usda", _EXPORT),
    ("an archive of NumPy", (".npz", ".npy"), rb"\x93NUMPY", _EXPORT),
    ("a checkpoint of a training", (".pt", ".pth", ".ckpt"), None, _EXPORT),
)
_PLY = ("PLY", (".ply",), b"ply[\r\n]", "rename it to .ply")
_ARCHIVE = (
    "an archive",
    (".zip", ".7z", ".tar", ".gz", ".tgz"),
    rb"PK\x03\x04|\x1f\x8b",
    "unpack it, and name the .ply in it",
)


def refuse_foreign(path: str | Path) -> None:
    """Raise an error if a file has Gaussians in a format that is not read.

    Raises:
        ValueError: it does; the sentence names the format and what converts it.
    """
    path = Path(path)
    head = b""
    if path.is_file():
        with path.open("rb") as file:
            head = file.read(_HEAD)
    with suppress(zlib.error):  # SPZ is compressed as a whole
        content = zlib.decompressobj(wbits=31).decompress(head, 16)
        head = content if content.startswith(b"NGSP") else head
    name = path.name.lower()
    formats = _FORMATS if name.endswith(".ply") else (*_FORMATS, _PLY)
    by_content, archives = (
        [kind for kind in kinds if kind[2] and re.match(kind[2], head, re.DOTALL)]
        for kinds in (formats, (_ARCHIVE,))
    )
    by_name = [kind for kind in (*_FORMATS, _ARCHIVE) if name.endswith(kind[1])]
    for words, _, _, remedy in (*by_content, *by_name, *archives):
        raise ValueError(
            f"{path}: expected Gaussians as .ply, .compressed.ply or .splat, got {words}, "
            f"which is not read; {remedy}."
        )
