"""The renderer's channels.

`color`, `depth`, `motion` and `guided_motion` have a rule of their own. Every attribute with a
`channel` in the table of attributes is a further channel, blended like a colour. `alpha` is blended
with every call that needs it. A shape of a Mitsuba scene has the attributes that the channels
require.
"""

from __future__ import annotations

from morgs_mi.core.attributes import BY_ACTIVATED_NAME, Attribute

_MOTION = BY_ACTIVATED_NAME["motion"]
# Number of floats, and the attribute that some Gaussians lack.
_OWN_RULE: dict[str, tuple[int, Attribute | None]] = {
    "color": (3, None),
    "depth": (1, None),
    "motion": (2, _MOTION),
    "guided_motion": (2, _MOTION),
}

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
    attributes = {name: attribute.width for name, attribute in attribute_channels().items()}
    return {**{name: size for name, (size, _) in _OWN_RULE.items()}, **attributes}


def required_attributes() -> dict[str, Attribute | None]:
    """Return the attribute that some Gaussians lack and a channel requires, by the names of all
    channels of `channel_sizes`; None: no such attribute.
    """
    own = {name: attribute for name, (_, attribute) in _OWN_RULE.items()}
    return {**own, **attribute_channels()}


def aov_names() -> list[str]:
    """Return the channels that a scene can have as AOVs; a shape has no learned offset."""
    return [name for name in required_attributes() if name not in ("color", "guided_motion")]


def exr_names(channel: str, size: int) -> list[str]:
    """Return the EXR names of a channel's floats: NAME.Y for one, NAME.X, NAME.Y ... for 2 to 4."""
    if size == 1:
        return [f"{channel}.Y"]
    suffixes = "XYZW"[:size] if size <= 4 else range(size)
    return [f"{channel}.{suffix}" for suffix in suffixes]
