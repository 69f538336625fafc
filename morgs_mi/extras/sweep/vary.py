"""What a sweep varies."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Vary:
    """What a sweep varies along its curves, and the measure that it compares.

    Attributes:
        epochs: passes over the views for every later frame.
        first_frame_steps: steps of fits of the first frame alone.
        measure: "psnr", "psnr_moving", "ssim", "motion_error_moving", or "lpips:FILE.onnx" with a
            network as `morgs-mi eval --lpips` takes it.
    """

    epochs: tuple[int, ...] = (1, 2, 4, 8)
    first_frame_steps: tuple[int, ...] = (100, 300, 1000)
    measure: str = "psnr"
