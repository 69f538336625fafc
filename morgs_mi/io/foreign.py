"""Files of Gaussians in other formats than those that are read, recognised by their names and their
first bytes.

The first bytes of a file decide before its name, because files are renamed.
"""

from __future__ import annotations

import zlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

_CONVERTERS = (
    "convert it to .ply with SuperSplat (superspl.at/editor) or splat-transform "
    "(@playcanvas/splat-transform)"
)
_EXPORT = "export it as .ply in the layout of 3D Gaussian Splatting from the program that wrote it"
_HEAD = 4096


@dataclass(frozen=True)
class _Format:
    """A format that is not read."""

    name: str  # in words
    endings: tuple[str, ...]  # of the names of its files
    remedy: str = _CONVERTERS  # how to get a file that is read


_SPZ = _Format("SPZ (Niantic's compressed format)", (".spz",))
_SOG = _Format("SOG (PlayCanvas' compressed format)", (".sog", ".sogs", "meta.json"))
_GLTF = _Format("glTF (KHR_gaussian_splatting)", (".glb", ".gltf"), _EXPORT)
_USD = _Format("OpenUSD", (".usd", ".usda", ".usdc", ".usdz"), _EXPORT)
_ARCHIVE = _Format(
    "an archive", (".zip", ".7z", ".tar", ".gz", ".tgz"), "unpack it, and name the .ply in it"
)
_NUMPY = _Format("an archive of NumPy", (".npz", ".npy"), _EXPORT)
_CHECKPOINT = _Format("a checkpoint of a training", (".pt", ".pth", ".ckpt"), _EXPORT)
_PLY = _Format("PLY", (), "rename it to .ply")
_FORMATS = (
    _SPZ,
    _Format("KSPLAT (of GaussianSplats3D)", (".ksplat",)),
    _SOG,
    _Format("LCC (of XGRIDS)", (".lcc",)),
    _Format("SPLATV (a moving scene in several timestamps)", (".splatv",), _EXPORT),
    _Format("a compressed format of Gaussians", (".gsz", ".rad", ".splatz", ".cply"), _EXPORT),
    _GLTF,
    _USD,
    _NUMPY,
    _CHECKPOINT,
    _ARCHIVE,
)
# Formats by the first bytes of their files.
_STARTS = {
    b"NGSP": _SPZ,
    b"glTF": _GLTF,
    b"PXR-USDC": _USD,
    b"#usda": _USD,
    b"\x93NUMPY": _NUMPY,
}


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
    name = path.name.lower()
    name_format = next((kind for kind in _FORMATS if name.endswith(kind.endings)), None)
    kind = _by_content(head, name_format, name) or name_format
    if kind is not None:
        raise ValueError(
            f"{path}: expected Gaussians as .ply, .compressed.ply or .splat, got {kind.name}, "
            f"which is not read; {kind.remedy}."
        )


def _by_content(head: bytes, name_format: _Format | None, name: str) -> _Format | None:
    """Return the format that begins with these bytes."""
    for start, kind in _STARTS.items():
        if head.startswith(start):
            return kind
    if head[:2] == b"\x1f\x8b":
        with suppress(zlib.error):
            if zlib.decompressobj(wbits=31).decompress(head, 16)[:4] == b"NGSP":
                return _SPZ
        return name_format or _ARCHIVE
    if head[:4] == b"PK\x03\x04":
        return _SOG if b"meta.json" in head else name_format or _ARCHIVE
    if b"KHR_gaussian_splatting" in head:
        return _GLTF
    if head[:4] in (b"ply\n", b"ply\r") and not name.endswith(".ply"):
        return _PLY
    return None
