"""The part of a splat in front of a depth limit, and its derivatives by hand.

Along the ray of a pixel, a Gaussian is also a Gaussian in depth, with mean z + gx dx + gy dy and
standard deviation sigma (see `projection`). Up to the limit the ray has passed the fraction Phi of
its optical depth -log(1 - alpha), and

    q = (limit - depth) / sigma        alpha' = 1 - (1 - alpha)^Phi(q)

takes the place of alpha: the transmittance of the 1D integral. Phi is the distribution function of
the normal distribution, approximated to 2e-4 by 1 / (1 + exp(-2 y)) with y = sqrt(2 / pi) q (1 +
0.044715 q^2) (Page 1977).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log, log2, pi, sqrt

import drjit as dr
import mitsuba as mi

from morgs_mi.core.types import Float
from morgs_mi.render.backend import exp2

PROFILE = 4  # z, gx, gy, 1 / sigma

_LN2 = log(2.0)
_SLOPE = 2 * sqrt(2 / pi) * log2(2.718281828459045)
_CUBIC = 0.044715
FARTHEST_CUT = 6.0
"""Standard deviations between depth and limit beyond which Phi counts as 0 or 1."""


@dataclass(frozen=True)
class CutAlpha:
    """Alpha' of one pixel, d alpha' / d alpha, d alpha' / dq, and limit - depth."""

    alpha: Float
    by_alpha: Float
    by_q: Float
    behind: Float


class Cut:
    """The profile of the lanes' Gaussians at the pixels of their blocks.

    Args:
        profile: (z, gx, gy, 1 / sigma).
        dx: offsets of the block's columns from the mean, px.
        dy: offsets of its rows.
        limits: depth limit of every pixel, row by row.
    """

    def __init__(
        self, profile: list[Float], dx: list[Float], dy: list[Float], limits: list[Float]
    ) -> None:
        z, gx, gy, self.r_sigma = profile
        self.gx = gx
        self.gy = gy
        self.dx = dx
        self.dy = dy
        self.limits = limits
        self.columns = [dr.fma(gx, x, z) for x in dx]
        self.rows = [gy * y for y in dy]
        self.sums = [mi.Float(0) for _ in range(4)]  # of dL/dq times 1, column, row, limit - depth

    def alpha(self, k: int, alpha: Float) -> CutAlpha:
        """Return alpha' of pixel k (row by row) for its alpha < 1."""
        j, i = divmod(k, len(self.dx))
        behind = self.limits[k] - (self.columns[i] + self.rows[j])
        q = behind * self.r_sigma
        near = dr.abs(q) < FARTHEST_CUT
        q = dr.select(near, q, dr.copysign(mi.Float(FARTHEST_CUT), q))
        qq = q * q
        fraction = dr.rcp(1 + exp2(-_SLOPE * q * dr.fma(_CUBIC, qq, 1)))
        log_transmittance = dr.log2(1 - alpha)
        transmittance = exp2(fraction * log_transmittance)
        slope = fraction * (1 - fraction) * (_SLOPE * _LN2) * dr.fma(3 * _CUBIC, qq, 1)
        return CutAlpha(
            # All or nothing without rounding where the limit is far away; a Gaussian that is not
            # drawn stays so.
            dr.select(near & (alpha > 0), 1 - transmittance, dr.select(behind > 0, alpha, 0)),
            fraction * transmittance * dr.rcp(1 - alpha),
            dr.select(near, -_LN2 * transmittance * log_transmittance * slope, 0),
            behind,
        )

    def add(self, k: int, cut: CutAlpha, d_alpha: Float) -> None:
        """Add pixel k with dL / d alpha' to the sums of the adjoint."""
        j, i = divmod(k, len(self.dx))
        d = d_alpha * cut.by_q
        one, column, row, behind = self.sums
        self.sums = [
            one + d,
            dr.fma(d, float(i), column),
            dr.fma(d, float(j), row),
            dr.fma(d, cut.behind, behind),
        ]

    def gradients(self) -> tuple[list[Float], list[Float]]:
        """Return the gradients of (mean_x, mean_y) and of the profile."""
        one, column, row, behind = self.sums
        dz = -self.r_sigma * one
        slopes = [
            -self.r_sigma * dr.fma(one, first, total)
            for first, total in ((self.dx[0], column), (self.dy[0], row))
        ]
        return [-self.gx * dz, -self.gy * dz], [dz, *slopes, behind]
