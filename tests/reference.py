"""Slow float64 reference implementations of the package's mathematics.

They loop over all Gaussians and pixels, without blocks, early stop or rounding tricks. All of them
are analytic in their floating-point inputs apart from the documented cut-offs, which depend on real
parts only. So `complex_step` returns derivatives that are exact to rounding.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

SH_C0 = 0.28209479177387814
SH_C1 = 0.4886025119029199
SH_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
SH_C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)


def sh_basis(d, degree):
    """Return the real spherical harmonics with 3DGS's signs, up to degree 3, of a unit direction
    [3].
    """
    x, y, z = d
    basis = [SH_C0 + 0 * x]
    if degree > 0:
        basis += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if degree > 1:
        basis += [
            SH_C2[0] * x * y,
            -SH_C2[0] * y * z,
            SH_C2[1] * (2 * z * z - x * x - y * y),
            -SH_C2[0] * x * z,
            SH_C2[2] * (x * x - y * y),
        ]
    if degree > 2:
        basis += [
            -SH_C3[0] * y * (3 * x * x - y * y),
            SH_C3[1] * x * y * z,
            -SH_C3[2] * y * (4 * z * z - x * x - y * y),
            SH_C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -SH_C3[2] * x * (4 * z * z - x * x - y * y),
            SH_C3[4] * z * (x * x - y * y),
            -SH_C3[0] * x * (x * x - 3 * y * y),
        ]
    return basis


def rotation(q):
    """Return the rotation matrix of a wxyz quaternion of any length."""
    w, x, y, z = q / np.sqrt(np.sum(q * q))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rasterize(
    raw,
    K,
    viewmat,
    width,
    height,
    background=None,
    near=0.01,
    eps2d=0.3,
    alpha_min=1 / 255,
    alpha_max=0.99,
    depth_limit=None,
    antialiased=False,
):
    """Blend raw Gaussian attributes (as `Gaussians.numpy()` returns them) over every pixel, nearest
    first.

    With a depth limit [H, W], only what lies in front of it.

    Returns all five channels [H, W, D], and `margin`: the smallest relative distance of any alpha
    to a cut-off.
    """
    means = raw["means"]
    quats = raw["quats"]
    scales = np.exp(raw["log_scales"])
    opacities = 1 / (1 + np.exp(-raw["logit_opacities"]))
    degree = int(np.sqrt(raw["sh_coeffs"].shape[1])) - 1
    dtype = np.result_type(
        np.float64, *(np.asarray(v).dtype for v in raw.values()), viewmat.dtype, K.dtype
    )
    R = viewmat[:3, :3]
    t = viewmat[:3, 3]
    fx = K[0, 0]
    fy = K[1, 1]
    cx = K[0, 2]
    cy = K[1, 2]
    eye = -R.T @ t

    gx, gy = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    transmittance = np.ones((height, width), dtype)
    sums = {"color": 3, "depth": 1, "motion": 2, "confidence": 1}
    sums = {name: np.zeros((height, width, size), dtype) for name, size in sums.items()}
    margin = np.inf
    cam = means @ R.T + t
    for i in np.argsort(cam[:, 2].real, kind="stable"):
        x, y, z = cam[i]
        if z.real < near or opacities[i].real <= alpha_min:
            continue

        def clamp(value, size, f, c):
            low = -c / f - 0.15 * size / f
            high = (size - c) / f + 0.15 * size / f
            return low if value.real < low else high if value.real > high else value

        tx = clamp(x / z, width, fx, cx)
        ty = clamp(y / z, height, fy, cy)
        J = np.array([[fx / z, 0, -fx * tx / z], [0, fy / z, -fy * ty / z]])
        M = J @ R @ rotation(quats[i]) @ np.diag(scales[i])
        cov = M @ M.T + eps2d * np.eye(2)
        det = cov[0, 0] * cov[1, 1] - cov[0, 1] ** 2
        dx = gx - (fx * x / z + cx)
        dy = gy - (fy * y / z + cy)
        sigma = 0.5 * (cov[1, 1] * dx * dx - 2 * cov[0, 1] * dx * dy + cov[0, 0] * dy * dy) / det
        faded = np.sqrt(np.linalg.det(M @ M.T) / det) if antialiased else 1
        full = opacities[i] * faded * np.exp(-sigma)
        drawn = full.real >= alpha_min
        capped = full.real > alpha_max
        margin = min(
            margin, np.abs(full.real / alpha_min - 1).min(), np.abs(full.real / alpha_max - 1).min()
        )
        alpha = np.where(drawn, np.where(capped, alpha_max, full), 0)
        if depth_limit is not None:
            # The joint covariance of the filtered splat and of its depth, conditioned on the pixel.
            M3 = np.vstack([M, (R @ rotation(quats[i]) @ np.diag(scales[i]))[2]])
            joint = M3 @ M3.T + eps2d * np.diag([1, 1, 0])
            slope = np.linalg.solve(joint[:2, :2], joint[:2, 2])
            sigma = np.sqrt(joint[2, 2] - slope @ joint[:2, 2])
            fraction = normal_cdf(
                (np.minimum(depth_limit, 1e6) - (z + slope[0] * dx + slope[1] * dy)) / sigma
            )
            alpha = 1 - (1 - alpha) ** fraction

        direction = means[i] - eye
        direction = direction / np.sqrt(np.sum(direction * direction))
        color = 0.5 + sum(
            B * raw["sh_coeffs"][i, k] for k, B in enumerate(sh_basis(direction, degree))
        )
        values = {"color": np.where(color.real > 0, color, 0), "depth": np.array([z])}
        if "motion" in raw:
            mx, my, mz = R @ raw["motion"][i]
            x0, y0, z0 = cam[i] - (mx, my, mz)
            if z0.real >= near:
                values["motion"] = np.array([fx * (x / z - x0 / z0), fy * (y / z - y0 / z0)])
            else:  # to first order
                values["motion"] = np.array(
                    [fx / z * (mx - x / z * mz), fy / z * (my - y / z * mz)]
                )
        if "logit_confidence" in raw:
            values["confidence"] = np.array([1 / (1 + np.exp(-raw["logit_confidence"][i]))])
        for name, value in values.items():
            sums[name] += (transmittance * alpha)[..., None] * value
        transmittance = transmittance * (1 - alpha)

    alpha = (1 - transmittance)[..., None]
    covered = alpha.real > 0
    for name in ("depth", "motion"):
        sums[name] = np.where(covered, sums[name] / np.where(covered, alpha, 1), 0)
    if background is not None:
        sums["color"] = sums["color"] + (1 - alpha) * np.asarray(background)
    return {**sums, "alpha": alpha, "margin": np.float64(margin)}


def normal_cdf(q):
    """Return the normal distribution function by Page's approximation (1977), which the renderer
    has too.
    """
    q = np.where(np.abs(q.real) < 6, q, 6 * np.sign(q.real))
    return 1 / (1 + np.exp(-2 * np.sqrt(2 / np.pi) * q * (1 + 0.044715 * q * q)))


def rasterize_view(raw, camera, background=None, viewmat=None, depth_limit=None, antialiased=False):
    """Return `rasterize` for a camera rounded to float32, as the renderer reads it; `viewmat`
    replaces its pose.
    """
    viewmat = np.float32(camera.viewmat).astype(np.float64) if viewmat is None else viewmat
    K = np.float32(camera.K).astype(np.float64)
    return rasterize(
        raw,
        K,
        viewmat,
        camera.width,
        camera.height,
        background,
        depth_limit=depth_limit,
        antialiased=antialiased,
    )


def complex_step(function, inputs, names, step=1e-30):
    """Return the gradient of a real-valued `function(inputs)` with respect to `inputs[name]`, exact
    to rounding.
    """
    grads = {}
    for name in names:
        value = inputs[name].astype(np.complex128)
        grad = np.zeros(value.shape)
        for index in np.ndindex(*value.shape):
            nudged = value.copy()
            nudged[index] += 1j * step
            grad[index] = function({**inputs, name: nudged}).imag / step
        grads[name] = grad
    return grads


def directional(function, inputs, direction, step=1e-30):
    """Return the derivative of `function(inputs)` along `direction`, exact to rounding; any output
    shape.
    """
    nudged = {k: v + 1j * step * direction[k] if k in direction else v for k, v in inputs.items()}
    return function(nudged).imag / step


def ssim_by_windows(image, truth):
    """SSIM of one channel in every window, as the paper writes it."""
    i = np.arange(-5, 6)
    w = np.exp(-(i[:, None] ** 2 + i**2) / (2 * 1.5**2))
    x, y = (sliding_window_view(each, (11, 11)) for each in (image, truth))

    def mean(values):
        return (values * w).sum((2, 3), keepdims=True) / w.sum()

    mx = mean(x)
    my = mean(y)
    covariance = mean((x - mx) * (y - my))
    variances = mean((x - mx) ** 2) + mean((y - my) ** 2)
    top = (2 * mx * my + 1e-4) * (2 * covariance + 9e-4)
    return (top / ((mx**2 + my**2 + 1e-4) * (variances + 9e-4)))[..., 0, 0]
