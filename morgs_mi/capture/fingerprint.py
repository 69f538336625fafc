"""Fingerprints of a recording and of its frames: digests of images and points, by which a stream
recognises them.
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


def image_fingerprints(images: Sequence[np.ndarray | None]) -> tuple[str, ...]:
    """Return a digest of each image's rows 0, 8, 16 ..., as 8 hexadecimal digits, which differ in
    another take; "" for None, a missing image.
    """
    return tuple(
        "" if image is None else blake2b(image[::8].tobytes(), digest_size=4).hexdigest()
        for image in images
    )
