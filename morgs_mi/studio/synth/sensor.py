"""Light that a camera with its own clock, rolling shutter and lens receives from a moving scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.studio.synth.disturbances import CameraDisturbance
from morgs_mi.studio.synth.path_tracer import PathTracer
from morgs_mi.studio.synth.synth_config import SynthConfig

# Rows that a rolling shutter reads at one time; at 10 pixels per frame, objects move by 0.2 pixels
# in this time.
_BAND = 4


def check_lenses(cameras: Sequence[Camera], disturbed: Sequence[CameraDisturbance]) -> None:
    """Check that every lens shows the scene up to the corners of its image.

    Raises:
        ValueError: the distortion is too strong for the field of view.
    """
    for camera, item in zip(cameras, disturbed, strict=True):
        if item.distortion < 0:
            corner = np.linalg.norm(camera.K[:2, 2] / np.diag(camera.K)[:2])
            # r (1 + k r^2) grows up to r = 1 / sqrt(-3 k).
            largest = 2 / (3 * np.sqrt(-3 * item.distortion))
            if not corner < 0.98 * largest:
                raise ValueError(
                    "synthesize(): `distortion` must be small enough for the field of view, got "
                    f"{item.distortion:.3g} with corners at the radius {corner:.3g}, which must "
                    f"be below {largest:.3g}; set a smaller one."
                )


def mixed_seed(*numbers: int) -> int:
    """Return a seed that depends on several numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])


def record_light(
    tracer: PathTracer, camera: Camera, own: CameraDisturbance, frame: int, config: SynthConfig
) -> np.ndarray:
    """Return the light of a frame that a camera with its clock, shutter and lens receives, linear
    [H, W, 3].

    Args:
        tracer: the scene; its time is changed.
        camera: the view without distortion.
        own: the camera's disturbance.
        frame: index of the frame.
        config: samples per pixel, their seed and the frame rate.
    """
    assert config.spp is not None
    if not own.rolling_shutter and not own.distortion:
        tracer.set_time((frame + own.time_offset) / config.fps)
        return tracer.light(camera, config.spp, config.seed)
    row_times = own.row_times(frame, camera.height)
    count = -(-camera.height // _BAND) if own.rolling_shutter else 1
    bands = []
    for band, rows in enumerate(np.array_split(np.arange(camera.height), count)):
        tracer.set_time(row_times[rows].mean() / config.fps)
        seed = mixed_seed(config.seed, band)
        bands.append(tracer.light_of_rows(camera, rows, config.spp, seed, own.lens))
    return np.concatenate(bands)
