"""Fits of what cameras record at this moment."""

from morgs_mi.platform.extras import enter


def register() -> None:
    """Enter what this extra adds to the package."""
    enter(__name__, "commands", {"live": "command:Live"})
