"""Gaussians of a file with numbers that no renderer can use, as trainers write now and then."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from morgs_mi.core.checks import LARGEST
from morgs_mi.core.gaussians import Gaussians

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


def without_invalid(path: str | Path, gaussians: Gaussians, most_invalid: float) -> Gaussians:
    """Return the Gaussians of a file without the invalid ones, with a warning that names them.

    An invalid Gaussian has NaN, infinity or a number above 1e12 in an attribute. A rotation of
    length 0 is none.

    Args:
        path: the file.
        gaussians: N Gaussians.
        most_invalid: share of them that may be invalid, 0 to 1.

    Raises:
        ValueError: more of them are invalid.
    """
    raw = gaussians.numpy()
    N = len(gaussians)
    zero = np.flatnonzero(~raw["quats"].any(axis=1))
    if len(zero):
        _log.warning(
            "%s: %d of %d Gaussians have a rotation of 0 and are not rotated: %s.",
            path,
            len(zero),
            N,
            _few(zero),
        )
    limits = {name: np.log(LARGEST) if name == "log_scales" else LARGEST for name in raw}
    # Small sizes have negative logarithms without a bound.
    valid = {
        name: ((values <= limits[name]) & (values >= -LARGEST)).all(
            axis=tuple(range(1, values.ndim))
        )
        for name, values in raw.items()
    }
    every = np.all([*valid.values()], axis=0)
    count = int(N - every.sum())
    if not count:
        return gaussians
    details = "; ".join(
        f"{_WORDS.get(name, name)} of {_few(np.flatnonzero(~rows))}"
        for name, rows in valid.items()
        if not rows.all()
    )
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


def _few(rows: np.ndarray) -> str:
    """Return the first indices in words."""
    more = len(rows) - _MOST_NAMED
    return ", ".join(map(str, rows[:_MOST_NAMED])) + (f" and {more} more" if more > 0 else "")
