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

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import concatenated, from_numpy
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import ActivatedGaussians, tensor_rows
from morgs_mi.core.types import (
    Bool,
    Color3f,
    Float,
    Jit,
    Matrix3d,
    Matrix3f,
    Point2f,
    Point3d,
    Point3f,
    Tensor,
    UInt32,
    Vector2f,
    Vector3d,
    Vector3f,
    Vector4f,
)
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
class DepthProfile:
    """Gaussians in depth along the ray of a pixel (see module docstring), world units."""

    mean: Float  #: Depth z at the centre of the splat.
    slope: Vector2f  #: (gx, gy), the change of that depth per px.
    r_sigma: Float  #: Inverse standard deviation.


@dataclass(frozen=True)
class Splats:
    """N projected Gaussians."""

    mean: Point2f  #: Centre, px.
    #: (a, b, c), the Cholesky factor of the conic times log2(e) / 2 (see module docstring), 1 / px.
    conic: Vector3f
    log2_opacity: Float  #: Logarithm of the opacity to base 2.
    channels: dict[str, tuple[Float, ...]]  #: Blended values, by channel name.
    depth: Float  #: Camera-space z in world units, detached.
    #: Half width and half height in px of the box where alpha >= alpha_min, detached; 0 if culled.
    radius: Vector2f
    valid: Bool  #: False where culled: behind the near plane, too faint, or not finite.
    #: False where an attribute, or a value computed from it, is not finite, or a blended one is
    #: above 1e18.
    finite: Bool | None = None
    profile: DepthProfile | None = None  #: None if no depth limit cuts the splats.
    #: Index of the view that each splat belongs to, in a region of several views; None: there is
    #: one view.
    view: UInt32 | None = None

    def __len__(self) -> int:
        return dr.width(self.depth)

    @property
    def geometry(self) -> tuple[Float, ...]:
        """The differentiable numbers that determine a splat's alpha at a pixel."""
        shape = (*self.mean, *self.conic, self.log2_opacity)
        cut = self.profile
        return shape if cut is None else (*shape, cut.mean, *cut.slope, cut.r_sigma)

    def columns(self, channels: Sequence[str]) -> list[Float]:
        """Return the blended values of some channels, one column after the other."""
        return [column for name in channels for column in self.channels[name]]

    @property
    def _present(self) -> dict[str, Jit]:
        """The fields that are not None."""
        return {name: value for name, value in vars(self).items() if value is not None}

    def at(self, rows: UInt32) -> Splats:
        """Return the splats with these indices [M]."""
        return Splats(**dr.gather(dict, self._present, rows))

    def concatenated_with(self, *others: Splats) -> Splats:
        """Return these splats, then the others, which are 0 in the channels that they lack."""
        parts = [self._present, *map(self._fields_of, others)]
        # Otherwise the kernel of each column would project all splats again.
        dr.eval(parts)
        return Splats(**concatenated(parts))

    def followed_by(self, others: Splats, first: UInt32, count: UInt32, size: int) -> Splats:
        """Return these splats, then some others, which are not copied before: `count` of them from
        an index on, and splats that are not valid up to a `size`.
        """
        own = self._present
        dr.eval(own)
        lane = dr.arange(mi.UInt32, len(self) + size)
        is_own = lane < len(self)
        place = lane - len(self)
        is_other = ~is_own & (place < count)
        own = dr.gather(dict, own, lane, is_own)
        following = dr.gather(dict, self._fields_of(others), first + place, is_other)
        return Splats(**dr.select(is_own, own, following))

    def _fields_of(self, others: Splats) -> dict[str, Jit]:
        """Return those fields of other splats that these have; channels that they lack are 0."""
        channels = {
            name: others.channels.get(name)
            or tuple(dr.zeros(mi.Float, len(others)) for _ in columns)
            for name, columns in self.channels.items()
        }
        return {**{name: vars(others)[name] for name in self._present}, "channels": channels}


@dataclass(frozen=True, eq=False)
class AttachedCamera(Camera):
    """Camera with intrinsics that get gradients, in pixels, with the values of `K`."""

    focal: Vector2f | None = None  #: fx and fy.
    center: Point2f | None = None  #: cx and cy.


@dataclass(frozen=True)
class Pose:
    """Map x = R mean + t from the world to a camera, in double precision."""

    rotation: Matrix3d  #: R.
    translation: Vector3d  #: t, world units.
    position: Point3d  #: Centre of the camera, -R't.
    axes: Matrix3f  #: R in single precision.

    @staticmethod
    def of(numbers: Sequence[Float]) -> Pose:
        """Return the pose with the first three rows of a `viewmat` [12]."""
        R = mi.Matrix3f64(numbers[0:3], numbers[4:7], numbers[8:11])
        t = mi.Vector3d(numbers[3::4])
        right, down, forward = R
        position = mi.Point3d(-(right * t.x + down * t.y + forward * t.z))
        return Pose(R, t, position, mi.Matrix3f(R))

    def transformed(self, points: Point3d) -> Point3f:
        """Return points in camera space, in single precision."""
        x_axis, y_axis, z_axis = self.rotation.T
        inner = dr.fma(z_axis, points.z, self.translation)
        return mi.Point3f(dr.fma(x_axis, points.x, dr.fma(y_axis, points.y, inner)))


@dataclass(frozen=True)
class Intrinsics:
    """A camera without its pose."""

    focal: Vector2f  #: fx and fy, px.
    center: Point2f  #: cx and cy, px.
    low: Vector2f  #: Least x/z and y/z at which the projection is linearised.
    high: Vector2f  #: Largest ones.
    near: Float  #: Depth of the near plane, world units.
    delay: Float  #: Frames from the timestamp to the middle row.
    readout: Float  #: Frames from the first to the last row.
    height: Float  #: Of the image, px.

    @staticmethod
    def of(numbers: Sequence[Float]) -> Intrinsics:
        """Return the intrinsics with the numbers of `intrinsics_of` [12]."""
        return Intrinsics(
            mi.Vector2f(numbers[0:2]),
            mi.Point2f(numbers[2:4]),
            mi.Vector2f(numbers[4:6]),
            mi.Vector2f(numbers[6:8]),
            *numbers[8:],
        )

    def frames_late(self, point: Point3f) -> Float:
        """Return how many frames after the timestamp a point in camera space is seen."""
        row = dr.fma(self.focal.y, point.y / dr.maximum(point.z, self.near), self.center.y)
        return dr.fma(self.readout, dr.clip(row / self.height, 0, 1) - 0.5, self.delay)


@dataclass(frozen=True)
class TracedCamera:
    """A camera in memory: with Python numbers, every camera would compile its own kernels."""

    pose: Pose
    intrinsics: Intrinsics
    is_late: bool = False  #: Whether it sees some pixels before or after the timestamp.
    view: UInt32 | None = None  #: Index of each lane's camera; None: there is one camera.

    @staticmethod
    def of(camera: Camera) -> TracedCamera:
        """Return a camera, attached to the gradients of a Dr.Jit `viewmat` and of an
        `AttachedCamera`.
        """
        viewmat: Tensor = camera.viewmat
        if dr.is_tensor_v(viewmat):
            pose = Pose.of(_row_of(mi.Float64(viewmat.array)))
        else:
            pose = _pose(mi.variant(), tuple(np.asarray(viewmat, float).flat[:12]))
        intrinsics = _intrinsics(mi.variant(), tuple(intrinsics_of(camera)))
        if isinstance(camera, AttachedCamera):
            focal = dr.replace_grad(intrinsics.focal, camera.focal)
            center = dr.replace_grad(intrinsics.center, camera.center)
            intrinsics = replace(intrinsics, focal=focal, center=center)
        return TracedCamera(pose, intrinsics, bool(camera.delay or camera.readout))

    @staticmethod
    def of_arrays(pose: Float, intrinsics: Float) -> TracedCamera:
        """Return a camera without delay and readout from arguments of a recording.

        Args:
            pose: the first three rows of its `viewmat`, in double precision [12].
            intrinsics: see `intrinsics_of` [12].
        """
        return TracedCamera(Pose.of(_row_of(pose)), Intrinsics.of(_row_of(intrinsics)))


@dataclass(frozen=True)
class TracedCameras:
    """Several cameras in memory, without gradients."""

    poses: Float  #: The first three rows of their `viewmat`, in double precision [12 V].
    intrinsics: Float  #: See `intrinsics_of` [12 V].
    is_late: bool  #: Whether one of them sees some pixels before or after the timestamp.

    @staticmethod
    def of(cameras: Sequence[Camera]) -> TracedCameras:
        """Return V cameras."""
        return TracedCameras(
            from_numpy(mi.Float64, [np.ravel(camera.viewmat)[:12] for camera in cameras]),
            from_numpy(mi.Float, [intrinsics_of(camera) for camera in cameras]),
            any(camera.delay or camera.readout for camera in cameras),
        )

    def of_each(self, view: UInt32) -> TracedCamera:
        """Return the camera of each lane, by its index."""
        pose = Pose.of(_row_of(self.poses, view))
        intrinsics = Intrinsics.of(_row_of(self.intrinsics, view))
        return TracedCamera(pose, intrinsics, self.is_late, view)


def intrinsics_of(camera: Camera) -> np.ndarray:
    """Return fx, fy, cx, cy, the least x/z and y/z at which the projection is linearised, the
    largest ones, near, delay, readout and height [12].
    """
    focal = np.diag(camera.K)[:2]
    center = camera.K[:2, 2]
    size = np.array(camera.size)
    # 30 % of the half view on every side.
    margin = 0.15 * size / focal
    low = -center / focal - margin
    high = (size - center) / focal + margin
    others = [camera.near, camera.delay, camera.readout, camera.height]
    return np.concatenate([focal, center, low, high, others])


# The views of a rig are projected to again and again.
@lru_cache(maxsize=1024)
def _pose(variant: str | None, numbers: tuple[float, ...]) -> Pose:
    """Return a pose in memory."""
    pose = Pose.of(_row_of(from_numpy(mi.Float64, numbers)))
    dr.eval(pose)
    return pose


@lru_cache(maxsize=1024)
def _intrinsics(variant: str | None, numbers: tuple[float, ...]) -> Intrinsics:
    """Return intrinsics in memory."""
    intrinsics = Intrinsics.of(_row_of(from_numpy(mi.Float, numbers)))
    dr.eval(intrinsics)
    return intrinsics


def _row_of(rows: Jit, index: UInt32 | int = 0) -> tuple[Jit, ...]:
    """Return the 12 numbers of one of some rows in each lane."""
    return tuple(dr.gather(type(rows), rows, mi.UInt32(index * 12 + k)) for k in range(12))


def project(
    gaussians: ActivatedGaussians,
    camera: Camera | TracedCamera,
    channels: tuple[str, ...],
    config: RenderConfig,
    rows: UInt32 | None = None,
    features: Tensor | None = None,
) -> Splats:
    """Project Gaussians to the screen of `camera` and evaluate the requested channels.

    Args:
        gaussians: N Gaussians with activated attributes.
        camera: the view; a Dr.Jit `viewmat` receives gradients.
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
    world = mi.Point3d(mi.Point3f(gaussians.rows("means", rows)))
    quats = mi.Vector4f(gaussians.rows("quats", rows))
    scales = mi.Vector3f(gaussians.rows("scales", rows))
    (opacities,) = gaussians.rows("opacities", rows)
    camera = TracedCamera.of(camera) if isinstance(camera, Camera) else camera
    pose = camera.pose
    lens = camera.intrinsics
    R = pose.axes

    if camera.is_late and gaussians.motion is not None:
        late = lens.frames_late(pose.transformed(world))
        motion = mi.Vector3f(gaussians.rows("motion", rows))
        world += mi.Vector3d(late * motion)  # pyright: ignore[reportOperatorIssue]
    point = pose.transformed(world)
    probe = dr.detach(dr.sum(point))
    front = dr.detach((point.z >= lens.near) & (dr.max(dr.abs(point)) < FARTHEST))
    point = dr.select(front, point, mi.Point3f(0, 0, 1))
    xy = point.xy
    z = point.z
    rz = dr.rcp(z)
    mean = dr.fma(lens.focal, xy * rz, lens.center)

    axes = _screen_axes(xy * rz, lens.focal * rz, lens, R, quats, scales)
    r_size = axes.r_focal * axes.r_scale
    eps = dr.maximum(config.eps2d * dr.square(r_size), _THINNEST**2)
    covariance = _screen_covariance(axes, eps)
    r_det = dr.rsqrt(covariance.det)
    r_yy = dr.rsqrt(covariance.yy)
    s = sqrt(_HALF_LOG2E) * r_size
    conic = mi.Vector3f(
        s * covariance.yy * r_yy * r_det, -s * covariance.xy * r_yy * r_det, s * r_yy
    )
    log2_opacity = dr.log2(dr.maximum(opacities, _FAINTEST))
    if config.antialiased:
        share = covariance.det_exact / covariance.det
        log2_opacity += 0.5 * dr.log2(dr.maximum(share, _FAINTEST**2))
    profile = _depth_profile(z, axes, covariance) if "profile" in channels else None

    blended: dict[str, tuple[Float, ...]] = {}
    limited: list[Float] = []  # what must be at most 1e18
    attributes = attribute_channels()
    for name in channels:
        if name == "color":
            direction = dr.select(front, mi.Vector3f(world - pose.position), 1)
            coeffs = gaussians.rows("sh_coeffs", rows)
            limited += coeffs
            blended[name] = tuple(_colors(direction, coeffs))
        elif name == "depth":
            blended[name] = (z,)
        elif name in ("motion", "guided_motion"):
            motion = mi.Vector3f(gaussians.rows("motion", rows))
            if name == "guided_motion" and getattr(gaussians, "offset", None) is not None:
                # Without the learned offset (eq. 8).
                motion = motion - mi.Vector3f(gaussians.rows("offset", rows))
            blended[name] = tuple(
                _screen_motion(motion, xy * rz, z, lens, R, config.first_order_motion)
            )
        elif name == "features":
            blended[name] = tuple(tensor_rows(features, rows))
        elif name in attributes:
            blended[name] = tuple(gaussians.rows(attributes[name].activated_name, rows))

    # alpha >= alpha_min  <=>  u^2 + v^2 <= reach, an ellipse with these half axes along x and y
    reach = dr.maximum(dr.detach(log2_opacity) - log2(config.alpha_min), 0)
    variances = dr.detach(mi.Vector2f(covariance.xx, covariance.yy))
    radius = dr.sqrt(variances * reach) / mi.Vector2f(s)  # pyright: ignore
    splats = Splats(
        mean,
        conic,
        log2_opacity,
        blended,
        dr.detach(z),
        radius,
        valid=front & (reach > 0),  # pyright: ignore[reportOperatorIssue]
        profile=profile,
        view=camera.view,
    )
    # Not finite where any of these values is not.
    values = [v for values in blended.values() for v in values]
    probe += sum(dr.detach([*splats.geometry, *values]))
    largest = mi.Float(0)
    for value in (*limited, *values):
        largest = dr.maximum(largest, dr.abs(dr.detach(value)))
    finite = dr.isfinite(probe) & (largest <= FARTHEST)  # pyright: ignore
    return replace(splats, valid=splats.valid & finite, finite=finite)


def _inverse_rotation(quats: Vector4f) -> Matrix3f:
    """Return Q', the transposed rotation matrix of wxyz quaternions of any length; length 0 is the
    identity.
    """
    largest = dr.max(dr.abs(dr.detach(quats)))
    zero = largest < 1e-30
    # Scaling prevents over- and underflow of the squares. A product with 0 preserves NaN, which a
    # selection would not.
    scaled_quats = quats * dr.select(zero, 0, dr.rcp(dr.minimum(largest, 1e30)))
    w, x, y, z = dr.normalize(scaled_quats + mi.Vector4f(dr.select(zero, 1, 0), 0, 0, 0))
    x_axis = mi.Vector3f(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
    y_axis = mi.Vector3f(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x))
    z_axis = mi.Vector3f(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    return mi.Matrix3f(x_axis, y_axis, z_axis)


@dataclass(frozen=True)
class _ScreenAxes:
    """Axes of a Gaussian on the screen, U = J R Q diag(s), and in depth.

    U is in units of the splat's size on the screen, at least one pixel and of the order of the
    largest entry of U; w in units of its size in the world.
    """

    u: Vector3f  #: First row of U.
    v: Vector3f  #: Second row of U.
    w: Vector3f  #: Last row of R Q diag(s).
    r_focal: Float  #: World units per px.
    r_scale: Float  #: 1 / world units.


def _screen_axes(
    tangent: Vector2f,
    slope: Vector2f,
    lens: Intrinsics,
    R: Matrix3f,
    quats: Vector4f,
    scales: Vector3f,
) -> _ScreenAxes:
    """Return the axes of Gaussians at x/z and y/z, where the image moves by `slope` px per unit."""
    # Outside the view the linearisation diverges: its point is clamped to 1.3 times the half view,
    # as in 3DGS.
    tangent = dr.clip(tangent, lens.low, lens.high)
    r_focal = dr.rcp(dr.detach(dr.max(slope)))
    r_scale = dr.rcp(dr.maximum(dr.max(dr.detach(scales)), r_focal))
    slope = slope * r_focal
    scales = scales * r_scale
    right, down, forward = R
    # The rows of J R.
    row_x = slope.x * (right - tangent.x * forward)
    row_y = slope.y * (down - tangent.y * forward)
    inverse = _inverse_rotation(quats)
    u = inverse @ row_x * scales
    v = inverse @ row_y * scales
    w = inverse @ forward * scales
    return _ScreenAxes(u, v, w, r_focal, r_scale)


@dataclass(frozen=True)
class _ScreenCovariance:
    """U U' + eps I and its determinant."""

    xx: Float
    xy: Float
    yy: Float
    det: Float
    det_exact: Float  #: det U U'.
    eps: Float


def _screen_covariance(axes: _ScreenAxes, eps: Float) -> _ScreenCovariance:
    """Return U U' + eps I."""
    xx = dr.dot(axes.u, axes.u)
    yy = dr.dot(axes.v, axes.v)
    xy = dr.dot(axes.u, axes.v)
    # Lagrange's identity: det(U U' + eps I) without the cancellation that xx yy - xy^2 has for
    # needles.
    det_exact = dr.squared_norm(dr.cross(axes.u, axes.v))
    det = det_exact + eps * (xx + yy) + eps * eps
    return _ScreenCovariance(xx + eps, xy, yy + eps, det, det_exact, eps)


def _depth_profile(z: Float, axes: _ScreenAxes, covariance: _ScreenCovariance) -> DepthProfile:
    """Return the depth z + gx dx + gy dy and the inverse standard deviation along rays.

    The response along the ray is largest at that depth, in the affine approximation (RaDe-GS, Zhang
    et al. 2024).
    """
    u = axes.u
    v = axes.v
    w = axes.w
    eps = covariance.eps
    zx = dr.dot(u, w)
    zy = dr.dot(v, w)
    slope = axes.r_focal / covariance.det
    # The determinant with the third row and column, as a sum of squares: differences would cancel
    # for thin Gaussians.
    across = dr.cross(u, v)
    minors = dr.squared_norm(dr.cross(u, w)) + dr.squared_norm(dr.cross(v, w))
    det3 = dr.square(dr.dot(across, w)) + eps * minors + eps * eps * dr.squared_norm(w)
    r_sigma = axes.r_scale * dr.rsqrt(dr.maximum(det3 / covariance.det, _THINNEST**2))
    xy = covariance.xy
    gradient = mi.Vector2f(covariance.yy * zx - xy * zy, covariance.xx * zy - xy * zx)
    return DepthProfile(z, slope * gradient, r_sigma)


def _colors(direction: Vector3f, coeffs: Sequence[Float]) -> Color3f:
    """Return max(0.5 + SH(direction), 0) (3DGS's convention) of 3 K coefficients."""
    basis = dr.sh_eval(dr.normalize(direction), int(sqrt(len(coeffs) // 3)) - 1)
    color = mi.Color3f(0)
    for k, value in enumerate(basis):
        color += value * mi.Color3f(coeffs[3 * k : 3 * k + 3])
    return dr.maximum(color + 0.5, 0)


def _screen_motion(
    motion: Vector3f,
    tangent: Vector2f,
    z: Float,
    lens: Intrinsics,
    R: Matrix3f,
    first_order: bool,
) -> Vector2f:
    """Return the displacement pi(x) - pi(x - v) in px, where v = R motion: fx (vx - x/z vz) / (z -
    vz), likewise for y.

    With z instead of z - vz it is J v, the first-order projection (eq. 6). It is returned on
    request, and where x - v is behind the near plane.

    Args:
        motion: displacement in the world since the last frame.
        tangent: x/z and y/z in camera space.
        z: depth, world units.
        lens: intrinsics of the camera.
        R: rotation of the camera.
        first_order: whether J v is requested.
    """
    x_axis, y_axis, z_axis = R.T
    v = x_axis * motion.x + y_axis * motion.y + z_axis * motion.z
    earlier = z - v.z
    # A quotient of vectors: that of a vector and a number is a product with its rounded inverse.
    depth = mi.Vector2f(z if first_order else dr.select(earlier >= lens.near, earlier, z))
    return lens.focal * (v.xy - tangent * v.z) / depth
