"""The demonstration: a synthetic clip, its reconstruction and a report."""

from morgs_mi.core.extras import enter


def register() -> None:
    """Enter what this extra adds to the package."""
    enter(__name__, "commands", {"demo": "command:Demo"})
