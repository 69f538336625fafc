"""What the reports on fits share: clips of random scenes, loops over a capture's views, and first frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from morgs_mi import StreamLoop, rasterize
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.config import StreamConfig
from morgs_mi.core.camera import Camera
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.stream_loop import FrameReport
from morgs_mi.synth.synth_config import SynthConfig
from morgs_mi.synth.synthesize import synthesize

__all__ = ["first_frame", "new_loop", "random_capture"]


def random_capture(clips: Path, seed: int, downscale: float = 1) -> Capture:
    """Return the random scene of a seed, which is made in the folder `clips` if it is not there."""
    clip = clips / f"random-{seed}"
    if not clip.exists():
        synthesize("random", clip, SynthConfig(frames=8, seed=seed))
    return load_capture(clip, downscale)


def new_loop(capture: Capture, config: StreamConfig, train: Sequence[int] | None = None) -> StreamLoop:
    """Return a loop over the views `train` of a capture, its training views if they are None."""
    train = capture.train_views if train is None else train
    cameras, masks = [capture.cameras[v] for v in train], [capture.masks[v] for v in train]
    return StreamLoop(cameras, capture.points, capture.point_colors, config, masks)


def first_frame(capture: Capture, train: Sequence[int], config: StreamConfig) -> tuple[np.ndarray, FrameReport]:
    """Fit the first frame to the views `train`; return the PSNR of each view of the capture [C], and the report."""
    loop, images = new_loop(capture, config, train), next(capture.frames(0, 1)).images
    _, report = loop.push([images[v] for v in train])
    gaussians = loop.gaussians
    assert gaussians is not None

    def score(camera: Camera, image: np.ndarray, mask: np.ndarray | None) -> float:
        found, valid = np.asarray(rasterize(gaussians, camera, ("color",)).color), slice(None) if mask is None else mask
        return psnr(np.clip(found, 0, 1)[valid], image[valid] / 255.0)

    return np.array([score(*view) for view in zip(capture.cameras, images, capture.masks, strict=True)]), report
