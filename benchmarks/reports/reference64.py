"""Reference implementation of the renderer in double precision, with which its error is measured.

NumPy float64, for a list of pixels instead of a whole image. Scenes of any size can be evaluated by
a sample. Every pixel evaluates every Gaussian: there are no lists, and no early stop. N Gaussians,
P pixels; A = alpha before the cap, T = transmittance in front of a Gaussian, w = T alpha, values c
= (colour, 1).

The adjoint of the blend is written by hand: with g the gradient at a pixel and S_i = sum_{j > i}
w_j <g, c_j>,

    dL/dalpha_i = T_i <g, c_i> - S_i / (1 - alpha_i),

and so is its chain through A = opacity exp(-sigma). The Jacobian of the projection, from eleven
numbers (mean, scales, rotation, opacity) to a splat's nine numbers with colour, is computed by
complex steps, exact to rounding: derivatives derived by hand might share the renderer's mistakes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import SH_C0
from morgs_mi.render.render_config import RenderConfig

ATTRIBUTES = ("means", "log_scales", "quats", "logit_opacities", "sh_coeffs")
_GEOMETRY = ATTRIBUTES[:4]
_STEP = 1e-30
# Pairs of pixel and Gaussian per chunk: 8 MB per array.
PAIRS = 1_000_000


@dataclass(frozen=True)
class Reference64:
    """N Gaussians seen by a camera, in float64.

    Attributes:
        raw: raw attributes by name, as returned by `Gaussians.numpy()`.
        camera: camera of the view; its intrinsics are rounded to float32, as in the renderer.
        config: `eps2d`, `alpha_min` and `alpha_max` are used, the other fields are ignored.
    """

    raw: Mapping[str, np.ndarray]
    camera: Camera
    config: RenderConfig

    def render(self, pixels: np.ndarray) -> np.ndarray:
        """Return colour and alpha [P, 4] at the pixels [P, 2] (column, row)."""
        splats, values, order = self._splats()
        return np.concatenate(
            [w @ values[order] for _, _, w, *_ in self._blended(splats, order, pixels)]
        )

    def gradients(self, pixels: np.ndarray, gradient: np.ndarray) -> dict[str, np.ndarray]:
        """Return dL/d(attribute) by name, given dL/d(colour, alpha) [P, 4] at the pixels [P, 2]."""
        splats, values, order = self._splats()
        N = len(values)
        to_splats = np.zeros((N, 6))
        to_values = np.zeros((N, 4))
        for chunk, distance, weights, light, alpha, free in self._blended(splats, order, pixels):
            g = gradient[chunk]
            product = g @ values[order].T  # <g, c_i>
            inner = weights * product
            light_behind = inner[:, ::-1].cumsum(axis=1)[:, ::-1] - inner
            # dL/dA times A.
            to_full = np.where(free, light * product - light_behind / (1 - alpha), 0) * alpha
            dx, dy = distance
            _, _, a, b, c, opacity = splats[order].T
            moments = (
                a * (to_full * dx).sum(0) + b * (to_full * dy).sum(0),
                b * (to_full * dx).sum(0) + c * (to_full * dy).sum(0),
                -0.5 * (to_full * dx * dx).sum(0),
                -(to_full * dx * dy).sum(0),
                -0.5 * (to_full * dy * dy).sum(0),
                to_full.sum(0) / opacity,
            )
            to_splats[order] += np.stack(moments, axis=1)
            to_values[order] += weights.T @ g
        return self._to_attributes(np.column_stack([to_splats, to_values[:, :3]]))

    def _splats(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return splats (mean, conic, opacity) [N, 6], values (colour, 1) [N, 4] and the drawn
        indices by depth.
        """
        numbers, depths = _project(self._float64(), self.camera, self.config.eps2d)
        order = np.argsort(depths, kind="stable")
        visible = (depths >= self.camera.near) & (numbers[:, 5] > self.config.alpha_min)
        values = np.column_stack([numbers[:, 6:], np.ones(len(numbers))])
        return numbers[:, :6], values, order[visible[order]]

    def _blended(
        self, splats: np.ndarray, order: np.ndarray, pixels: np.ndarray
    ) -> Iterator[tuple]:
        """Yield (chunk, (dx, dy), w, T, alpha, whether alpha is A) for one chunk of the pixels at a
        time.
        """
        mean_x, mean_y, a, b, c, opacity = splats[order].T
        rows = max(1, PAIRS // max(len(order), 1))
        for first in range(0, len(pixels), rows):
            chunk = slice(first, first + rows)
            dx = pixels[chunk, :1] + 0.5 - mean_x
            dy = pixels[chunk, 1:] + 0.5 - mean_y
            full = opacity * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
            visible = full >= self.config.alpha_min
            free = full <= self.config.alpha_max
            alpha = np.where(visible, np.minimum(full, self.config.alpha_max), 0)
            light = np.cumprod(np.column_stack([np.ones(len(alpha)), 1 - alpha]), axis=1)[:, :-1]
            yield chunk, (dx, dy), light * alpha, light, alpha, visible & free

    def _to_attributes(self, gradients: np.ndarray) -> dict[str, np.ndarray]:
        """Return the gradients of the attributes, given the ones of splats and colours [N, 9]."""
        raw = self._float64()
        grads = {}
        for name in _GEOMETRY:
            columns = raw[name].reshape(len(gradients), -1)
            grad = np.zeros(columns.shape)
            for k in range(columns.shape[1]):
                trial = columns.astype(np.complex128)
                trial[:, k] += 1j * _STEP
                numbers, _ = _project(
                    {**raw, name: trial.reshape(raw[name].shape)}, self.camera, self.config.eps2d
                )
                grad[:, k] = (np.imag(numbers) / _STEP * gradients).sum(axis=1)
            grads[name] = grad.reshape(raw[name].shape)
        positive = _project(raw, self.camera, self.config.eps2d)[0][:, 6:] > 0
        basis = _sh_basis(_directions(raw["means"], self.camera), raw["sh_coeffs"].shape[1])
        return grads | {"sh_coeffs": basis[:, :, None] * (positive * gradients[:, 6:])[:, None, :]}

    def _float64(self) -> dict[str, np.ndarray]:
        return {name: np.asarray(self.raw[name], np.float64) for name in ATTRIBUTES}


def _pose(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    view = np.asarray(camera.viewmat, np.float64)
    return view[:3, :3], view[:3, 3]


def _project(
    raw: Mapping[str, np.ndarray], camera: Camera, eps2d: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return (mean, conic, opacity, colour) [N, 9] of every Gaussian, real or complex, and depths
    [N].
    """
    R, t = _pose(camera)
    K = np.asarray(np.float32(camera.K), np.float64)
    x, y, z = (raw["means"] @ R.T + t).T
    depths = z.real
    z = np.where(depths >= camera.near, z, 1)  # Gaussians behind the camera only need finite values
    means2d = []
    jacobian = np.zeros((len(z), 2, 3), z.dtype)
    for axis, (slope, size) in enumerate(((x / z, camera.width), (y / z, camera.height))):
        f = K[axis, axis]
        c = K[axis, 2]
        low = -c / f - 0.15 * size / f
        high = (size - c) / f + 0.15 * size / f
        slope_in_view = np.where(slope.real < low, low, np.where(slope.real > high, high, slope))
        jacobian[:, axis, axis] = f / z
        jacobian[:, axis, 2] = -f * slope_in_view / z
        means2d.append(f * slope + c)
    axes = jacobian @ R @ _rotation(raw["quats"]) * np.exp(raw["log_scales"])[:, None, :]
    covariance = axes @ axes.transpose(0, 2, 1)
    xx = covariance[:, 0, 0] + eps2d
    xy = covariance[:, 0, 1]
    yy = covariance[:, 1, 1] + eps2d
    det = xx * yy - xy * xy
    opacity = 1 / (1 + np.exp(-raw["logit_opacities"]))
    basis = _sh_basis(_directions(raw["means"], camera), raw["sh_coeffs"].shape[1])
    color = 0.5 + np.einsum("nk,nkc->nc", basis, raw["sh_coeffs"])
    color = np.where(color.real > 0, color, 0)
    return np.column_stack([*means2d, yy / det, -xy / det, xx / det, opacity, color]), depths


def _directions(means: np.ndarray, camera: Camera) -> np.ndarray:
    """Return unit vectors [N, 3] from the camera to the means."""
    R, t = _pose(camera)
    direction = means + R.T @ t
    return direction / np.sqrt(np.sum(direction * direction, axis=1, keepdims=True))


def _rotation(quats: np.ndarray) -> np.ndarray:
    """Return the rotation matrices [N, 3, 3] of wxyz quaternions of any length but 0."""
    w, x, y, z = (quats / np.sqrt(np.sum(quats * quats, axis=1, keepdims=True))).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _sh_basis(directions: np.ndarray, K: int) -> np.ndarray:
    """Return the real spherical harmonics [N, K] of unit directions [N, 3] with 3DGS's signs."""
    x, y, z = directions.T
    xx = x * x
    yy = y * y
    zz = z * z
    basis = [SH_C0 + 0 * x]
    basis += [0.4886025119029199 * v for v in (-y, z, -x)]
    basis += [
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
    ]
    basis += [-1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy)]
    basis += [-0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z]
    basis += [
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
    ]
    basis += [-0.4570457994644658 * x * (4 * zz - xx - yy), 1.445305721320277 * z * (xx - yy)]
    basis += [-0.5900435899266435 * x * (xx - 3 * yy)]
    return np.stack(basis[:K], axis=1)
