"""Shadows of inserted surfaces on Gaussians, by differential rendering (Debevec 1998).

The colour of a Gaussian is light that it reflected in the recording. Inserted surfaces scale it by
the ratio of the irradiance with and without them, from the same lights. The ratio is traced from
the Gaussian's centre, with the same directions in numerator and denominator: it is exactly 1 where
nothing is in the way.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from morgs_mi.core.checks import check_number, check_type, numbers, require
from morgs_mi.core.color_space import SH_C0, decode_light, encode_light
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.geometry import covariances
from morgs_mi.core.memory import from_numpy
from morgs_mi.core.types import Float, UInt32
from morgs_mi.extras.light.light_probe import check_point
from morgs_mi.surfaces.surface_view import shared_scene

# Gaussians around one that determine the surface it lies on.
_NEIGHBOURS = 16


def shadow_ratio(
    gaussians: Gaussians, scene: Any, viewpoint: ArrayLike, samples: int = 256
) -> np.ndarray:
    """Return the ratio of each Gaussian's irradiance with and without a scene's surfaces, float32
    [N] in [0, 1].

    An approximation: light travels straight from the lights to the centre of a Gaussian. Where the
    Gaussians around it form a surface, it receives light on the side that faces the viewpoint, by
    the cosine; elsewhere from everywhere. Shadows among Gaussians, and light that surfaces reflect,
    are not computed. It has no gradient.

    Args:
        gaussians: N Gaussians.
        scene: Mitsuba scene with the surfaces and the lights of the recording, such as a
            `light_probe`; its `ellipsoids` are ignored.
        viewpoint: a point [3] from which the captured surfaces are seen, world units: a camera's
            position.
        samples: directions per light; they are the same for all Gaussians, and shadows have no
            noise.

    Raises:
        ValueError: a bad argument, or a scene without an emitter.
    """
    place = "shadow_ratio()"
    check_type(place, "gaussians", gaussians, Gaussians)
    check_number(place, "samples", samples, "[1, 65536]")
    eye = check_point(place, "viewpoint", viewpoint)
    emitters = scene.emitters()
    shapes = [shape for shape in scene.shapes() if not shape.is_ellipsoids()]
    remedy = "add one, such as an `envmap` of morgs_mi.light_probe()"
    require(emitters, place, "expected a scene with an emitter", "none", remedy)
    if not len(gaussians) or not shapes:
        return np.ones(len(gaussians), np.float32)
    with dr.suspend_grad():
        receivers = _Receivers(gaussians, eye)
        blockers = shared_scene(shapes, scene)
        blocked = mi.Float(0)
        total = mi.Float(0)
        for emitter in emitters:
            some, every = _irradiance(emitter, receivers, blockers, int(samples))
            blocked = blocked + some
            total = total + every
        return np.array(1 - dr.select(total > 0, blocked / total, 0))


def shadowed(gaussians: Gaussians, ratio: np.ndarray) -> Gaussians:
    """Return Gaussians with their colours scaled by a ratio [N] of linear light, see
    `shadow_ratio`.

    The colours are sRGB-encoded. Their dependence on direction is scaled by the factor of the mean
    colour.

    Raises:
        ValueError: a ratio of another shape, or with numbers that are negative or not finite.
    """
    ratio = numbers("shadowed()", "ratio", ratio).astype(np.float64)
    require(
        ratio.shape == (len(gaussians),) and (np.isfinite(ratio) & (ratio >= 0)).all(),
        "shadowed()",
        f"`ratio` must be [N] with N={len(gaussians)}, finite and not negative",
        list(ratio.shape),
        "pass the result of shadow_ratio()",
    )
    # The mean colours [N, 1, 3].
    mean = np.maximum(0.5 + SH_C0 * np.array(dr.detach(gaussians.sh_coeffs))[:, :1], 1e-6)
    factor = encode_light(ratio[:, None, None] * decode_light(mean)) / mean
    shift = np.zeros((1, int(gaussians.sh_coeffs.shape[1]), 1))
    shift[:, 0] = 0.5 / SH_C0  # factor (0.5 + SH) = 0.5 + SH of the new coefficients
    scale = from_numpy(mi.TensorXf, np.broadcast_to(factor, gaussians.sh_coeffs.shape))
    return replace(
        gaussians,
        sh_coeffs=gaussians.sh_coeffs * scale + from_numpy(mi.TensorXf, (factor - 1) * shift),
    )


class _Receivers:
    """Centres and orientation of the Gaussians: `flat` is 0 in a round neighbourhood and 1 on a
    plane. Single Gaussians of a fitted surface lie in it, but are not all flat.
    """

    def __init__(self, gaussians: Gaussians, eye: np.ndarray) -> None:
        means: np.ndarray = np.array(dr.detach(gaussians.means), np.float64)
        mixture = _mixture(means, np.array(dr.detach(gaussians.opacities), np.float64))
        # The covariance of the mixture: the mean of its second moments, minus the second moment of
        # its centre.
        centered = means - means.mean(0)
        centers = mixture @ centered
        moments = covariances(gaussians) + centered[:, :, None] * centered[:, None]
        mean_moments = (mixture @ moments.reshape(-1, 9)).reshape(-1, 3, 3)
        variances, directions = np.linalg.eigh(
            mean_moments - centers[:, :, None] * centers[:, None]
        )
        normals = directions[:, :, 0]  # the thinnest direction
        is_back = np.sum(normals * (eye - means), axis=1) < 0
        normals = np.where(is_back[:, None], -normals, normals)
        self.centers = dr.unravel(mi.Point3f, from_numpy(mi.Float, means))
        self.normals = dr.unravel(mi.Vector3f, from_numpy(mi.Float, normals))
        flat = 1 - variances[:, 0] / np.maximum(variances[:, 1], 1e-30)
        self.flat = from_numpy(mi.Float, flat)

    def response(self, direction: Any) -> Float:
        """Return the received fraction of light from a direction."""
        return dr.lerp(0.5, dr.maximum(dr.dot(self.normals, direction), 0), self.flat)


def _mixture(means: np.ndarray, opacities: np.ndarray) -> csr_array:
    """Return the weights [N, N] of the Gaussians around each one, by their opacities [N]."""
    _, near = KDTree(means).query(means, min(_NEIGHBOURS, len(means)), workers=-1)
    near = near.reshape(len(means), -1)
    # An opacity may be 0 in float32.
    weights = opacities[near] + 1e-9
    weights /= weights.sum(1, keepdims=True)
    ends = np.arange(0, near.size + 1, near.shape[1])
    return csr_array((weights.ravel(), near.ravel(), ends), shape=(len(means), len(means)))


def _irradiance(
    emitter: Any, receivers: _Receivers, blockers: Any, samples: int
) -> tuple[Float, Float]:
    """Return the irradiance of one light that surfaces block, and that without surfaces."""
    far = mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)
    it = dr.zeros(mi.Interaction3f, dr.width(receivers.centers))
    it.p = receivers.centers
    count = dr.opaque(mi.UInt32, samples)
    step_size = dr.opaque(mi.Float, 1 / samples)
    no_scramble: Any = 0

    def step(k: UInt32, blocked: Float, total: Float) -> tuple[UInt32, Float, Float]:
        sample = mi.Point2f((mi.Float(k) + 0.5) * step_size, mi.radical_inverse_2(k, no_scramble))
        ds, weight = emitter.sample_direction(it, sample)
        irradiance = dr.mean(mi.unpolarized_spectrum(weight)) * receivers.response(ds.d)
        ray = mi.Ray3f(receivers.centers, ds.d)
        if not far:
            ray.maxt = ds.dist * (1 - 1e-4)
        is_hidden = blockers.ray_test(ray, irradiance > 0)
        return k + 1, blocked + dr.select(is_hidden, irradiance, 0), total + irradiance

    state = (mi.UInt32(0), mi.Float(0), mi.Float(0))
    _, blocked, total = dr.while_loop(state, lambda k, *_: k < count, step, label="shadow")
    return blocked, total
