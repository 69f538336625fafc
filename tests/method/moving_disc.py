"""Two frames in which a textured disc moves over a textured background."""

import cv2
import numpy as np

from morgs_mi.method.flow import observe_key_views
from morgs_mi.method.flow_sources.flow_registry import FramePair


def texture(height, width, seed):
    """Return a random texture [H, W, 3] in [0, 1] with detail of 2 to 8 pixels."""
    rng = np.random.default_rng(seed)
    octaves = [
        cv2.resize(
            rng.random((height // s + 4, width // s + 4, 3)),
            (width, height),
            interpolation=cv2.INTER_CUBIC,
        )
        * s
        for s in (2, 4, 8)
    ]
    return np.clip(sum(octaves) / 14, 0, 1)


def moving_disc(height, width, shift, noise=0.0, seed=0):
    """Return I_{t-1}, I_t [H, W, 3] and the disc's mask [H, W] in frame t; `shift` is (x, y) in
    pixels.
    """
    rng = np.random.default_rng(seed)
    background = texture(height, width, 1)
    disc = texture(height, width, 2) * (1.0, 0.6, 0.4)
    y, x = np.mgrid[:height, :width]
    frames = []
    for dx, dy in ((0, 0), shift):
        mask = np.hypot(x - 0.4 * width - dx, y - 0.5 * height - dy) < 0.2 * height
        frame = np.where(mask[..., None], np.roll(disc, (dy, dx), (0, 1)), background)
        frames.append(np.clip(frame + rng.normal(0, noise, frame.shape), 0, 1))
    return frames[0], frames[1], mask


def observed(image, previous, mask_method=None):
    """Return the flow observation of two images of one camera."""
    return observe_key_views({0: FramePair(image, previous)}, "dis", mask_method)[0]
