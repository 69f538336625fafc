"""Gaussians along arbitrary rays: colour and transmittance of segments that no rasteriser can draw.

In the coordinates x' = diag(1 / s) R' (x - mean) of a Gaussian, a ray o + t d passes the centre at
the distance p = |o' x d'| / |d'|, nearest at t* = -o'.d' / |d'|^2. The response is largest there,

    alpha = opacity exp(-p^2 / 2),

and along the ray it is a Gaussian with mean t* and standard deviation 1 / |d'|. A segment [0, end]
has the fraction f = Phi(|d'| (end - t*)) - Phi(-|d'| t*) of the optical depth, and 1 - (1 -
alpha)^f takes the place of alpha. It is the response of the rasteriser without the affine
approximation and the low-pass filter. Colours are blended in the order of t*.

The Gaussians are the leaves of a complete binary tree of boxes: node n has the children 2 n and 2 n
+ 1. All nodes of a level are split along the same axis: the order in which a ray meets the children
depends only on the signs of its direction. Flipping bits of n by those signs gives an order from
front to back, in which the next node follows from n without a stack.
"""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from morgs_mi.core.arrays import from_numpy
from morgs_mi.core.gaussians import ActivatedGaussians, require_some
from morgs_mi.core.types import Bool, Color3f, Float, Jit, UInt32
from morgs_mi.platform.config import config_or_default
from morgs_mi.render.projection import FARTHEST
from morgs_mi.render.render_config import RenderConfig

# Gaussians that one walk through the tree sorts.
_SORTED = 16
# Smallest aspect of a Gaussian: float32 has no digits for thinner ones.
_THINNEST = 1e-4


class _Tree:
    """Boxes of a complete binary tree with 2^depth leaves.

    Args:
        centers: centres of N boxes [N, 3].
        halves: half their sizes [N, 3].

    Attributes:
        order: the box of each leaf [2^depth]; N where there is none.
    """

    def __init__(self, centers: np.ndarray, halves: np.ndarray) -> None:
        depth = max(len(centers) - 1, 0).bit_length()
        order, flips = _leaf_order(centers, depth)
        self.order = order
        # Rounding must not make a box smaller.
        halves = halves * (1 + 1e-5) + 1e-6 * np.abs(centers)
        low = _node_corners(np.concatenate([centers - halves, [[np.inf] * 3]])[order], np.min)
        high = _node_corners(np.concatenate([centers + halves, [[-np.inf] * 3]])[order], np.max)
        rows = np.zeros((len(low), 8))
        # An empty box is a point at infinity, which no ray reaches.
        rows[:, :3] = low
        rows[:, 4:7] = np.where(low > high, np.inf, high)
        # No literals, with which every scene would compile its own kernel.
        self.depth = dr.opaque(mi.UInt32, depth)
        # For each axis, the bits of a leaf's number that choose a side along it.
        self.flips = dr.opaque(mi.Vector3u, flips)
        # Lower and upper corner of every node, from 1.
        self.boxes = from_numpy(mi.Float, rows)

    @dr.syntax
    def walk(
        self,
        ray: Any,
        active: Bool,
        state: Jit,
        visit: Callable[[Jit, UInt32], Jit],
        span: Callable[[Jit], tuple[Float, Float]],
    ) -> Jit:
        """Visit the leaves with boxes that meet a part of each ray, roughly front to back, and
        return the last state.

        Args:
            ray: rays [M].
            active: rays that are traced.
            state: values [M].
            visit: (state, leaf) -> state, called for the leaves.
            span: state -> (start, end) of the part of the ray that is searched.
        """
        inverse = dr.rcp(ray.d)
        flip = dr.sum(dr.select(ray.d < 0, self.flips, 0))
        node = dr.select(active, mi.UInt32(1), 0)
        level = mi.UInt32(0)
        while dr.hint(node != 0, label="tree"):
            actual = node ^ (flip >> (self.depth - level))
            # A ray in the plane of a face gives NaN, which minimum and maximum ignore.
            low = (_packet(self.boxes, 2 * actual).xyz - ray.o) * inverse
            high = (_packet(self.boxes, 2 * actual + 1).xyz - ray.o) * inverse
            start, end = span(state)
            enter = dr.maximum(dr.max(dr.minimum(low, high)), start)
            leave = dr.minimum(dr.min(dr.maximum(low, high)), end)
            hit = enter <= leave
            leaf = hit & (level == self.depth)
            if dr.hint(leaf, label="leaf"):
                state = visit(state, actual - (mi.UInt32(1) << self.depth))
            down = hit & ~leaf
            up = dr.tzcnt(node + 1)
            node = dr.select(down, 2 * node, (node + 1) >> up)
            node = dr.select(node == 1, 0, node)
            level = dr.select(down, level + 1, level - up)
        return state


def _leaf_order(centers: np.ndarray, depth: int) -> tuple[np.ndarray, list[int]]:
    """Return the box of each leaf [2^depth], N where there is none, and for each axis the bits of a
    leaf's number that choose a side along it.
    """
    N = len(centers)
    order = np.arange(1 << depth)
    flips = [0, 0, 0]
    # Leaves without a box are at the end of every axis.
    places = np.concatenate([centers, np.full((len(order) - N, 3), np.inf)])
    for level in range(depth):
        order = order.reshape(1 << level, -1)
        groups = places[order]
        finite = np.isfinite(groups)  # those with a box
        extent = np.where(finite, groups, -np.inf).max(1) - np.where(finite, groups, np.inf).min(1)
        axis = int(np.where(finite.any(1), extent, 0).mean(0).argmax())  # the longest on average
        flips[axis] |= 1 << (depth - 1 - level)
        partition = places[order, axis].argpartition(order.shape[1] // 2 - 1, axis=1)
        order = np.take_along_axis(order, partition, axis=1)
    return np.minimum(order.ravel(), N), flips


def _node_corners(leaves: np.ndarray, extreme: Callable[..., np.ndarray]) -> np.ndarray:
    """Return a corner of the box of every node [nodes, 3] from the root down, given the corners of
    the leaves [leaves, 3]; node 0 does not exist.
    """
    levels = [leaves]
    while len(levels[-1]) > 1:
        levels.append(extreme(levels[-1].reshape(-1, 2, 3), axis=1))
    return np.concatenate([levels[-1], *levels[::-1]])


class SplatRays:
    """N Gaussians, prepared for rays; detached from the gradient graph.

    Args:
        gaussians: N Gaussians, at least one.
        config: cut-offs; the low-pass filter has no meaning here.

    Example:
        >>> rays = morgs_mi.SplatRays(gaussians)
        >>> color, transmittance = rays.trace(mi.Ray3f((0, 0, -3), (0, 0, 1)))

    Raises:
        ValueError: `gaussians` is empty, or has numbers that are not finite.
    """

    def __init__(self, gaussians: ActivatedGaussians, config: RenderConfig | None = None) -> None:
        require_some("SplatRays()", gaussians, "pass some")
        self._config = config_or_default("SplatRays()", config, RenderConfig())
        means = _finite(gaussians, "means")
        scales = _finite(gaussians, "scales")
        quats = _finite(gaussians, "quats")
        opacities = _finite(gaussians, "opacities")
        coeffs = _finite(gaussians, "sh_coeffs")
        scales = np.maximum(scales, np.maximum(_THINNEST * scales.max(1, keepdims=True), 1e-30))
        # A quaternion of length 0 is the identity.
        quats = np.where(np.linalg.norm(quats, axis=1, keepdims=True) > 0, quats, [1, 0, 0, 0])
        axes = Rotation.from_quat(quats, scalar_first=True).as_matrix()
        # Distances from the centre, in standard deviations, at which alpha is too small.
        opacities = opacities.ravel()
        reach = np.sqrt(2 * np.log(np.maximum(opacities / self._config.alpha_min, 1)))
        indices = np.flatnonzero(reach > 0)
        halves = reach[:, None] * np.linalg.norm(axes * scales[:, None], axis=2)
        self._tree = _Tree(means[indices], halves[indices])
        order = self._tree.order
        index = np.concatenate([indices, [0]])[order]
        # Rows of four floats, which are read as one packet.
        rows = np.zeros((len(index), 4, 4))
        rows[:, :3, :3] = (axes / scales[:, None]).transpose(0, 2, 1)[index]
        rows[:, :3, 3] = means[index]
        rows[:, 3, 0] = np.where(order < len(indices), opacities[index], 0)
        colors = np.zeros((*coeffs.shape[:2], 4))
        colors[..., :3] = coeffs
        self._rows = from_numpy(mi.Float, rows)
        self._coeffs = from_numpy(mi.Float, colors[index])
        self._degree = round(sqrt(coeffs.shape[1])) - 1

    def transmittance(self, ray: mi.Ray3f, active: Bool = True) -> Float:
        """Return the fraction of light that passes the Gaussians along rays [M].

        Args:
            ray: `mi.Ray3f` with directions of length 1; segments end at `maxt`.
            active: rays that are traced; the others get 1.
        """

        def visit(state: Jit, leaf: UInt32) -> Jit:
            return (state[0] * (1 - self._response(ray, leaf)[1]),)

        def span(state: Jit) -> tuple[Float, Float]:
            return mi.Float(0), dr.select(state[0] < self._config.stop_transmittance, -1, ray.maxt)

        with dr.suspend_grad():
            ray = mi.Ray3f(dr.detach(ray))
            return self._tree.walk(ray, mi.Bool(active), (mi.Float(1),), visit, span)[0]

    @dr.syntax
    def trace(self, ray: mi.Ray3f, active: Bool = True) -> tuple[Color3f, Float]:
        """Return the colour, weighted as in `rasterize`, and the transmittance of the Gaussians
        along rays [M].

        View-dependent colours are evaluated in the ray's direction.

        Args:
            ray: `mi.Ray3f` with directions of length 1; segments end at `maxt`.
            active: rays that are traced; the others get 0 and 1.
        """
        with dr.suspend_grad():
            ray = mi.Ray3f(dr.detach(ray))
            basis = dr.sh_eval(ray.d, self._degree)
            color = mi.Color3f(0)
            transmittance = mi.Float(1)
            last = (mi.Float(-dr.inf), mi.UInt32(0))
            active = mi.Bool(active)
            while dr.hint(active, label="trace"):
                depths, rows, count = self._nearest(ray, active, last)
                while dr.hint((depths[0] < dr.inf) & self._open(transmittance), label="blend"):
                    last = (depths[0], rows[0])
                    alpha = self._response(ray, rows[0])[1]
                    color += transmittance * alpha * self._color(basis, rows[0])
                    transmittance *= 1 - alpha
                    depths = [*depths[1:], mi.Float(dr.inf)]
                    rows = [*rows[1:], mi.UInt32(0)]
                # Where fewer were found than can be sorted, none is left.
                active &= self._open(transmittance) & (count >= _SORTED)
            return color, transmittance

    def _open(self, transmittance: Float) -> Bool:
        return transmittance >= self._config.stop_transmittance

    def _nearest(
        self, ray: mi.Ray3f, active: Bool, last: tuple[Float, UInt32]
    ) -> tuple[list[Float], list[UInt32], UInt32]:
        """Return depths and rows of the next Gaussians after `last`, ordered by both, and how many
        were found.
        """

        def visit(state: Jit, row: UInt32) -> Jit:
            depths, rows, count = state
            depths = list(depths)
            rows = list(rows)
            depth, alpha = self._response(ray, row)
            hit = (alpha > 0) & _before(*last, depth, row)
            depth = dr.select(hit, depth, dr.inf)
            for j in range(_SORTED):
                is_nearer = _before(depth, row, depths[j], rows[j])
                nearer_depth = dr.select(is_nearer, depth, depths[j])
                depth = dr.select(is_nearer, depths[j], depth)
                depths[j] = nearer_depth
                nearer_row = dr.select(is_nearer, row, rows[j])
                row = dr.select(is_nearer, rows[j], row)
                rows[j] = nearer_row
            return depths, rows, count + dr.select(hit, mi.UInt32(1), 0)

        def span(state: Jit) -> tuple[Float, Float]:
            # The largest response of a Gaussian that reaches into the segment may be beyond either
            # end.
            return dr.clip(last[0], 0, ray.maxt), dr.clip(state[0][-1], 0, ray.maxt)

        start = ([mi.Float(dr.inf)] * _SORTED, [mi.UInt32(0)] * _SORTED, mi.UInt32(0))
        return self._tree.walk(ray, active, start, visit, span)

    def _response(self, ray: mi.Ray3f, row: UInt32) -> tuple[Float, Float]:
        """Return the depth of a Gaussian's largest response along rays, and its alpha on the
        segment.
        """
        x, y, z, more = (_packet(self._rows, 4 * row + k) for k in range(4))
        W = mi.Matrix3f(x.xyz, y.xyz, z.xyz)
        o = W @ mi.Vector3f(ray.o - mi.Point3f(x.w, y.w, z.w))
        d = W @ ray.d
        dd = dr.squared_norm(d)
        depth = -dr.dot(o, d) / dd
        r_sigma = dr.sqrt(dd)
        # The distance as a cross product: a difference of squares would cancel for thin Gaussians.
        alpha = more.x * dr.exp(-0.5 * dr.squared_norm(dr.cross(o, d)) / dd)
        alpha = dr.select(
            alpha >= self._config.alpha_min, dr.minimum(alpha, self._config.alpha_max), 0
        )
        segment_share = _phi(r_sigma * (dr.minimum(ray.maxt, FARTHEST) - depth)) - _phi(
            -r_sigma * depth
        )
        return depth, 1 - dr.exp2(segment_share * dr.log2(1 - alpha))

    def _color(self, basis: list[Float], row: UInt32) -> Color3f:
        """Return max(0.5 + SH, 0) of a Gaussian."""
        K = len(basis)
        total = mi.Color3f(0.5)
        for k, value in enumerate(basis):
            total += value * mi.Color3f(_packet(self._coeffs, K * row + k).xyz)
        return dr.maximum(total, 0)


def _packet(values: Float, index: UInt32) -> Any:
    """Return the four floats of a row, a `mi.Vector4f`."""
    return dr.gather(mi.Vector4f, values, index)


def _finite(gaussians: ActivatedGaussians, name: str) -> np.ndarray:
    """Return an attribute in float64, detached."""
    values = np.array(dr.detach(getattr(gaussians, name)), np.float64)
    limit = FARTHEST if name == "sh_coeffs" else np.finfo(np.float32).max
    bad = np.argwhere(~(np.abs(values) <= limit))
    if len(bad):
        expected = "finite and at most 1e18" if name == "sh_coeffs" else "finite"
        raise ValueError(
            f"SplatRays(): `{name}` must be {expected}, got {values[tuple(bad[0])]} at "
            f"{bad[0].tolist()} ({len(bad)} such values); remove these Gaussians."
        )
    return values


def _before(depth: Float, row: UInt32, other: Float, other_row: UInt32) -> Bool:
    """Return whether a Gaussian is blended before another one; equal depths are ordered by row."""
    return (depth < other) | ((depth == other) & (row < other_row))


def _phi(q: Float) -> Float:
    """Return the distribution function of the normal distribution."""
    return dr.fma(0.5, dr.erf(q * sqrt(0.5)), 0.5)
