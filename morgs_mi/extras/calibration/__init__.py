"""Cameras from images: calibration, checks of poses and clocks, refinement in a fit."""

from morgs_mi.core.extras import enter


def register() -> None:
    """Enter what this extra adds to the package."""
    enter(__name__, "commands", {"info": "command:Info", "calibrate": "command:Calibrate"})
    enter(__name__, "image checks", {"poses": "checks.rig_check:pose_problems"})
    enter(__name__, "camera refinement", {"first frame": "refine:refine_cameras"})
