"""The renderer's channels.

`color`, `depth`, `motion` and `guided_motion` have a rule of their own. Every attribute with a
`channel` in the table of attributes is a further channel, blended like a colour. `alpha` is blended
with every call that needs it. A shape of a Mitsuba scene has the attributes that the channels
require.
"""

from __future__ import annotations

from morgs_mi.core.attributes import BY_ACTIVATED_NAME, Attribute

_OWN_RULE = {"color": 3, "depth": 1, "motion": 2, "guided_motion": 2}

NORMALISED = ("depth", "motion", "guided_motion")
"""Channels that are divided by alpha: expected values, not sums."""


def attribute_channels() -> dict[str, Attribute]:
    """Return the attributes that are blended like a colour, by the names of their channels."""
    return {
        attribute.channel: attribute
        for attribute in BY_ACTIVATED_NAME.values()
        if attribute.channel
    }


def channel_sizes() -> dict[str, int]:
    """Return the number of floats that each channel blends, by name, without `alpha` and
    `features`.
    """
    return {
        **_OWN_RULE,
        **{name: attribute.width for name, attribute in attribute_channels().items()},
    }


def exr_names(channel: str, size: int) -> list[str]:
    """Return the EXR names of a channel's floats: NAME.Y for one, NAME.X, NAME.Y ... for 2 to 4."""
    if size == 1:
        return [f"{channel}.Y"]
    suffixes = "XYZW"[:size] if size <= 4 else range(size)
    return [f"{channel}.{suffix}" for suffix in suffixes]


def aov_attributes() -> dict[str, str | None]:
    """Return the shape attribute that each AOV requires, by the name of the AOV; None: no
    attribute.
    """
    names = {
        channel: attribute.activated_name for channel, attribute in attribute_channels().items()
    }
    return {"motion": "motion", **names, "depth": None}
