"""The renderer beside the reference in extended precision, and the exact derivatives of the
reference.

The reference runs with 80-bit `longdouble` where the platform has it, because its textbook
determinant cancels for needles. Pixels where an alpha lies within `AMBIGUOUS` of a cut-off are
excluded: there, rounding decides what is drawn.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi import RenderConfig, rasterize
from morgs_mi.core.gaussians import tensor_rows
from tests import reference
from tests.scenes.derivatives import gradient
from tests.scenes.gaussians import CHANNELS

SIZES = {"color": 3, "motion": 2}
ATTRIBUTES = ("means", "scales", "quats", "opacities", "sh_coeffs", "motion", "confidence")
BACKGROUND = (0.2, 0.5, 0.9)
AMBIGUOUS = 1e-3  # relative distance of an alpha to a cut-off
# Practically no stop: gradients of opaque scenes are compared with the reference, which has none.
CONFIG = RenderConfig(stop_transmittance=1e-12)


class Activated:
    """Activated attributes, as the plugin passes them, without a logit or a logarithm."""

    def __init__(self, values):
        one = dr.opaque(mi.Float, 1)  # multiplying copies what Dr.Jit borrows from NumPy
        for name in ATTRIBUTES:
            setattr(self, name, mi.TensorXf(np.ascontiguousarray(values[name], np.float32)) * one)
        self.tensors = [getattr(self, name) for name in ATTRIBUTES]
        dr.enable_grad(*self.tensors)

    def rows(self, name, index):
        return tensor_rows(getattr(self, name), index)

    def gradients(self):
        return {name: gradient(getattr(self, name)) for name in ATTRIBUTES}


def exact_image(values, camera, alpha_min=1 / 255, alpha_max=0.99, viewmat=None):
    """Return the reference's channels of activated attributes."""
    with np.errstate(all="ignore"):

        def logit(x):  # infinite at 1; 60 has the same sigmoid
            return np.where(x == 1, 60, np.log(x / np.where(x == 1, 1, 1 - x)))

        zero = (values["quats"] == 0).all(axis=1, keepdims=True)
        raw = {
            "means": values["means"],
            "log_scales": np.log(values["scales"]),
            "quats": np.where(zero, np.array([1, 0, 0, 0]), values["quats"]),
            "logit_opacities": logit(values["opacities"]),
            "sh_coeffs": values["sh_coeffs"],
            "motion": values["motion"],
            "logit_confidence": logit(values["confidence"]),
        }
        return reference.rasterize(
            raw,
            np.float32(camera.K).astype(np.longdouble),
            np.asarray(camera.viewmat).astype(np.longdouble) if viewmat is None else viewmat,
            camera.width,
            camera.height,
            BACKGROUND,
            near=float(np.float32(camera.near)),
            alpha_min=alpha_min,
            alpha_max=alpha_max,
        )


def clear_pixels(values, camera):
    """Return the mask of the pixels [H, W] where no alpha is near a cut-off, found by moving the
    cut-offs.
    """
    low, high = (
        exact_image(values, camera, alpha_min=(1 + s * AMBIGUOUS) / 255)["alpha"][..., 0]
        for s in (-1, 1)
    )
    under, at, over = (
        exact_image(values, camera, alpha_max=0.99 * (1 + s * 1e-4))["alpha"][..., 0]
        for s in (-1, 0, 1)
    )
    return (low == high) & (np.abs(under - 2 * at + over) < 1e-6)


def weights(expected, clear, seed=1):
    """Return random weights per channel, relative to its scale, for a loss of all channels."""
    rng = np.random.default_rng(seed)
    solid = clear & (expected["alpha"][..., 0] > 0.02)
    result = {}
    for name in CHANNELS:
        mask = solid if name in ("depth", "motion") else clear
        scale = max(1e-30, float(np.abs(expected[name]).max()))
        result[name] = np.float32(
            rng.normal(size=(*clear.shape, SIZES.get(name, 1))) * mask[..., None] / scale
        )
    return result


def exact_gradients(values, camera, weight):
    """Return gradients by complex steps relative to each number: none from 1e-30 to 1e30 loses its
    imaginary part.
    """
    grads = {}
    for name in ATTRIBUTES:
        grad = np.zeros(values[name].shape)
        for index in np.ndindex(*grad.shape):
            nudged = values[name].astype(np.clongdouble)
            step = np.longdouble(1e-30) * (np.abs(values[name][index]) or 1)
            nudged[index] += 1j * step
            image = exact_image({**values, name: nudged}, camera)
            grad[index] = sum(np.sum(image[c].imag * weight[c]) for c in CHANNELS) / step
        grads[name] = grad
    return grads


def exact_slope(values, camera, weight, name, along):
    """Return the derivative of the weighted channels along a direction of one attribute."""
    image = exact_image(
        {**values, name: values[name].astype(np.clongdouble) + 1e-30j * along}, camera
    )
    return float(sum(np.sum(image[c].imag * weight[c]) for c in CHANNELS) / 1e-30)


def run(values, camera, weight=None, config=CONFIG):
    """Return the channels and the gradients of the sum of the weighted channels; all must be
    finite.
    """
    gaussians = Activated(values)
    image = rasterize(gaussians, camera, CHANNELS, BACKGROUND, config=config)
    channels = {name: np.asarray(dr.detach(image[name]), np.float64) for name in CHANNELS}
    if weight is None:
        weight = weights(channels, np.ones((camera.height, camera.width), bool))
    dr.backward(
        sum(dr.sum(image[name] * mi.TensorXf(weight[name]), axis=None) for name in CHANNELS)
    )
    grads = gaussians.gradients()
    for name, value in (*channels.items(), *grads.items()):
        assert np.isfinite(value).all(), (
            f"{name} is not finite at {np.argwhere(~np.isfinite(value))[:5].tolist()}"
        )
    return channels, grads


def errors(case):
    """Return the errors of the image and of each attribute's gradient against the reference."""
    values = case.values
    camera = case.camera
    expected = exact_image(values, camera)
    weight = weights(expected, clear_pixels(values, camera))
    image, grads = run(values, camera, weight)
    result = {"image": 0.0}
    for name in CHANNELS:
        error = np.abs(image[name] - expected[name])[weight[name] != 0] / max(
            1.0, np.abs(expected[name]).max()
        )
        result["image"] = max(result["image"], float(error.max(initial=0)))
    # Per relative change, as for an optimiser of logarithms.
    unit = {"scales": values["scales"], "opacities": values["opacities"]}
    unit["quats"] = np.linalg.norm(values["quats"], axis=1, keepdims=True)
    if case.every_entry:
        exact = {n: g * unit.get(n, 1) for n, g in exact_gradients(values, camera, weight).items()}
        grads = {n: g * unit.get(n, 1) for n, g in grads.items()}
    else:
        along = {n: np.sign(g) for n, g in grads.items()}
        exact = {
            n: exact_slope(values, camera, weight, n, v * unit.get(n, 1)) for n, v in along.items()
        }
        grads = {n: np.abs(g * unit.get(n, 1)).sum() for n, g in grads.items()}
    # These three are sums of the same terms: one that almost vanishes is compared relative to the
    # largest.
    floor = 0.01 * max(np.abs(exact[name]).max() for name in unit)
    for name in ATTRIBUTES:
        scale = max(np.abs(exact[name]).max(), floor if name in unit else 0, 1e-30)
        result[name] = float(np.abs(grads[name] - exact[name]).max() / scale)
    return result
