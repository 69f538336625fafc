"""Settings of a live fit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Gt, Le
from tyro.conf import arg

from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.platform.checks import require
from morgs_mi.platform.config import Count, check_ranges

# Default settings of the loop. Dropped frames cost more than the last epochs of a frame gain, and
# nothing should move during the first frame.
LIVE_STREAM = StreamConfig(fit=FitConfig(epochs=2, first_frame_seconds=30.0))


@dataclass(frozen=True)
class LiveConfig:
    """Settings of a live fit, besides the loop's."""

    calibration: Path | None = None
    """Folder of a calibrated capture of the same cameras; by default they are calibrated by their
    first images.
    """
    without: Annotated[tuple[str, ...], arg(name="exclude", metavar="CAMERA ...")] = ()
    """Calibrated cameras that are left out, by name."""
    downscale: Annotated[float, Ge(1)] = 1
    """Factor by which the images are reduced."""
    test_view: Annotated[tuple[str, ...], arg(name="hold-out", metavar="CAMERA ...")] = ()
    """Held-out cameras, by indices or names; by default all are fitted."""
    frames: Count | None = None
    """Number of frames to fit; by default as many as come."""
    record: bool = True
    """Store the images of all fitted frames; otherwise of the first one alone."""
    fps: Annotated[float, Ge(1e-6), Le(1_000_000)] = 30
    """Frames per second at which the stream is played."""
    timeout: Annotated[float, Gt(0), Le(1_000_000)] = 10
    """Seconds to wait for a camera before it is left out."""
    warm_up: Annotated[float, Ge(0), Le(1_000_000)] = 1
    """Seconds in which the cameras adjust their exposure before the first images are taken; not of
    files.
    """
    size: tuple[int, int] | None = None
    """Width and height of the images that cameras of this machine are asked for; by default they
    choose.
    """

    def check(self) -> None:
        """Check the settings.

        Raises:
            ValueError: one is out of range.
        """
        require(
            not self.without or self.calibration,
            "fit_live()",
            "`without` must name cameras of a calibration",
            f"{', '.join(self.without)} and no calibration",
            "name the sources that are used (--camera)",
        )
        check_ranges(self, "fit_live()")
