"""Report of a frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from morgs_mi.method.exposure import Exposure
from morgs_mi.platform.checks import quantity


@dataclass(frozen=True)
class FrameReport:
    """Report of one frame.

    Attributes:
        frame: its index.
        seconds: wall time from the images to the packet. It includes the optical flow, unless
            `StreamLoop.push` got the images early, as `upcoming` ones of the last frame.
        num_bytes: size of the packet in the stream.
        losses: means over the last steps, by the names of the terms.
        num_gaussians: number of Gaussians of the frame.
        psnr: of the training views, dB, by their mean squared error in the last steps, in the
            pixels that were fitted: all valid ones in the first frame, with its dropout, and those
            of the active set in later ones. NaN if nothing was fitted.
        status: "ok", or a sentence about a problem and how it was handled.
        missing_views: names of the views without an image.
        active: fractions that took part, by name: gaussians, views, pixels.
        validation: of the first frame, a `sentence` on views between the cameras, with the fields
            of `Forecast` (see `fit.forecast`); empty with a single view.
        steps: number of optimisation steps.
        exposures: gain and bias of each view; empty if they are not estimated.
        memory: of the process, bytes: ``resident`` after the frame, and the ``peak`` so far; empty
            where the system does not report them.
        fingerprints: of the images of all cameras, see `image_fingerprints`; empty if they were not
            read from a recording.
    """

    frame: int
    seconds: float
    num_bytes: int
    losses: dict[str, float]
    num_gaussians: int
    status: str = "ok"
    missing_views: tuple[str, ...] = ()
    active: dict[str, float] = field(default_factory=dict)
    validation: dict[str, Any] = field(default_factory=dict)
    steps: int = 0
    exposures: tuple[Exposure, ...] = ()
    memory: dict[str, int] = field(default_factory=dict)
    fingerprints: tuple[str, ...] = ()
    psnr: float = math.nan

    def __repr__(self) -> str:
        gaussians = quantity(self.num_gaussians, "Gaussian")
        size = f"{gaussians}, {self.num_bytes} bytes, {self.seconds:.1f} s"
        return f"FrameReport(frame {self.frame}, {size}, {self.status})"
