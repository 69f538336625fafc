"""The table of per-Gaussian attributes, from which all code that depends on an attribute derives.

`Gaussians` (shapes, activations), learning rates, the residual (gates), the first frame, the stream
(groups of integers) and the renderer (channels) read it. A new attribute is a row here and a field
of `Gaussians` of that name.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import drjit as dr
import numpy as np

from morgs_mi.core.types import Jit

# px, in the camera that magnifies a Gaussian most: a step of the stream, twice the error, is about
# a tenth of a pixel.
_ERROR_PX = 0.04
# Of 1: the error of an image of 8 bits.
_ERROR_COLOR = 1 / 255


def sigmoid(x: Jit) -> Jit:
    """Return 1 / (1 + exp(-x)); finite with a finite gradient for every finite x."""
    return 0.5 + 0.5 * dr.tanh(0.5 * x)


@dataclass(frozen=True)
class Activation:
    """Function from an optimised value to the value that is rendered."""

    function: Callable[[Jit], Jit]  #: Of a Dr.Jit array or tensor.
    #: Of a NumPy array of activated values, float64; finite also where the exact one is infinite.
    inverse: Callable[[np.ndarray], np.ndarray]
    #: Bound of its derivative, which converts a tolerated error of the activated value into one of
    #: the optimised value; None where there is no bound.
    largest_slope: float | None


def _log(x: np.ndarray) -> np.ndarray:
    return np.log(np.maximum(np.asarray(x, np.float64), 1e-30))


def _logit(x: np.ndarray) -> np.ndarray:
    x = np.clip(np.asarray(x, np.float64), 1e-6, 1 - 1e-6)
    return np.log(x / (1 - x))


IDENTITY = Activation(lambda x: x, lambda x: x, 1.0)
EXP = Activation(dr.exp, _log, None)
SIGMOID = Activation(sigmoid, _logit, 0.25)


@dataclass(frozen=True)
class Attribute:
    """One row of the table."""

    #: Of the optimised tensor in `Gaussians`; the two rows of the spherical harmonics share
    #: `sh_coeffs`.
    name: str
    #: Of one Gaussian's value; -1 where it depends on the degree of the spherical harmonics.
    shape: tuple[int, ...]
    activated_name: str  #: Of the rendered value.
    activation: Activation = IDENTITY  #: Between the two.
    #: Field of `LearningRates`, or a learning rate; None where it is not optimised.
    rate: str | float | None = None
    rate_in_extents: bool = False  #: Whether that rate counts in scene extents.
    #: Of its residual with two gates: the confidence for ``motion``, none for ``appearance``; None
    #: where it has no residual (eq. 12).
    gate: Literal["motion", "appearance"] | None = None
    first_frame: bool = False  #: Whether the first frame fits it.
    #: Of the activated value that the stream tolerates with `quality` 1; on screen in px for means,
    #: scales and rotations. None where the stream does not store it.
    error: float | None = None
    #: Of the renderer that blends it like a colour; None where there is none, or where the channel
    #: is not plain blending (`color`, `motion`).
    channel: str | None = None
    #: Value of the optimised tensor before the first frame; None where `fit.initialise` computes
    #: it, or where the attribute is absent then.
    initial: float | None = None

    @property
    def width(self) -> int:
        """The numbers of one Gaussian's value; -1 where that depends on the degree of the spherical
        harmonics.
        """
        return -1 if -1 in self.shape else math.prod(self.shape)


# The stream's columns have the same order.
ATTRIBUTES: tuple[Attribute, ...] = (
    # The residual of the means is motion + offset, below.
    Attribute(
        "means",
        (3,),
        "means",
        rate="means",
        rate_in_extents=True,
        first_frame=True,
        error=_ERROR_PX,
    ),
    Attribute(
        "log_scales",
        (3,),
        "scales",
        EXP,
        rate="scales",
        gate="appearance",
        first_frame=True,
        error=_ERROR_PX,
    ),
    Attribute(
        "quats",
        (4,),
        "quats",
        rate="quats",
        gate="motion",
        first_frame=True,
        error=_ERROR_PX,
    ),
    Attribute(
        "logit_opacities",
        (),
        "opacities",
        SIGMOID,
        rate="opacities",
        gate="appearance",
        first_frame=True,
        error=0.005,
    ),
    Attribute(
        "sh_dc",
        (1, 3),
        "sh_coeffs",
        rate="sh_dc",
        gate="appearance",
        first_frame=True,
        error=_ERROR_COLOR,
    ),
    Attribute(
        "sh_rest",
        (-1, 3),
        "sh_coeffs",
        rate="sh_rest",
        gate="appearance",
        first_frame=True,
        error=_ERROR_COLOR,
    ),
    Attribute(
        "logit_confidence",
        (),
        "confidence",
        SIGMOID,
        rate="confidence",
        error=0.05,  # it gates the fit, where its error affects all other attributes
        channel="confidence",
        initial=0.0,
    ),
    Attribute("motion", (3,), "motion", rate="means", rate_in_extents=True, gate="motion"),
    Attribute("offset", (3,), "offset", rate="means", rate_in_extents=True, gate="motion"),
)

BY_NAME = {attribute.name: attribute for attribute in ATTRIBUTES}
BY_ACTIVATED_NAME = {a.activated_name: a for a in ATTRIBUTES if a.activated_name != "sh_coeffs"}


def shape_attribute_widths() -> dict[str, tuple[int, ...]]:
    """Return the admissible numbers of floats per Gaussian of every attribute of a Mitsuba shape
    beside its `data`, by name.
    """
    channels = {name: (row.width,) for name, row in BY_ACTIVATED_NAME.items() if row.channel}
    return {"opacities": (1,), "sh_coeffs": (3, 12, 27, 48), "motion": (3,), **channels}
