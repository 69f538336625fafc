"""Settings of the stream's encoder."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

__all__ = ["CodecConfig"]


@dataclass(frozen=True)
class CodecConfig:
    """Settings of the encoder; a decoder needs none of them.

    A step is twice the tolerated error, so that rounding stays within it. In a later frame, a group of numbers in which
    no change reaches a step stays unchanged, as such changes are mostly jitter of the fit. The threshold of the base
    colour is half a step.

    Raises:
        ValueError: a number is out of range.
    """

    quality: float = 1.0
    """Divisor of the tolerated errors below: 2 doubles the precision of everything, 1000 is as good as float32."""
    birth_precision: float = 4.0
    """Factor of the precision of new Gaussians: they are written once and seen for many frames."""
    error_px: float = 0.04
    """Tolerated error of means, scales and rotations on screen, in px, in the camera that magnifies them most: a step
    is about a tenth of a pixel."""
    error_color: float = 1 / 255
    """Tolerated error of a colour, from 0 to 1; of each coefficient for the SH of degree 1 and up."""
    error_opacity: float = 0.005
    """Tolerated error of an opacity where the sigmoid is steepest, at 0.5."""
    error_confidence: float = 0.05
    """Tolerated error of a confidence where the sigmoid is steepest, at 0.5: it gates the fit, so its error affects all
    other attributes."""
    offset: bool = False
    """Storage of the learned offset of moving Gaussians, for viewing; no other value is decoded from it."""
    target_size: int = 0
    """Bound of the bytes of a later frame, which is coded more coarsely until it fits; 0: no bound."""
    keyframe_interval: int = 30
    """Frames between re-emitted keyframes, which contain the whole state and at which a reader can start; 0: never."""

    def __post_init__(self) -> None:
        for name in ("quality", "birth_precision", "error_px", "error_color", "error_opacity", "error_confidence"):
            if not 0 < getattr(self, name) < inf:
                raise ValueError(f"CodecConfig(): `{name}` must be positive and finite, got {getattr(self, name)}.")
        if not 1 <= self.birth_precision <= 1024:
            raise ValueError(f"CodecConfig(): `birth_precision` must be 1 to 1024, got {self.birth_precision}.")
        for name in ("target_size", "keyframe_interval"):
            if getattr(self, name) < 0:
                raise ValueError(f"CodecConfig(): `{name}` must not be negative, got {getattr(self, name)}.")
