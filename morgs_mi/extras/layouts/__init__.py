"""Further layouts of captures."""

from morgs_mi.platform.extras import enter


def register() -> None:
    """Enter what this extra adds to the package."""
    enter(
        __name__,
        "layouts",
        {
            "dynamic3dgs": "dynamic3dgs:READER",
            "qualisys": "qualisys:READER",
            "anipose": "anipose:READER",
            "easymocap": "easymocap:READER",
        },
    )
