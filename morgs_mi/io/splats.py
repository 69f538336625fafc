"""Gaussians in the files of other tools: PLY in the layout of 3D Gaussian Splatting, compressed
PLY, and `.splat`.

A `.splat` file has 32 bytes per Gaussian and nothing else: centre and standard deviations as
float32 [3] each, colour and opacity as uint8 [4] of 0 to 1, and the quaternion wxyz as uint8 [4] of
-1 to 1, where 128 is zero.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from morgs_mi.core.color_space import SH_C0
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.io.compressed_ply import read_compressed_ply
from morgs_mi.io.foreign import refuse_foreign
from morgs_mi.io.invalid import without_invalid
from morgs_mi.io.listing import existing_file
from morgs_mi.io.ply import read_ply

SUFFIXES = (".compressed.ply", ".ply", ".splat")
"""Ends of the names of files that `read_splats` reads."""

_RECORD = np.dtype(
    [
        ("means", "<f4", 3),
        ("scales", "<f4", 3),
        ("color", "u1", 3),
        ("opacity", "u1"),
        ("quats", "u1", 4),
    ]
)


def suffix_of(path: str | Path) -> str | None:
    """Return the suffix of a file out of `SUFFIXES`, in any case of letters, or None."""
    name = Path(path).name.lower()
    return next((suffix for suffix in SUFFIXES if name.endswith(suffix)), None)


def read_splats(path: str | Path, most_invalid: float = 0.0) -> Gaussians:
    """Return the Gaussians in a file. Its name determines its format; a `.ply` may also be
    compressed.

    Args:
        path: the file.
        most_invalid: share of Gaussians that are left out with a warning because a number of theirs
            is not finite, or a centre, size or coefficient is above 1e12; 0: none.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file has another format, is broken or truncated, or has more invalid
            Gaussians.
    """
    path = existing_file(path, "a file with Gaussians")
    refuse_foreign(path)
    suffix = suffix_of(path)
    if suffix is None:
        raise ValueError(
            f"{path}: expected a name that ends in {', '.join(SUFFIXES)}, got {path.suffix!r}."
        )
    with path.open("rb") as file:
        header = file.read(4096).partition(b"end_header")[0]
    if suffix == ".splat":
        read = _read_splat
    elif suffix == ".compressed.ply" or b"packed_position" in header:
        read = read_compressed_ply
    else:
        read = read_ply
    return without_invalid(path, read(path), most_invalid)


def _read_splat(path: Path) -> Gaussians:
    size = path.stat().st_size
    if size % _RECORD.itemsize:
        raise ValueError(
            f"{path}: expected {_RECORD.itemsize} bytes a Gaussian, got {size}; export it again."
        )
    records = np.fromfile(path, _RECORD)
    scales = np.where(records["scales"] >= 0, records["scales"], np.nan)
    quats = (records["quats"] - 128.0) / 128
    colors = (records["color"] / 255 - 0.5) / SH_C0
    opacities = records["opacity"] / 255
    return Gaussians.from_activated(records["means"], scales, quats, opacities, colors[:, None])
