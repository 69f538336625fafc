"""Gaussians in the files of other tools: PLY in the layout of 3D Gaussian Splatting, compressed PLY, and `.splat`.

A `.splat` file has 32 bytes per Gaussian and nothing else: centre and standard deviations as float32 [3] each, colour
and opacity as uint8 [4] of 0 to 1, and the quaternion wxyz as uint8 [4] of -1 to 1, where 128 is zero.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from morgs_mi.core.checks import LARGEST, bounded
from morgs_mi.core.color_space import SH_C0
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.io.compressed_ply import read_compressed_ply
from morgs_mi.io.ply import read_ply

__all__ = ["SUFFIXES", "read_splats", "suffix_of"]

SUFFIXES = (".compressed.ply", ".ply", ".splat")
"""Ends of the names of files that `read_splats` reads."""

_RECORD = np.dtype(
    [("means", "<f4", 3), ("scales", "<f4", 3), ("color", "u1", 3), ("opacity", "u1"), ("quats", "u1", 4)]
)


def suffix_of(path: str | Path) -> str | None:
    """Return the suffix of a file out of `SUFFIXES`, in any case of letters, or None."""
    name = Path(path).name.lower()
    return next((suffix for suffix in SUFFIXES if name.endswith(suffix)), None)


def read_splats(path: str | Path) -> Gaussians:
    """Return the Gaussians in a file. Its name determines its format; a `.ply` may also be compressed.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the name has another suffix, the file is broken or truncated, or it has a number that is not finite,
            or a centre, size or coefficient above 1e12.
    """
    suffix = suffix_of(path)
    if suffix is None:
        raise ValueError(
            f"{path}: expected a file whose name ends in {', '.join(SUFFIXES)}, got {Path(path).suffix!r}; convert it."
        )
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: expected a file with Gaussians, found none; check the path.")
    if suffix == ".splat":
        gaussians = _read_splat(Path(path))
    elif suffix == ".compressed.ply" or _is_compressed(Path(path)):
        gaussians = read_compressed_ply(path)
    else:
        gaussians = read_ply(path)
    raw = gaussians.numpy()
    for name, values in (
        ("centres", raw["means"]),
        ("sizes", np.exp(np.float64(raw["log_scales"]).clip(max=99))),
        ("coefficients of colour", raw["sh_coeffs"]),
    ):
        if not bounded(values):
            raise ValueError(f"{path}: expected {name} of at most {LARGEST:g}, got larger ones; clean the Gaussians.")
    return gaussians


def _is_compressed(path: Path) -> bool:
    with path.open("rb") as file:
        return b"packed_position" in file.read(4096).partition(b"end_header")[0]


def _read_splat(path: Path) -> Gaussians:
    size = path.stat().st_size
    if size % _RECORD.itemsize:
        raise ValueError(
            f"{path}: expected {_RECORD.itemsize} bytes for each Gaussian, got {size} bytes, which is no multiple; the "
            "file is truncated or no .splat, export it again."
        )
    records = np.fromfile(path, _RECORD)
    for name, least in (("means", -np.inf), ("scales", 0)):
        good = (np.isfinite(records[name]) & (records[name] >= least)).all(axis=1)
        if not good.all():
            row = np.flatnonzero(~good)[0]
            raise ValueError(
                f"{path}: expected finite {name}{' of at least 0' if least == 0 else ''}, got "
                f"{records[name][row].tolist()} in Gaussian {row}; the file is damaged or no .splat, export it again."
            )
    quats = (records["quats"] - 128.0) / 128
    colors = (records["color"] / 255 - 0.5) / SH_C0
    return Gaussians.from_activated(
        records["means"], records["scales"], quats, records["opacity"] / 255, colors[:, None]
    )
