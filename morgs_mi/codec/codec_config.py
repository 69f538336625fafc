"""Settings of the stream's encoder."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge, Le

from morgs_mi.platform.config import NonNegativeInt, Positive, config_class


@config_class
class CodecConfig:
    """Settings of the encoder; a decoder needs none of them.

    A step is twice the tolerated error: rounding stays within it. In a later frame, a group of
    numbers in which no change reaches a step stays unchanged, as such changes are mostly jitter of
    the fit. The threshold of the base colour is half a step.

    Raises:
        ValueError: a number is out of range.
    """

    quality: Positive = 1.0
    """Divisor of the tolerated errors (see `core.attributes`): 2 doubles the precision of
    everything, 1000 is as good as float32."""
    birth_precision: Annotated[float, Ge(1), Le(1024)] = 4.0
    """Factor of the precision of new Gaussians: they are written once and seen for many frames."""
    target_size: NonNegativeInt = 0
    """Bound of the bytes of a later frame, which is coded more coarsely until it fits; 0: no bound.
    """
    keyframe_interval: NonNegativeInt = 30
    """Frames between re-emitted keyframes, which contain the whole state and at which a reader can
    start; 0: never.
    """
