"""Fingerprint of a recording: a digest of its first images and its points, by which a stream
recognises it.
"""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import blake2b

import numpy as np

from morgs_mi.capture.capture import Capture


def fingerprint(
    capture: Capture, images: Sequence[np.ndarray | None], with_cameras: bool = False
) -> str:
    """Return the digest of a recording as 16 hexadecimal digits.

    Args:
        capture: the recording, as it was read.
        images: of its first frame, as it was read: downscaled and colour-corrected. None: missing.
        with_cameras: whether the calibration counts, as for a fit that refines it.
    """
    cameras = (
        [matrix for camera in capture.cameras for matrix in (camera.K, camera.viewmat)]
        if with_cameras
        else []
    )
    digest = blake2b(digest_size=8)
    for array in (*images, capture.points, capture.point_colors, *cameras):
        digest.update(b"" if array is None else np.ascontiguousarray(array).data)
    return digest.hexdigest()
