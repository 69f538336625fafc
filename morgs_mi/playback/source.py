"""The cameras with which a capture was fitted, in the header of its stream."""

from __future__ import annotations

from typing import Any

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.codec.frame_source import FrameSource


def as_fitted(capture: Capture, stream: FrameSource) -> Capture:
    """Return a capture with the cameras of a stream, which its fit may have refined.

    Raises:
        ValueError: the distortions in the stream's header are no pairs of numbers.
    """
    distortions = stream.metadata.get("distortions", {})
    try:
        terms = np.array([distortions.get(name, (0, 0)) for name in capture.names], np.float64)
    except (AttributeError, TypeError, ValueError):
        terms = np.full((1, 1), np.nan)
    if terms.shape[1:] != (2,) or not np.isfinite(terms).all():
        raise ValueError(
            f"{stream.path}: packet 0: `distortions` must be an object with two numbers for each "
            "camera; fit the capture again."
        )
    return capture.with_cameras(capture.with_delays(stream.cameras), terms.tolist())


def about_lenses(capture: Capture) -> dict[str, Any]:
    """Return the entries of a stream's header that `as_fitted` reads, none where no distortion was
    refined.
    """
    pairs = zip(capture.names, capture.distortions, strict=bool(capture.distortions))
    distortions = {name: list(terms) for name, terms in pairs if any(terms)}
    return {"distortions": distortions} if distortions else {}
