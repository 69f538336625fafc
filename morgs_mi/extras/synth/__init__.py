"""Synthetic captures: scenes that Mitsuba path-traces, with exact ground truth, and the
demonstration.
"""

from morgs_mi.platform.extras import enter


def register() -> None:
    """Enter what this extra adds to the package."""
    enter(__name__, "commands", {"synth": "command:Synth", "demo": "demo_command:Demo"})
