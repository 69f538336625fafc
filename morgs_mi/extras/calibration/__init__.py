"""Cameras from images: calibration, checks of poses and clocks, refinement in a fit."""

from morgs_mi.platform.extras import enter


def register() -> None:
    """Enter what this extra adds to the package."""
    enter(__name__, "commands", {"info": "command:Info", "calibrate": "command:Calibrate"})
    functions = {
        "problems": "checks.rig_check:pose_problems",
        "refine": "refine:refine_cameras",
        "calibrate": "calibrate:calibrate",
    }
    enter(__name__, "cameras", functions)
