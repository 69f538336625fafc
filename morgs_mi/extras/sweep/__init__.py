"""Error of a fit against its run time, and what a scene does not need."""

from morgs_mi.platform.extras import enter


def register() -> None:
    """Enter what this extra adds to the package."""
    enter(__name__, "commands", {"sweep": "command:Sweep"})
