"""How much of a frame is kept in the stream."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

__all__ = ["CodecConfig"]


@dataclass(frozen=True)
class CodecConfig:
    """Settings of the stream; a decoder needs none of them.

    A step is twice an error that is tolerated, so that rounding stays within. In a later frame a group of numbers that
    all change by less than a step is left as it is, for that is mostly the fit's jitter, but for colours: such a group
    may be off by the step.

    Raises:
        ValueError: a number is out of range.
    """

    quality: float = 1.0
    """Divides the tolerated errors below: 2 doubles the precision of everything, 1000 is as good as float32."""
    birth_precision: float = 4.0
    """How much more precise Gaussians are when they appear: that is written once and seen for many frames."""
    error_px: float = 0.04
    """What centres, sizes and rotations may be off on screen, in px, in the camera that sees them largest: a step is
    about a tenth of a pixel."""
    error_color: float = 1 / 255
    """What a colour may be off, from 0 to 1; in the SH of degree 1 and up for each coefficient."""
    error_opacity: float = 0.005
    """What an opacity may be off where it is most sensitive, at 0.5."""
    error_confidence: float = 0.05
    """What a confidence may be off where it is most sensitive, at 0.5: it gates the fit, so all else shows its loss."""
    offset: bool = False
    """Also write the learned offset of what moves, for viewing: nothing is decoded from it but itself."""
    target_size: int = 0
    """Bytes that a later frame may take: it is coded more coarsely until it fits. 0: as many as the quality takes."""
    keyframe_interval: int = 30
    """Every how many frames the whole state is written once more, so that a reader can start there; 0: never."""

    def __post_init__(self) -> None:
        for name in ("quality", "birth_precision", "error_px", "error_color", "error_opacity", "error_confidence"):
            if not 0 < getattr(self, name) < inf:
                raise ValueError(f"CodecConfig(): `{name}` must be positive and finite, got {getattr(self, name)}.")
        if not 1 <= self.birth_precision <= 1024:
            raise ValueError(f"CodecConfig(): `birth_precision` must be 1 to 1024, got {self.birth_precision}.")
        for name in ("target_size", "keyframe_interval"):
            if getattr(self, name) < 0:
                raise ValueError(f"CodecConfig(): `{name}` must not be negative, got {getattr(self, name)}.")
