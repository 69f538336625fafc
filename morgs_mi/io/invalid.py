"""Gaussians of a file with numbers that no renderer can use, as trainers write now and then."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from morgs_mi.core.checks import LARGEST, few
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
            *(path, len(zero), N, few(zero, _MOST_NAMED)),
        )
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
    if every.any():
        middle = np.median(raw["means"][every], axis=0)
        size = np.exp(np.median(raw["log_scales"][every]))
        if 10 * np.spacing(np.abs(middle)).max() > size:
            _log.warning(
                "%s: the centres, around (%g, %g, %g), are so far from 0 that float32 rounds them "
                "by a tenth of the Gaussians' sizes or more; subtract an origin before they are "
                "exported.",
                *(path, *middle),
            )
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
        *(path, count, N, LARGEST, details),
    )
    return gaussians.select(every)
