"""Reference implementation of the renderer in double precision, with which its error is measured.

For a list of pixels instead of a whole image: every pixel evaluates every Gaussian, without lists
and early stop. Scenes of any size can be evaluated by a sample. The derivatives are Dr.Jit's.
"""

from __future__ import annotations

from math import isqrt
from operator import mul
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.attributes import sigmoid
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.render.render_config import RenderConfig

ATTRIBUTES = ("means", "log_scales", "quats", "logit_opacities", "sh_coeffs")
"""Attributes on which the colour depends."""
# Pairs of pixel and Gaussian that are evaluated together: 16 MB per array.
PAIRS = 2_000_000


def reference64(
    gaussians: Gaussians,
    camera: Camera,
    pixels: np.ndarray,
    weights: np.ndarray,
    config: RenderConfig,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the colours [P, 3] of some pixels over black (eq. 1), display-referred, and the
    gradients of the sum of `weights` times these colours, by attribute in its shape.

    Args:
        gaussians: N Gaussians; their motion and the delays of the camera are ignored.
        camera: the view; its intrinsics are rounded to float32, as in the renderer.
        pixels: columns and rows [P, 2].
        weights: [P, 3].
        config: `eps2d`, `antialiased`, `alpha_min` and `alpha_max` are used.
    """
    types: Any = mi  # The stubs of Mitsuba lack the types of double precision.
    raw = gaussians.numpy()
    columns: dict[str, Any] = {
        name: [mi.Float64(column) for column in raw[name].reshape(len(gaussians), -1).T]
        for name in ATTRIBUTES
    }
    dr.enable_grad(columns)
    means, scales, (w, *xyz), (logits,), sh = columns.values()
    view = camera.world_to_camera
    R = types.Matrix3f64(view[:3, :3])
    t = types.Array3f64(view[:3, 3])
    point = R @ types.Array3f64(means) + t
    front = point.z >= np.float32(camera.near)
    order = np.argsort(np.where(front, point.z, np.inf), kind="stable")[: np.sum(front)]
    x, y, z = dr.select(front, point, 1)
    quats = types.Quaternion4f64(*xyz, w)
    quats = dr.normalize(dr.select(dr.squared_norm(quats) > 0, quats, 1))
    axes = R @ dr.quat_to_matrix(types.Matrix3f64, quats) @ dr.diag(dr.exp(types.Array3f64(scales)))
    K = camera.K.astype(np.float32).astype(np.float64)
    f = types.Array2f64(np.diag(K)[:2])
    c = types.Array2f64(K[:2, 2])
    size = types.Array2f64(camera.width, camera.height)
    tangents = types.Array2f64(x, y) / z
    # Outside of 1.3 times the view, the projection is not linearised.
    clipped = dr.clip(tangents, (-0.15 * size - c) / f, (1.15 * size - c) / f)
    rows = [f[i] / z * (axes[i] - clipped[i] * axes[2]) for i in range(2)]
    covariance = types.Matrix2f64(*(dr.dot(a, b) for a in rows for b in rows))
    filtered = covariance + types.Matrix2f64(config.eps2d)
    opacity = sigmoid(logits)
    if config.antialiased:
        opacity *= dr.sqrt(dr.det(covariance) / dr.det(filtered))
    basis = dr.sh_eval(dr.normalize(types.Array3f64(means) + R.T @ t), isqrt(len(sh) // 3) - 1)
    colors: Any = sum(map(mul, basis, map(types.Array3f64, sh[::3], sh[1::3], sh[2::3])), 0.5)
    splats = f * tangents + c, dr.rcp(filtered), opacity, dr.maximum(colors, 0)

    N = len(order)
    result = np.zeros(weights.shape)
    count = max(1, PAIRS // max(1, N))
    for start in range(0, len(pixels) if N else 0, count):
        chunk = slice(start, start + count)
        pixel = dr.repeat(types.Array2f64(pixels[chunk].T + 0.5), N)
        index = mi.UInt32(np.resize(order, dr.width(pixel)))
        mean, conic, opacity, color = (dr.gather(type(v), v, index) for v in splats)
        offset = pixel - mean
        full = opacity * dr.exp(-0.5 * dr.dot(offset, conic @ offset))
        alpha = dr.select(full >= config.alpha_min, dr.minimum(full, config.alpha_max), 0)
        weight = alpha * dr.exp(dr.block_prefix_sum(dr.log(1 - alpha), N))
        image = dr.block_sum(weight * color, N)
        # The graph of the projection remains for the next pixels.
        loss = dr.sum(dr.dot(image, types.Array3f64(weights[chunk].T)))
        dr.backward(loss, flags=dr.ADFlag.ClearInterior)
        result[chunk] = np.transpose(image)
    return result, {
        name: np.transpose(dr.grad(value)).reshape(raw[name].shape)
        for name, value in columns.items()
    }
