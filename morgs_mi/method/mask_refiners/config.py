"""Settings of motion masks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

__all__ = ["MaskConfig", "PromptConfig"]


@dataclass(frozen=True)
class PromptConfig:
    """Settings of SAM2's prompts.

    Raises:
        ValueError: a number is out of range.
    """

    objects: int = 16
    """Largest connected components of the flow mask that become prompts. Each costs a run of the decoder; the smaller
    ones stay as they are in the flow mask."""
    points: int = 3
    """Most points per prompt."""
    spacing: float = 0.25
    """Least distance between a prompt's points, in longer sides of its box."""

    def __post_init__(self) -> None:
        _check("PromptConfig()", self, {"objects": 1, "points": 1, "spacing": 0})


@dataclass(frozen=True)
class MaskConfig:
    """Settings of the flow mask (eq. 9) and of its refinement (eq. 10).

    Raises:
        ValueError: a number is out of range.
    """

    threshold_mads: float = 4.0
    """Speed above which a pixel moves: this many median absolute deviations above the median."""
    floor: float = 0.5
    """Least threshold in pixels at `floor_width`; it is proportional to the width, as the motion of a scene is."""
    floor_width: int = 1352
    """Width in pixels that `floor` refers to: N3DV's half resolution."""
    noise_floor: float = 0.2
    """Least threshold in pixels at any width: the noise of the flow itself."""
    working_width: int = 320
    """Width in pixels to which GrabCut and superpixels reduce an image. Their cost grows with the number of pixels, and
    a mask needs the object's outline, not its details."""
    opening: int = 1
    """Radius in pixels of the opening that removes specks."""
    closing: float = 0.005
    """Radius of the closing that fills holes, in widths of the mask; at least a pixel."""
    grabcut_iterations: int = 2
    """Iterations of GrabCut."""
    grabcut_reach: float = 0.05
    """Distance from the flow mask within which GrabCut may add pixels, in longer sides of the image."""
    grabcut_coverage: float = 0.9
    """Share of the image above which GrabCut is skipped: what is left has too few colours to learn from."""
    superpixel_side: int = 8
    """Side of a superpixel in pixels of the reduced image."""
    superpixel_share: float = 0.75
    """Share of a superpixel that must lie in the flow mask. Flow bleeds outwards onto the static surroundings of an
    object, all of which a bare majority would include."""
    superpixel_iterations: int = 5
    """Iterations of SLIC."""
    superpixel_compactness: float = 10.0
    """SLIC's weight of distance against colour."""
    prompts: PromptConfig = field(default_factory=PromptConfig)
    """Prompts of SAM2."""

    def __post_init__(self) -> None:
        numbers = [each.name for each in fields(self) if each.name != "prompts"]
        least = {"floor_width": 1, "working_width": 1, "grabcut_iterations": 1, "superpixel_side": 1}
        _check("MaskConfig()", self, dict.fromkeys(numbers, 0) | least)


def _check(place: str, config: MaskConfig | PromptConfig, least: Mapping[str, float]) -> None:
    for name, bound in least.items():
        if not getattr(config, name) >= bound:
            raise ValueError(f"{place}: `{name}` must be at least {bound}, got {getattr(config, name)}.")
