"""Gaussians in the files of other tools: PLY in the layout of 3D Gaussian Splatting, compressed
PLY, and `.splat`.

A `.splat` file has 32 bytes per Gaussian and nothing else: centre and standard deviations as
float32 [3] each, colour and opacity as uint8 [4] of 0 to 1, and the quaternion wxyz as uint8 [4] of
-1 to 1, where 128 is zero.

Gaussians of a file with numbers that no renderer can use, as trainers write now and then.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from morgs_mi.core.color_space import SH_C0
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.io.compressed_ply import read_compressed_ply
from morgs_mi.io.listing import existing_file
from morgs_mi.io.ply import read_ply
from morgs_mi.platform.checks import LARGEST, few, require

_log = logging.getLogger(__name__)

_WORDS = {
    "means": "centre",
    "log_scales": "size",
    "quats": "rotation",
    "logit_opacities": "opacity",
    "sh_coeffs": "colour",
    "logit_confidence": "confidence",
}
_MOST_NAMED = 3
SUFFIXES = (".compressed.ply", ".ply", ".splat")
"""Ends of the names of files that `read_splats` reads."""
CONVERT = (
    "convert it to .ply with SuperSplat (superspl.at/editor) or splat-transform "
    "(@playcanvas/splat-transform), or export .ply from the program that wrote it"
)
"""What to do with Gaussians in another format, for messages."""
_RECORD = np.dtype(
    [
        ("means", "<f4", 3),
        ("scales", "<f4", 3),
        ("color", "u1", 3),
        ("opacity", "u1"),
        ("quats", "u1", 4),
    ]
)


@np.errstate(invalid="ignore")  # of NaN that signal, which a damaged file may have
def without_invalid(path: str | Path, gaussians: Gaussians, most_invalid: float) -> Gaussians:
    """Return the Gaussians of a file without the invalid ones, with a warning that names them.

    An invalid Gaussian has NaN, infinity or a number above 1e12 in an attribute.

    Args:
        path: the file.
        gaussians: N Gaussians.
        most_invalid: share of them that may be invalid, 0 to 1.

    Raises:
        ValueError: more of them are invalid.
    """
    raw = gaussians.numpy()
    N = len(gaussians)
    every = np.ones(N, bool)
    faults = []
    for name, values in raw.items():
        # Small sizes have negative logarithms without a bound.
        limit = np.log(LARGEST) if name == "log_scales" else LARGEST
        within = (values <= limit) & (values >= -LARGEST)
        rows = np.logical_and.reduce(within, axis=tuple(range(1, values.ndim)))
        if not rows.all():
            numbers = few(np.flatnonzero(~rows), _MOST_NAMED)
            faults.append(f"{_WORDS.get(name, name)} of {numbers}")
        every &= rows
    count = int(N - every.sum())
    if not count:
        return gaussians
    details = "; ".join(faults)
    if count > most_invalid * N:
        raise ValueError(
            f"{path}: expected finite numbers of at most {LARGEST:g}, others in {count} of {N} "
            f"Gaussians ({details}); leave them out with --drop-invalid, in Python with "
            "`most_invalid=1`, or export the file again."
        )
    _log.warning(
        "%s: %d of %d Gaussians are left out, whose numbers are not finite or above %g: %s.",
        path,
        count,
        N,
        LARGEST,
        details,
    )
    return gaussians.select(every)


def suffix_of(path: str | Path) -> str | None:
    """Return the suffix of a file out of `SUFFIXES`, in any case of letters, or None."""
    return next(filter(Path(path).name.lower().endswith, SUFFIXES), None)


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
    suffix = suffix_of(path)
    require(
        suffix, path, "expected Gaussians as .ply, .compressed.ply or .splat", path.name, CONVERT
    )
    with path.open("rb") as file:
        header = file.read(4096).partition(b"end_header")[0]
    if suffix == ".splat":
        read = _read_splat
    elif b"packed_position" in header:
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
