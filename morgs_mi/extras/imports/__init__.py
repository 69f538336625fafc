"""Streams from the files of other tools."""

from morgs_mi.platform.extras import enter


def register() -> None:
    """Enter what this extra adds to the package."""
    enter(__name__, "commands", {"import": "command:Import"})
