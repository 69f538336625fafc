"""Learned gates and quantised residuals, after QUEEN (Girish et al., NeurIPS 2024).

The residual of each mean passes a hard gate, which can be exactly 0 or 1 (Louizos et al. 2018, *Learning sparse neural
networks through L0 regularization*, without their noise),

    z = min(1, max(0, (zeta - gamma) sigmoid(a) + gamma)),    gamma = -0.1,  zeta = 1.1,

whose penalty is the probability that the gate with noise of temperature beta = 2/3 is open, sigmoid(a - beta log(-gamma
/ zeta)): where the images do not need a displacement, it closes. The residuals of all other attributes are multiples of
a step. Rounding has no useful derivative; the gradient passes it unchanged.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import log

import drjit as dr
import mitsuba as mi

from morgs_mi.core.attributes import sigmoid
from morgs_mi.core.checks import check_number
from morgs_mi.core.types import Float, Tensor

__all__ = ["GateConfig", "gate_loss", "hard_gate", "quantised"]

_LOW, _HIGH, _TEMPERATURE = -0.1, 1.1, 2 / 3


@dataclass(frozen=True)
class GateConfig:
    """Settings of the gates and of the steps of residuals; a step of 0 rounds nothing."""

    start: float = 2.0
    """Logit of the gates at the start of a frame; 2: open to 0.96."""
    rate: float = 0.1
    """Learning rate of the logits."""
    scale_step: float = 0.02
    """Step of the residuals of the logarithms of the scales."""
    rotation_step: float = 0.02
    """Step of those of the quaternions."""
    opacity_step: float = 0.1
    """Step of those of the logits of the opacities."""
    color_step: float = 0.02
    """Step of those of the SH coefficients."""

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            check_number("GateConfig()", name, value, "(-inf, inf)" if name == "start" else "[0, inf)")

    def step(self, name: str) -> float:
        """Return the step of a parameter of the residual; 0 for those that are not rounded."""
        steps = {"log_scales": self.scale_step, "quats": self.rotation_step, "logit_opacities": self.opacity_step}
        return {**steps, "sh_dc": self.color_step, "sh_rest": self.color_step}.get(name, 0.0)


def hard_gate(logit: Float) -> Float:
    """Return the gates z of their logits a."""
    return dr.clip((_HIGH - _LOW) * sigmoid(logit) + _LOW, 0, 1)


def gate_loss(logit: Tensor, num_gaussians: int) -> Float:
    """Return the expected share of open gates.

    Args:
        logit: a [M] of the active Gaussians.
        num_gaussians: of the whole scene.
    """
    is_open = sigmoid(logit.array - _TEMPERATURE * log(-_LOW / _HIGH))
    return dr.sum(is_open) * dr.opaque(mi.Float, 1 / num_gaussians)


def quantised(values: Tensor, step: float) -> Tensor:
    """Return values rounded to multiples of a step, with the gradient of what is not rounded."""
    if not step:
        return values
    fixed = dr.detach(values)
    return values + (dr.round(fixed / step) * step - fixed)
