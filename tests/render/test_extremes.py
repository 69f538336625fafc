"""The renderer at the extremes: every case against the reference implementation, or finite within a stated bound.

The reference runs in extended precision here (80-bit `longdouble` where the platform has it), because its textbook
determinant cancels for needles. Pixels where an alpha lies within `AMBIGUOUS` of a cut-off are excluded: there,
rounding decides what is drawn. Gradients are compared by attribute, relative to the largest entry: those of scales,
quaternions and opacities per relative change, as for an optimiser of logarithms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import Camera, Gaussians, RenderConfig, rasterize
from morgs_mi.core.gaussians import tensor_rows
from tests import reference
from tests import tolerances as tol
from tests.assertions import assert_close
from tests.scenes.gaussians import CHANNELS, Values

SIZES = {"color": 3, "motion": 2}
ATTRIBUTES = ("means", "scales", "quats", "opacities", "sh_coeffs", "motion", "confidence")
BACKGROUND = (0.2, 0.5, 0.9)
AMBIGUOUS = 1e-3  # relative distance of an alpha to a cut-off
# Practically no stop, so that gradients of opaque scenes can be compared with the reference, which has none.
CONFIG = RenderConfig(stop_transmittance=1e-12)


class Activated:
    """Activated attributes, as the plugin passes them, without a logit or a logarithm."""

    def __init__(self, values: Values) -> None:
        one = dr.opaque(mi.Float, 1)  # multiplying copies what Dr.Jit borrows from NumPy
        for name in ATTRIBUTES:
            setattr(self, name, mi.TensorXf(np.ascontiguousarray(values[name], np.float32)) * one)
        self.tensors = [getattr(self, name) for name in ATTRIBUTES]
        dr.enable_grad(*self.tensors)

    def rows(self, name: str, index: Any) -> list[Any]:
        return tensor_rows(getattr(self, name), index)

    def gradients(self) -> Values:
        return {name: np.asarray(dr.grad(getattr(self, name)), np.float64) for name in ATTRIBUTES}


# --------------------------------------------------------------------------------------------------
#  The reference in extended precision
# --------------------------------------------------------------------------------------------------


def exact_image(
    values: dict[str, Any], camera: Camera, alpha_min: float = 1 / 255, alpha_max: float = 0.99, viewmat: Any = None
) -> dict[str, Any]:
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


def clear_pixels(values: Values, camera: Camera) -> np.ndarray:
    """Return the mask of the pixels [H, W] where no alpha is near a cut-off, found by moving the cut-offs."""
    low, high = (exact_image(values, camera, alpha_min=(1 + s * AMBIGUOUS) / 255)["alpha"][..., 0] for s in (-1, 1))
    under, at, over = (
        exact_image(values, camera, alpha_max=0.99 * (1 + s * 1e-4))["alpha"][..., 0] for s in (-1, 0, 1)
    )
    return (low == high) & (np.abs(under - 2 * at + over) < 1e-6)


def weights(expected: dict[str, np.ndarray], clear: np.ndarray, seed: int = 1) -> dict[str, np.ndarray]:
    """Return random weights per channel, relative to its scale, for a loss of all channels."""
    rng = np.random.default_rng(seed)
    solid = clear & (expected["alpha"][..., 0] > 0.02)
    result = {}
    for name in CHANNELS:
        mask = solid if name in ("depth", "motion") else clear
        scale = max(1e-30, float(np.abs(expected[name]).max()))
        result[name] = np.float32(rng.normal(size=(*clear.shape, SIZES.get(name, 1))) * mask[..., None] / scale)
    return result


def exact_gradients(values: Values, camera: Camera, weight: dict[str, np.ndarray]) -> Values:
    """Return gradients by complex steps relative to each number: none from 1e-30 to 1e30 loses its imaginary part."""
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


def exact_slope(values: Values, camera: Camera, weight: dict[str, np.ndarray], name: str, along: np.ndarray) -> float:
    """Return the derivative of the weighted channels along a direction of one attribute."""
    image = exact_image({**values, name: values[name].astype(np.clongdouble) + 1e-30j * along}, camera)
    return float(sum(np.sum(image[c].imag * weight[c]) for c in CHANNELS) / 1e-30)


# --------------------------------------------------------------------------------------------------
#  Cases
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """A scene, a view, and the tolerances of the image and the gradients against the reference."""

    name: str
    values: Values
    camera: Camera
    image: float = tol.IMAGE_ABS
    gradient: float = tol.GRADIENT_REL
    every_entry: bool = True  # if False, only each attribute's gradient along the direction of its signs


def cloud(n: int = 6, seed: int = 5) -> Values:
    """Return activated attributes of a cloud at the origin, degree 1."""
    rng = np.random.default_rng(seed)
    return {
        "means": rng.uniform((-1.0, -0.8, -0.5), (1.0, 0.8, 0.5), (n, 3)),
        "scales": np.exp(rng.uniform(np.log(0.1), np.log(0.4), (n, 3))),
        "quats": rng.normal(size=(n, 4)) * rng.uniform(0.5, 2, (n, 1)),
        "opacities": rng.uniform(0.2, 0.8, n),
        "sh_coeffs": rng.normal(size=(n, 4, 3)) * 0.3 + 0.2,
        "motion": rng.normal(size=(n, 3)) * 0.1,
        "confidence": rng.uniform(0.1, 0.9, n),
    }


def eye(
    width: int = 21,
    height: int = 18,
    fov: float = 45.0,
    origin: Any = (0.3, -0.4, -3.0),
    up: Any = (0, -1, 0),
    shift: tuple[float, float] = (1.3, -0.7),
    near: float = 0.01,
    viewmat: Any = None,
) -> Camera:
    """Return a camera that sees the origin, whose size no block divides, with fx != fy and off-centre cx, cy."""
    camera = Camera.look_at(origin, np.zeros(3), up, fov, width, height)
    K = camera.K + np.array([[0, 0, shift[0]], [0, 0.08 * camera.K[0, 0], shift[1]], [0, 0, 0]])
    viewmat = camera.viewmat if viewmat is None else viewmat
    return Camera(K, np.float32(viewmat).astype(np.float64), width, height, near=near)


def case(
    name: str, camera: Camera | None = None, n: int = 6, bounds: dict[str, Any] | None = None, **change: Any
) -> Case:
    """Return the case of the cloud with some attributes replaced, or changed by a function."""
    values = cloud(n)
    for key, new in change.items():
        values[key] = new(values[key]) if callable(new) else np.broadcast_to(np.asarray(new, float), values[key].shape)
    values = {key: np.float32(value).astype(np.float64) for key, value in values.items()}
    return Case(name, values, camera or eye(), **(bounds or {}))


def screen_bound(pixels: float) -> dict[str, float]:
    """Return the bounds where screen coordinates are as large as `pixels`, given the spacing of float32 there."""
    return {
        "image": tol.IMAGE_ABS + tol.ALPHA_PER_PIXEL * 2**-24 * pixels,
        "gradient": tol.GRADIENT_REL + tol.ALPHA_SLOPE_PER_PIXEL * 2**-24 * pixels,
    }


def scaled(factor: float) -> dict[str, Callable]:
    return {name: lambda v: v * factor for name in ("means", "scales", "motion")}


def moved(*by: float) -> Callable:
    return lambda means: means + np.array(by)


NEAR = float(np.float32(0.01))
BELOW, ABOVE = (float(np.nextafter(np.float32(NEAR), np.float32(x))) for x in (0, 1))
AT_NEAR_PLANE = [[1e-3, 0, NEAR], [1e-3, -1e-3, BELOW], [-1e-3, 1e-3, ABOVE], [0, 0, 0], [0, 0, -3], [1, 1, 0.02]]
GRAZING = [[5, 0, 0.011], [0, 5, 0.02], [1e3, 1e3, 0.01], [1e-3, 0, 0.5], [1e17, 0, 1], [1, 1, 1e17]]
GRAZING_SCALES = [[0.2, 0.1, 0.3]] * 4 + [[1e16, 2e16, 1e16], [1e16, 1e17, 1e17]]
ALONG_VIEW = np.linalg.qr(np.c_[[-0.3, 0.4, 3.0], np.eye(3)[:, :2]])[0]
MIRROR, ORIGIN = np.diag([-1.0, 1, 1, 1]), eye(viewmat=np.eye(4))
FAR = np.array([1e5, -1e5, 1e5])
LIFT = np.eye(4)
LIFT[:3, 3] = -FAR
BLOCKS = np.stack(np.meshgrid(np.arange(8) * 8 + 4.0, np.arange(8) * 4 + 2.0), -1).reshape(-1, 2)
SLOW_REFERENCE = {"every_entry": False}

# Errors reached on a 2-core x86, 80-bit reference: image at most 6e-6, gradients at most 2e-5 (4e-5 for needles across
# the screen), unless a comment states more. Limits: an aspect beyond 1e6 is drawn at 1e6, because a float32 rotation is
# no more precise; beyond 1e18 units nothing is drawn; depths that a float32 cannot distinguish are equal.
CASES = [
    case("plain"),
    case("one Gaussian", n=1),
    case("two Gaussians", n=2),
    case("needles", scales=(1, 1e-4, 1e-4)),
    case("needles across the screen", scales=(100, 1e-2, 1e-2)),
    case("needles of 250,000 px", scales=(1e4, 1, 1)),
    case("needles along the axis", scales=(1e-4, 1e-4, 1), means=lambda m: m * 0.05, quats=(1, 0.0656, 0.0495, 0)),
    case("discs", scales=(1, 1, 1e-4)),
    case("discs across the screen", scales=(100, 100, 1e-2)),
    case("sub-pixel splats", scales=(1e-6, 2e-6, 3e-6)),
    case("screen-filling splats", scales=(50, 70, 90)),
    case("scales 0", scales=0),
    case("scales 1e-38", scales=1e-38),
    case("scales 1e6", scales=(1e6, 2e6, 3e6)),
    case("scales 1e12", scales=(1e12, 2e12, 3e12)),
    case("scales 3e38", scales=3e38),
    case("on the near plane", ORIGIN, means=AT_NEAR_PLANE, scales=(0.002, 0.001, 0.003)),
    case("big, on the near plane", ORIGIN, means=AT_NEAR_PLANE, scales=(0.2, 0.1, 0.3)),
    case("grazing the near plane, and at 1e17 units", ORIGIN, means=GRAZING, scales=GRAZING_SCALES),
    case("all behind", ORIGIN, means=moved(0, 0, -5)),
    case("1e-3 units", eye(origin=(3e-4, -4e-4, -3e-3), near=1e-5), **scaled(1e-3)),
    case("1e6 units", eye(origin=(3e5, -4e5, -3e6), near=1e4), **scaled(1e6)),
    # Means there are multiples of 2^-7; no further precision is lost, because poses are summed in double.
    case("offset by 1e5", eye(viewmat=eye().viewmat @ LIFT), means=moved(*FAR)),
    case("opacities 0, 1 and near", opacities=[0, 1, 1e-7, 1 - 2**-23, 0.99, 0.004]),
    case("opacities 1", opacities=1),
    case("opacities 0", opacities=0),
    case("equal depths", ORIGIN, means=lambda m: m * (0.5, 0.5, 0) + (0, 0, 2), opacities=0.9),
    case("some quaternions 0", quats=lambda q: q * np.array([[0], [1], [0], [1], [1], [1]])),
    case("quaternions 1e-25", quats=lambda q: q * 1e-25),
    case("quaternions 1e33", quats=lambda q: q * 1e33),
    # Their gradients of 1e-38 underflow float32 to zero.
    case("quaternions 1e38", quats=lambda q: np.clip(q, -3, 3) * 1e38, bounds={"gradient": 1.0}),
    case("colours 1e6 and 1e-6", sh_coeffs=lambda c: c * np.array([1e6, 1, 1e-6, 1, -1e6, 1])[:, None, None]),
    case("colours 1e15", sh_coeffs=lambda c: c * 1e15),
    case("image 1x1", eye(1, 1)),
    case("image 33x1", eye(33, 1)),
    case("image 1x65", eye(1, 65)),
    case("image 4096x1", eye(4096, 1, shift=(1.3, 0)), bounds=SLOW_REFERENCE),
    case("image 1x4096", eye(1, 4096, fov=0.02, shift=(0, 0)), bounds=SLOW_REFERENCE),
    case(
        "one Gaussian in every block",
        Camera(np.array([[40.0, 0, 32], [0, 40, 16], [0, 0, 1]]), np.eye(4), 64, 32),
        n=64,
        means=np.c_[(BLOCKS - (32, 16)) / 40 * 3, np.full(64, 3.0)],
        scales=(0.04, 0.06, 0.05),
        bounds=SLOW_REFERENCE,
    ),
    case("camera rolled", eye(up=(0.6, -0.3, 0.1))),
    case("camera upside down", eye(up=(0, 1, 0))),
    case("camera mirrored", eye(viewmat=MIRROR @ eye().viewmat)),
    case("principal point outside", eye(viewmat=np.eye(4), shift=(-200, 150)), means=moved(23.7, -16.4, 3)),
    # Reached: image 1.4e-4, gradients 3e-4. fx x / z + cx cancels; double precision there is not worth its cost.
    case(
        "principal point far outside",
        eye(viewmat=np.eye(4), shift=(-2e4, 1e4)),
        means=moved(2367, -1096, 3),
        bounds=screen_bound(2e4),
    ),
    case("lens of 0.01 degrees", eye(fov=0.01, origin=(1e3, 2e3, -1e4))),
    case("lens of 179.9 degrees", eye(fov=179.9, origin=(0.1, 0.1, -0.5))),
]


# --------------------------------------------------------------------------------------------------
#  Comparison
# --------------------------------------------------------------------------------------------------


def run(
    values: Values, camera: Camera, weight: dict[str, np.ndarray] | None = None, config: RenderConfig = CONFIG
) -> tuple[Values, Values]:
    """Return the channels and the gradients of the sum of the weighted channels; all must be finite."""
    gaussians = Activated(values)
    image = rasterize(gaussians, camera, CHANNELS, BACKGROUND, config=config)
    found = {name: np.asarray(dr.detach(image[name]), np.float64) for name in CHANNELS}
    if weight is None:
        weight = weights(found, np.ones((camera.height, camera.width), bool))
    dr.backward(sum(dr.sum(image[name] * mi.TensorXf(weight[name]), axis=None) for name in CHANNELS))
    grads = gaussians.gradients()
    for name, value in (*found.items(), *grads.items()):
        assert np.isfinite(value).all(), f"{name} is not finite at {np.argwhere(~np.isfinite(value))[:5].tolist()}"
    return found, grads


def errors(case: Case) -> dict[str, float]:
    """Return the errors of the image and of each attribute's gradient against the reference."""
    values, camera = case.values, case.camera
    expected = exact_image(values, camera)
    weight = weights(expected, clear_pixels(values, camera))
    found, grads = run(values, camera, weight)
    result = {"image": 0.0}
    for name in CHANNELS:
        error = np.abs(found[name] - expected[name])[weight[name] != 0] / max(1.0, np.abs(expected[name]).max())
        result["image"] = max(result["image"], float(error.max(initial=0)))
    # Per relative change, as for an optimiser of logarithms.
    unit = {"scales": values["scales"], "opacities": values["opacities"]}
    unit["quats"] = np.linalg.norm(values["quats"], axis=1, keepdims=True)
    if case.every_entry:
        exact = {n: g * unit.get(n, 1) for n, g in exact_gradients(values, camera, weight).items()}
        grads = {n: g * unit.get(n, 1) for n, g in grads.items()}
    else:
        along = {n: np.sign(g) for n, g in grads.items()}
        exact = {n: exact_slope(values, camera, weight, n, v * unit.get(n, 1)) for n, v in along.items()}
        grads = {n: np.abs(g * unit.get(n, 1)).sum() for n, g in grads.items()}
    # These three are sums of the same terms: one that almost vanishes is compared relative to the largest.
    floor = 0.01 * max(np.abs(exact[name]).max() for name in unit)
    for name in ATTRIBUTES:
        scale = max(np.abs(exact[name]).max(), floor if name in unit else 0, 1e-30)
        result[name] = float(np.abs(grads[name] - exact[name]).max() / scale)
    return result


def failures(case: Case) -> list[str]:
    """Return the failed comparisons of a case, empty if all pass."""
    try:
        found = errors(case)
    except (AssertionError, ValueError) as error:
        return [f"{case.name}: {error}"]
    bounds = {name: case.image if name == "image" else case.gradient for name in found}
    return [
        f"{case.name}: {name} off by {e:.1e}, bound {bounds[name]:.1e}"
        for name, e in found.items()
        if not e < bounds[name]
    ]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_rasterize__agrees_with_the_reference_at_the_extremes(case):
    assert not failures(case)


def test_rasterize__forward_and_reverse_mode_are_dual_at_the_extremes():
    """<g, J v> = <J' g, v> along the signs of J' g, where nothing cancels."""
    failed = []
    for case in CASES:
        weight = weights(exact_image(case.values, case.camera), np.ones((case.camera.height, case.camera.width), bool))
        _, grads = run(case.values, case.camera, weight)
        gaussians = Activated(case.values)
        image = rasterize(gaussians, case.camera, CHANNELS, BACKGROUND, config=CONFIG)
        for name in ATTRIBUTES:
            # Steps as long as the attribute: a unit step of a scale of 1e-38 would overflow.
            step = np.sign(grads[name]) * np.minimum(np.abs(case.values[name]), 1e6)
            dr.set_grad(getattr(gaussians, name), mi.TensorXf(np.float32(step)))
            grads[name] = np.vdot(grads[name], step)
        outputs = [image[name] for name in CHANNELS]
        dr.forward_to(outputs)
        tangents = [np.asarray(dr.grad(output), np.float64) for output in outputs]
        forward = sum(np.vdot(t, weight[name]) for t, name in zip(tangents, CHANNELS, strict=True))
        reverse = sum(grads.values())
        if not abs(forward - reverse) <= tol.DUALITY_REL * abs(reverse):
            failed.append(f"{case.name}: forward {forward:.7g}, reverse {reverse:.7g}")
    assert not failed


def test_rasterize__gradients_of_the_pose_at_the_extremes():
    """Columns are compared separately: rotating a world at 1e5 units moves it 1e5 times as far as translating it."""
    failed = []
    for case in CASES:
        camera, exact = case.camera, np.zeros((3, 4))
        posed = Camera(camera.K, mi.TensorXf(np.float32(camera.viewmat)), camera.width, camera.height, near=camera.near)
        dr.enable_grad(posed.viewmat)
        weight = weights(exact_image(case.values, camera), clear_pixels(case.values, camera))
        run(case.values, posed, weight)
        found = np.asarray(dr.grad(posed.viewmat), np.float64)[:3]
        for index in np.ndindex(*exact.shape):
            nudged = camera.viewmat.astype(np.clongdouble)
            nudged[index] += 1e-30j
            image = exact_image(case.values, camera, viewmat=nudged)
            exact[index] = sum(np.sum(image[c].imag * weight[c]) for c in CHANNELS) / 1e-30
        off = np.abs(found - exact).max(axis=0) / np.maximum(np.abs(exact).max(axis=0), 1e-30)
        if not (off <= case.gradient).all():
            failed.append(f"{case.name}: columns off by {off}, bound {case.gradient:.1e}")
    assert not failed, "\n".join(failed)


# --------------------------------------------------------------------------------------------------
#  Many Gaussians
# --------------------------------------------------------------------------------------------------


def stack(n: int, opacity: float) -> Values:
    """Return n Gaussians of various colours behind each other, in front of a camera at the origin."""
    values = cloud(n)
    values |= {"means": np.c_[np.zeros((n, 2)), np.linspace(1, 2, n)], "opacities": np.full(n, opacity)}
    values["sh_coeffs"] = np.clip(values["sh_coeffs"], -0.4, 0.4)
    return {name: np.float32(value).astype(np.float64) for name, value in values.items()}


@pytest.mark.parametrize("opacity", [1.0, 0.99, 0.02])
def test_rasterize__blends_ten_thousand_layers_on_one_pixel(opacity):
    values, camera = stack(10_000, opacity), Camera(np.array([[9.0, 0, 0.5], [0, 9, 0.5], [0, 0, 1]]), np.eye(4), 1, 1)
    expected = exact_image(values, camera)
    for config in (CONFIG, RenderConfig()):
        found, grads = run(values, camera, config=config)
        hidden = config.stop_transmittance if config is not CONFIG else 0
        for name in CHANNELS:
            bound = (tol.IMAGE_ABS + 2 * hidden) * max(1, np.abs(expected[name]).max())
            assert_close(found[name], np.float64(expected[name]), atol=bound, name=name)
        if opacity > 0.9:
            assert np.abs(grads["sh_coeffs"][8:]).max() < 1e-12, "occluded Gaussians have no gradient"


def test_rasterize__blends_many_equal_depths_in_the_order_of_the_input():
    """Of 300 layers at one depth, the first in the input is the nearest; in reversed order, the last is."""
    values = stack(300, 0.3)
    values["means"][:, 2] = 1.5
    camera = Camera(np.array([[9.0, 0, 3], [0, 9, 2.5], [0, 0, 1]]), np.eye(4), 6, 5)
    images = []
    for order in (slice(None), slice(None, None, -1)):
        ordered = {name: np.ascontiguousarray(value[order]) for name, value in values.items()}
        images.append(run(ordered, camera)[0]["color"])
        assert_close(images[-1], np.float64(exact_image(ordered, camera)["color"]), atol=tol.IMAGE_ABS)
    assert np.abs(images[0] - images[1]).max() > 0.05


@pytest.mark.slow
def test_rasterize__two_million_gaussians_mostly_out_of_view():
    """All but 1,000 are out of view: the image is that of the 1,000, and their gradients are complete and finite."""
    N, in_view = 2_000_000, 1_000
    rng = np.random.default_rng(0)
    values = {name: np.repeat(value, N // 1000, axis=0) for name, value in cloud(1000).items()}
    values["means"] += rng.normal(size=(N, 3)) * 0.3
    values["scales"] *= 0.05
    where = np.sort(rng.choice(N, in_view, replace=False))
    away = np.ones(N, bool)
    away[where] = False
    values["means"][away] = values["means"][away] * 100 - (0, 0, 1e4)
    camera = eye(640, 480)
    found, grads = run(values, camera)
    few, few_grads = run({name: value[where] for name, value in values.items()}, camera)
    for name in CHANNELS:
        assert_close(found[name], few[name], name=name)
    for name in ATTRIBUTES:
        assert_close(grads[name][where], few_grads[name], rtol=1e-5, name=name)
        assert np.abs(grads[name][away]).max() == 0, name


@pytest.mark.slow
def test_rasterize__two_million_gaussians_in_view():
    values = {name: np.repeat(value, 2000, axis=0) for name, value in cloud(1000).items()}
    values["means"] += np.random.default_rng(0).normal(size=values["means"].shape) * 0.3
    values["scales"] *= 0.02
    found, grads = run(values, eye(640, 480))
    assert found["alpha"].max() > 0.999
    assert np.abs(grads["means"]).max() > 0


def test_rasterize__refuses_lists_that_exceed_32_bits():
    """2^12 x 2^12 pixels are 2^14 tiles, and entries are counted in 32 bits."""
    camera = Camera(np.array([[1e4, 0, 2048], [0, 1e4, 2048], [0, 0, 1]]), np.eye(4), 2**12, 2**12)
    values = stack(2**18 + 1, 0.5) | {"scales": np.full((2**18 + 1, 3), 1e3)}
    with pytest.raises(ValueError, match=r"fewer than 2\^32 entries, got 4\.29e\+09 for 262145 Gaussians"):
        rasterize(Activated(values), camera, CHANNELS, BACKGROUND, config=CONFIG)


# --------------------------------------------------------------------------------------------------
#  Raw attributes: activations of extreme values
# --------------------------------------------------------------------------------------------------


def raw_gaussians(**change: Any) -> Gaussians:
    values = cloud()
    raw = {name: values[name] for name in ("means", "quats", "sh_coeffs", "motion")}
    raw |= {"log_scales": np.log(values["scales"]), "logit_opacities": np.zeros(6), "logit_confidence": np.zeros(6)}
    gaussians = Gaussians(**(raw | change))
    dr.enable_grad(*gaussians.items().values())
    return gaussians


@pytest.mark.parametrize(
    "change",
    [
        {"log_scales": np.array([-200.0, -100, -50, 0, 50, 88])[:, None] * np.ones(3)},
        {"log_scales": np.array([88.0, -200, 0]) * np.ones((6, 1))},
        {"logit_opacities": np.array([-1e38, -100, -17, 17, 100, 1e38])},
        {"logit_confidence": np.array([-1e38, -100, -17, 17, 100, 1e38])},
        {"means": np.array([1e30, -3e38, 1e19, 0, 1e-30, 3e38])[:, None] * np.ones(3)},
        {"sh_coeffs": np.full((6, 4, 3), -3e37)},
    ],
    ids=["scales", "needles", "opacities", "confidence", "means", "colours"],
)
def test_rasterize__raw_extremes_stay_finite(change):
    gaussians = raw_gaussians(**change)
    image = rasterize(gaussians, eye(), CHANNELS, BACKGROUND, config=CONFIG)
    for name in CHANNELS:
        assert np.isfinite(np.asarray(image[name])).all(), name
    dr.backward(sum(dr.mean(image[name], axis=None) for name in CHANNELS))
    for name, value in gaussians.items().items():
        assert np.isfinite(np.asarray(dr.grad(value))).all(), name


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"log_scales": np.full((6, 3), 100.0)}, r"`scales` must be finite, got inf at \[0, 0\]"),
        ({"means": np.full((6, 3), [0, 0, -np.inf])}, r"`means` must be finite, got -inf at \[0, 2\]"),
        ({"means": np.full((6, 3), [0, 0, -10.0]), "quats": np.full((6, 4), np.nan)}, "`quats` must be finite"),
        ({"quats": np.full((6, 4), [0, 0, 0, np.nan])}, r"`quats` must be finite, got nan at \[0, 3\]"),
    ],
    ids=["overflow", "infinite mean", "behind the camera", "one component"],
)
def test_rasterize__refuses_non_finite_attributes_anywhere(change, message):
    with pytest.raises(ValueError, match=message):
        rasterize(raw_gaussians(**change), eye(), CHANNELS, BACKGROUND, config=CONFIG)


# --------------------------------------------------------------------------------------------------
#  Fuzz
# --------------------------------------------------------------------------------------------------


def random_case(seed: int) -> Case:
    """Return a random mixture of the cases in the table."""
    rng = np.random.default_rng(seed)
    n, unit = int(rng.integers(1, 7)), 10 ** rng.uniform(-3, 6)
    values = cloud(n, seed)
    values["means"] *= 10 ** rng.uniform(-2, 0.5)
    values["motion"] *= 10 ** rng.uniform(-3, 3)
    values["scales"] *= 10 ** (rng.uniform(-1, 1, (n, 3)) * rng.choice([0.1, 1, 2, 4]))
    values["quats"] *= 10 ** rng.uniform(-15, 15, (n, 1)) * (rng.random((n, 1)) > 0.1)
    values["sh_coeffs"] *= 10 ** (rng.uniform(-2, 2, (n, 1, 1)) * rng.choice([0, 1, 2]))
    ends = rng.choice([0, 1, 1e-7, 1 - 2**-23, 0.99, 1 / 255], n)
    values["opacities"] = np.where(rng.random(n) < 0.3, ends, rng.uniform(0, 1, n))

    fov = rng.choice([45, 45, 10 ** rng.uniform(-2, 1), rng.uniform(90, 179.5)])
    distance = min(1.5 / np.tan(np.deg2rad(fov / 2)), 1e4) + rng.choice([0, 0.5, 3])
    direction = rng.normal(size=3)
    width, height = rng.integers(1, 40, 2)
    shift = tuple(rng.normal(size=2) * width * rng.choice([0, 0.1, 1]))
    origin = unit * distance * direction / np.linalg.norm(direction)
    camera = eye(int(width), int(height), fov, origin, rng.normal(size=3), shift)
    lift = np.eye(4)
    lift[:3, 3] = unit * 10 ** rng.uniform(-2, 5) * rng.normal(size=3) * (rng.random() < 0.3)
    values["means"] = values["means"] * unit - lift[:3, 3]
    values["scales"], values["motion"] = values["scales"] * unit, values["motion"] * unit
    viewmat = np.float32(np.diag([rng.choice([-1, 1, 1, 1]), 1, 1, 1]) @ camera.viewmat @ lift).astype(np.float64)
    values = {name: np.float32(value).astype(np.float64) for name, value in values.items()}

    # A float32 can neither order closer ones nor decide on which side of the near plane they lie.
    depths, keep = np.unique(np.float32(values["means"] @ viewmat[2, :3] + viewmat[2, 3]), return_index=True)
    values = {name: value[keep] for name, value in values.items()}
    between = rng.choice((depths + np.append(depths[1:], 2 * depths[-1])) / 2)
    near = max(0.01 * unit, rng.choice([0, 0, between]))
    camera = Camera(camera.K, viewmat, camera.width, camera.height, near=float(near))
    # Needles whose end covers a pixel may have their centres 100 px away.
    return Case(f"seed {seed}", values, camera, screen_bound(100)["image"], tol.FUZZ_GRADIENT_REL)


def fuzz(seeds: range) -> list[str]:
    return [line for seed in seeds for line in failures(random_case(seed))]


def test_rasterize__fuzz():
    assert not fuzz(range(10))


@pytest.mark.slow
def test_rasterize__fuzz_with_many_seeds():
    assert not fuzz(range(10, 210))
