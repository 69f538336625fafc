"""Projection of Gaussians in the world to splats on the screen, differentiated by Dr.Jit.

Notation: x = R mean + t in camera space, z its depth, J the Jacobian of the projection at x, and
U = J R Q diag(s) [2, 3]. The screen covariance is U U' + eps2d I (EWA splatting, Zwicker 2001).
A pixel at offset d = (dx, dy) from the splat's centre gets alpha = 2^p with

    p = log2(opacity) - u^2 - v^2,    u = a dx + b dy,    v = c dy,

where [a b; 0 c] is the Cholesky factor of the conic times log2(e) / 2. In this form p never exceeds
log2(opacity), however thin the needle, and the only exponential in the pixel loop is 2^p.

In screen coordinates and depth, the Gaussian has the covariance [UU' + eps2d I, U w'; w U', w w']
where w is the last row of R Q diag(s). Along the ray of a pixel it is a Gaussian in depth, with
mean z + gx dx + gy dy where (gx, gy) = w U' (U U' + eps2d I)^-1, and a variance that is the same
for all pixels: the ratio of the two determinants.

No intermediate value overflows: U is computed in units of the splat's own size, and a Gaussian that
the camera cannot see is projected from a substitute position, because 0 * inf would reach a
gradient. x is summed in double precision: for scenes far from the origin, and cameras far from the
scene, single precision would lose the digits that cancel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import log2, sqrt
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import ActivatedGaussians, tensor_rows
from morgs_mi.core.memory import from_numpy
from morgs_mi.core.types import Bool, Float, Jit, Tensor, UInt32
from morgs_mi.render.channels import attribute_channels
from morgs_mi.render.render_config import RenderConfig

_HALF_LOG2E = 0.5 * log2(2.718281828459045)

# World units, or units of a channel; squares of what is farther or larger overflow.
FARTHEST = 1e18
# Opacities below are drawn as this one, below any `alpha_min`: its logarithm is finite.
_FAINTEST = 1e-9
# A float32 rotation orients a needle to 1e-7 of its length at best: aspects below this are clamped.
_THINNEST = 1e-6


@dataclass(frozen=True)
class Splats:
    """Projected Gaussians, one Dr.Jit float [N] per number."""

    #: (mean_x, mean_y, a, b, c, log2_opacity), the differentiable geometry (see module docstring).
    shape: tuple[Float, ...]
    channels: dict[str, tuple[Float, ...]]  #: Blended values, by channel name.
    depths: Float  #: Camera-space z in world units, detached.
    #: (half width, half height) in px of the region where alpha >= alpha_min, detached; 0 if
    #: culled.
    extent: tuple[Float, Float]
    valid: Bool  #: False where culled: behind the near plane, too faint, or not finite.
    #: False where an attribute, or a value computed from it, is not finite, or a blended one is
    #: above 1e18.
    finite: Bool
    #: (z, gx, gy, 1 / sigma), the Gaussian in depth along the ray of a pixel (see module
    #: docstring), world units, differentiable; empty if no depth limit cuts the splats.
    profile: tuple[Float, ...] = ()
    #: Index of the view that each splat belongs to, in a region of several views; None: there is
    #: one view.
    view: UInt32 | None = None

    def __len__(self) -> int:
        return dr.width(self.depths)

    @property
    def geometry(self) -> tuple[Float, ...]:
        """The differentiable numbers that determine a splat's alpha at a pixel: `shape` and
        `profile`.
        """
        return self.shape + self.profile

    def concatenated_with(self, other: Splats) -> Splats:
        """Return these splats, then the others, which are 0 in the channels that they lack."""
        channels = {
            name: other.channels.get(name) or tuple(dr.zeros(mi.Float, len(other)) for _ in columns)
            for name, columns in self.channels.items()
        }
        values, other_values = (
            {name: value for name, value in vars(splats).items() if value is not None}
            for splats in (self, replace(other, channels=channels))
        )
        return Splats(**concatenated(values, other_values))


@dataclass(frozen=True)
class AttachedCamera(Camera):
    """Camera with intrinsics that get gradients."""

    intrinsics: tuple[Float, ...] = ()  #: fx, fy, cx and cy in pixels, with the values of `K`.


@dataclass(frozen=True)
class Views:
    """Several cameras, and the one that each lane projects to."""

    cameras: Sequence[Camera]  #: The cameras.
    view: UInt32  #: Index of the camera of each lane.


def concatenated(a: Jit, b: Jit) -> Jit:
    """Return two arrays, or trees of arrays, end to end; `dr.concat` would compile a kernel for
    every length.
    """
    count = dr.opaque(mi.UInt32, dr.width(a))
    lane = dr.arange(mi.UInt32, dr.width(a) + dr.width(b))
    mode = dr.ReduceMode.NoConflicts
    first = lane < count
    front = dr.gather(type(a), a, lane, active=first, mode=mode)
    return dr.select(first, front, dr.gather(type(b), b, lane - count, active=~first, mode=mode))


def project(
    gaussians: ActivatedGaussians,
    camera: Camera | Views,
    channels: tuple[str, ...],
    config: RenderConfig,
    rows: UInt32 | None = None,
    features: Tensor | None = None,
) -> Splats:
    """Project Gaussians to the screen of `camera` and evaluate the requested channels.

    Args:
        gaussians: N Gaussians with activated attributes.
        camera: the view; a Dr.Jit `viewmat` receives gradients. Or several views, without
            gradients.
        channels: names of `channel_sizes()`, ``features``, or ``profile``: the splats get a
            `profile`.
        config: cut-offs.
        rows: indices of the Gaussians [M], in one view without repetition; None: all N, in order.
        features: tensor [N, F] that the channel ``features`` blends.

    Returns:
        Splats of length M, differentiable in every attribute and in the camera's pose.
    """
    if rows is None:
        rows = dr.arange(mi.UInt32, int(dr.prod(gaussians.means.shape[:1])))
    means = gaussians.rows("means", rows)
    quats = mi.Vector4f(*gaussians.rows("quats", rows))
    scales = mi.Vector3f(*gaussians.rows("scales", rows))
    (opacities,) = gaussians.rows("opacities", rows)
    R, pose, eye = _pose(camera)
    fx, fy, cx, cy, near, *limits, delay, readout, height = _intrinsics(camera)
    cameras = camera.cameras if isinstance(camera, Views) else (camera,)

    world = [mi.Float64(v) for v in means]
    if any(c.delay or c.readout for c in cameras) and gaussians.motion is not None:
        _, y, z = _transformed(world, pose)
        row = dr.fma(fy, y / dr.maximum(z, near), cy)
        # Frames after the timestamp.
        late = dr.fma(readout, dr.clip(row / height, 0, 1) - 0.5, delay)
        world = [
            v + mi.Float64(late * d)
            for v, d in zip(world, gaussians.rows("motion", rows), strict=True)
        ]
    x, y, z = _transformed(world, pose)
    probe = dr.detach(x + y + z)
    front = dr.detach((z >= near) & (dr.maximum(dr.maximum(dr.abs(x), dr.abs(y)), z) < FARTHEST))
    x = dr.select(front, x, 0)
    y = dr.select(front, y, 0)
    z = dr.select(front, z, 1)
    rz = dr.rcp(z)
    mean_x = dr.fma(fx, x * rz, cx)
    mean_y = dr.fma(fy, y * rz, cy)

    u0, u1, w, r_focal, r_scale = _screen_axes(
        x * rz, y * rz, fx * rz, fy * rz, R, quats, scales, limits
    )
    r_size = r_focal * r_scale
    eps = dr.maximum(config.eps2d * dr.square(r_size), _THINNEST**2)
    xx = dr.dot(u0, u0)
    yy = dr.dot(u1, u1)
    xy = dr.dot(u0, u1)
    # Lagrange's identity: det(U U' + eps I) without the cancellation that xx yy - xy^2 has for
    # needles.
    det_exact = dr.squared_norm(dr.cross(u0, u1))
    det = det_exact + eps * (xx + yy) + eps * eps
    xx = xx + eps
    yy = yy + eps
    r_det = dr.rsqrt(det)
    r_yy = dr.rsqrt(yy)
    s = sqrt(_HALF_LOG2E) * r_size
    a = s * yy * r_yy * r_det
    b = -s * xy * r_yy * r_det
    c = s * r_yy
    log2_opacity = dr.log2(dr.maximum(opacities, _FAINTEST))
    if config.antialiased:
        log2_opacity += 0.5 * dr.log2(dr.maximum(det_exact / det, _FAINTEST**2))
    shape = (mean_x, mean_y, a, b, c, log2_opacity)
    line = (
        _depth_profile(z, (u0, u1, w), (xx, xy, yy), det, eps, r_focal, r_scale)
        if "profile" in channels
        else ()
    )

    blended: dict[str, tuple[Float, ...]] = {}
    largest = mi.Float(0)
    attributes = attribute_channels()
    for name in channels:
        if name == "color":
            direction = dr.select(
                front, mi.Vector3f(*(mi.Float(v - e) for v, e in zip(world, eye, strict=True))), 1
            )
            coeffs = gaussians.rows("sh_coeffs", rows)
            largest = _largest(largest, coeffs)
            blended[name] = _colors(direction, coeffs)
        elif name == "depth":
            blended[name] = (z,)
        elif name in ("motion", "guided_motion"):
            motion = gaussians.rows("motion", rows)
            if name == "guided_motion" and getattr(gaussians, "offset", None) is not None:
                # Without the learned offset (eq. 8).
                offset = gaussians.rows("offset", rows)
                motion = [a - b for a, b in zip(motion, offset, strict=True)]
            blended[name] = _screen_motion(
                motion, (x * rz, y * rz, z), (fx, fy), near, R, config.first_order_motion
            )
        elif name == "features":
            blended[name] = tuple(tensor_rows(features, rows))
        elif name in attributes:
            blended[name] = tuple(gaussians.rows(attributes[name].activated_name, rows))

    # alpha >= alpha_min  <=>  u^2 + v^2 <= reach, an ellipse with these half axes along x and y
    reach = dr.maximum(dr.detach(log2_opacity) - log2(config.alpha_min), 0)
    xx = dr.detach(xx)
    yy = dr.detach(yy)
    # Not finite where any of these values is not.
    probe += sum(
        dr.detach(v) for v in (*shape, *line, *(v for values in blended.values() for v in values))
    )
    largest = _largest(
        largest, [v for name, values in blended.items() if name != "depth" for v in values]
    )
    finite = dr.isfinite(probe) & (largest <= FARTHEST)  # pyright: ignore
    valid = front & (reach > 0) & finite  # pyright: ignore[reportOperatorIssue]
    extent = (dr.sqrt(reach * xx) / s, dr.sqrt(reach * yy) / s)
    view = camera.view if isinstance(camera, Views) else None
    return Splats(shape, blended, dr.detach(z), extent, valid, finite, line, view)


def _largest(bound: Float, values: Sequence[Float]) -> Float:
    """Return the largest absolute value of numbers, at least `bound`, detached."""
    for value in values:
        bound = dr.maximum(bound, dr.abs(dr.detach(value)))
    return bound


def _transformed(world: list[Float], pose: list[list[Float]]) -> tuple[Float, Float, Float]:
    """Return points in camera space, in single precision."""
    x, y, z = (
        mi.Float(dr.fma(a, world[0], dr.fma(b, world[1], dr.fma(c, world[2], t))))
        for a, b, c, t in pose
    )
    return x, y, z


def _pose(camera: Camera | Views) -> tuple[list[list[Float]], list[list[Float]], list[Float]]:
    """Return R [3][3] in single, and [R t] [3][4] and the camera's centre -R't [3] in double
    precision.

    All are Dr.Jit floats, of width 1 for one camera, and attached to the gradient of a Dr.Jit
    `viewmat`.
    """
    if isinstance(camera, Views):
        rows = [np.ravel(c.viewmat)[:12] for c in camera.cameras]
        numbers = _row_of(mi.Float64, rows, camera.view)
    else:
        viewmat: Tensor = camera.viewmat
        if dr.is_tensor_v(viewmat):
            memory = mi.Float64(viewmat.array)
            numbers = [dr.gather(mi.Float64, memory, mi.UInt32(k)) for k in range(12)]
        else:
            numbers = _numbers(mi.Float64, tuple(np.asarray(viewmat, float).flat[:12]))
    rows = [list(numbers[4 * i : 4 * i + 4]) for i in range(3)]
    eye = [-sum(row[k] * row[3] for row in rows) for k in range(3)]
    return [[mi.Float(v) for v in row[:3]] for row in rows], rows, eye


def _intrinsics(camera: Camera | Views) -> list[Float]:
    """Return fx, fy, cx, cy, near, the bounds (low, high) of x/z and of y/z, and delay, readout and
    height.

    They are read from memory: with Python numbers, every camera would compile its own kernels.
    """
    if isinstance(camera, Views):
        return _row_of(mi.Float, [_numbers_of(c) for c in camera.cameras], camera.view)
    values = list(_numbers(mi.Float, tuple(_numbers_of(camera))))
    attached = camera.intrinsics if isinstance(camera, AttachedCamera) else ()
    return [*map(dr.replace_grad, values, attached), *values[len(attached) :]]


@lru_cache(maxsize=1024)  # the views of a rig are projected to again and again
def _numbers(kind: type[Jit], values: tuple[float, ...]) -> tuple[Jit, ...]:
    """Return numbers in memory, each an array of width 1."""
    elements = tuple(_row_of(kind, [values], mi.UInt32(0)))
    dr.eval(elements)
    return elements


def _row_of(kind: type[Jit], rows: Sequence[Any], index: UInt32) -> list[Jit]:
    """Return the numbers of one of some rows in each lane."""
    memory = from_numpy(kind, rows)
    count = len(rows[0])
    return [dr.gather(kind, memory, index * count + k) for k in range(count)]


def _numbers_of(camera: Camera) -> list[float]:
    """Return the numbers that `_intrinsics` describes."""
    (fx, _, cx), (_, fy, cy) = camera.K[:2]
    # Up to which the projection is linearised: 30 % of the half view on every side.
    bounds = [
        bound
        for f, c, size in ((fx, cx, camera.width), (fy, cy, camera.height))
        for bound in (-c / f - 0.15 * size / f, (size - c) / f + 0.15 * size / f)
    ]
    return [fx, fy, cx, cy, camera.near, *bounds, camera.delay, camera.readout, camera.height]


def _rotation(quats: Jit) -> list[Jit]:
    """Return the columns of the rotation matrix of wxyz quaternions of any length; length 0 is the
    identity.
    """
    largest = dr.max(dr.abs(dr.detach(quats)))
    zero = largest < 1e-30
    # Scaling prevents over- and underflow of the squares. A product with 0 preserves NaN, which a
    # selection would not.
    scaled_quats = quats * dr.select(zero, 0, dr.rcp(dr.minimum(largest, 1e30)))
    w, x, y, z = dr.normalize(scaled_quats + mi.Vector4f(dr.select(zero, 1, 0), 0, 0, 0))
    return [
        mi.Vector3f(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        mi.Vector3f(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        mi.Vector3f(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    ]


def _screen_axes(
    tan_x: Float,
    tan_y: Float,
    jx: Float,
    jy: Float,
    R: list[list[Float]],
    quats: Jit,
    scales: Jit,
    limits: list[Float],
) -> tuple[Jit, Jit, Jit, Float, Float]:
    """Return the rows of U = J R Q diag(s) and w = R_z Q diag(s), three vectors [3], and their
    units.

    U is in units of the splat's size on the screen, at least one pixel and of the order of the
    largest entry of U; w in units of its size in the world. The units are returned as world units
    per px and 1 / world units.
    """
    # Outside the view the linearisation diverges: its point is clamped to 1.3 times the half view,
    # as in 3DGS.
    lo_x, hi_x, lo_y, hi_y = limits
    tan_x = dr.clip(tan_x, lo_x, hi_x)
    tan_y = dr.clip(tan_y, lo_y, hi_y)
    r_focal = dr.rcp(dr.detach(dr.maximum(jx, jy)))
    r_scale = dr.rcp(dr.maximum(dr.max(dr.detach(scales)), r_focal))
    jx = jx * r_focal
    jy = jy * r_focal
    scales = scales * r_scale
    J0 = mi.Vector3f(*(jx * (R[0][k] - tan_x * R[2][k]) for k in range(3)))
    J1 = mi.Vector3f(*(jy * (R[1][k] - tan_y * R[2][k]) for k in range(3)))
    Q = _rotation(quats)
    z_axis = mi.Vector3f(*R[2])
    u0, u1, w = (
        mi.Vector3f(*(dr.dot(J, Q[k]) * scales[k] for k in range(3))) for J in (J0, J1, z_axis)
    )
    return u0, u1, w, r_focal, r_scale


def _depth_profile(
    z: Float,
    rows: tuple[Jit, Jit, Jit],
    covariance: tuple[Float, Float, Float],
    det: Float,
    eps: Float,
    r_focal: Float,
    r_scale: Float,
) -> tuple[Float, Float, Float, Float]:
    """Return the depth z + gx dx + gy dy and the inverse standard deviation along rays, as (z, gx,
    gy, 1 / sigma).

    The response along the ray is largest at that depth, in the affine approximation (RaDe-GS, Zhang
    et al. 2024).
    """
    u0, u1, w = rows
    xx, xy, yy = covariance
    zx = dr.dot(u0, w)
    zy = dr.dot(u1, w)
    slope = r_focal / det
    # The determinant with the third row and column, as a sum of squares: differences would cancel
    # for thin Gaussians.
    across = dr.cross(u0, u1)
    minors = dr.squared_norm(dr.cross(u0, w)) + dr.squared_norm(dr.cross(u1, w))
    det3 = dr.square(dr.dot(across, w)) + eps * minors + eps * eps * dr.squared_norm(w)
    r_sigma = r_scale * dr.rsqrt(dr.maximum(det3 / det, _THINNEST**2))
    return z, slope * (yy * zx - xy * zy), slope * (xx * zy - xy * zx), r_sigma


def _colors(direction: Jit, coeffs: list[Float]) -> tuple[Float, ...]:
    """Return max(0.5 + SH(direction), 0) per colour component (3DGS's convention) of 3 K
    coefficients.
    """
    basis = dr.sh_eval(dr.normalize(direction), int(sqrt(len(coeffs) // 3)) - 1)
    sums: list[Float] = [sum(B * coeffs[3 * k + c] for k, B in enumerate(basis)) for c in range(3)]
    return tuple(dr.maximum(total + 0.5, 0) for total in sums)


def _screen_motion(
    motion: list[Float],
    point: tuple[Float, Float, Float],
    focal: tuple[Float, Float],
    near: Float,
    R: list[list[Float]],
    first_order: bool,
) -> tuple[Float, Float]:
    """Return the displacement pi(x) - pi(x - v) in px, where v = R motion: fx (vx - x/z vz) / (z -
    vz), likewise for y.

    With z instead of z - vz it is J v, the first-order projection (eq. 6). It is returned on
    request, and where x - v is behind the near plane.

    Args:
        motion: displacement in the world since the last frame.
        point: x/z, y/z and z in camera space.
        focal: fx and fy, px.
        near: near plane, world units.
        R: rotation of the camera.
        first_order: whether J v is requested.
    """
    vx, vy, vz = (sum(R[i][k] * motion[k] for k in range(3)) for i in range(3))
    tan_x, tan_y, z = point
    earlier = z - vz
    depth = z if first_order else dr.select(earlier >= near, earlier, z)
    fx, fy = focal
    return fx * (vx - tan_x * vz) / depth, fy * (vy - tan_y * vz) / depth
