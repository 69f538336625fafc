"""Fits in many processes, on one machine or on a Dask cluster: chunks of a recording."""

from morgs_mi.platform.extras import enter


def register() -> None:
    """Enter what this extra adds to the package."""
    enter(__name__, "commands", {"fit": "command:FitInChunks"})
