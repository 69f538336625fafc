"""Synthetic captures: scenes that Mitsuba path-traces, with exact ground truth."""

from morgs_mi.core.extras import enter


def register() -> None:
    """Enter what this extra adds to the package."""
    enter(__name__, "commands", {"synth": "command:Synth"})
