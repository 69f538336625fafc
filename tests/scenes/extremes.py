"""Scenes and views at the extremes of float32, each with its tolerances, and random mixtures of
them.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np

from morgs_mi import Camera, Gaussians, RenderConfig, rasterize
from morgs_mi.evaluate.accuracy import reference64
from tests import tolerances as tol
from tests.scenes.derivatives import backward
from tests.scenes.gaussians import Values


@dataclass(frozen=True)
class Case:
    """A scene, a view, and the tolerances of the image and the gradients against the reference."""

    name: str
    values: Values
    camera: Camera
    image: float = tol.IMAGE_ABS
    gradient: float = tol.GRADIENT_REL
    # If False, only each attribute's gradient along the direction of its signs.
    every_entry: bool = True


def cloud(n=6, seed=5):
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
    width=21,
    height=18,
    fov=45.0,
    origin=(0.3, -0.4, -3.0),
    up=(0, -1, 0),
    shift=(1.3, -0.7),
    near=0.01,
    viewmat=None,
):
    """Return a camera that sees the origin, of a size that no block divides, with fx != fy and
    off-centre cx, cy.
    """
    camera = Camera.look_at(origin, np.zeros(3), up, fov, width, height)
    K = camera.K + np.array([[0, 0, shift[0]], [0, 0.08 * camera.K[0, 0], shift[1]], [0, 0, 0]])
    viewmat = camera.viewmat if viewmat is None else viewmat
    return Camera(K, np.float32(viewmat).astype(np.float64), width, height, near=near)


def case(name, camera=None, n=6, bounds=None, **change):
    """Return the case of the cloud with some attributes replaced, or changed by a function."""
    values = cloud(n)
    for key, new in change.items():
        values[key] = (
            new(values[key])
            if callable(new)
            else np.broadcast_to(np.asarray(new, float), values[key].shape)
        )
    values = {key: np.float32(value).astype(np.float64) for key, value in values.items()}
    return Case(name, values, camera or eye(), **(bounds or {}))


def screen_bound(pixels):
    """Return the bounds where screen coordinates are as large as `pixels`, given the spacing of
    float32 there.
    """
    return {
        "image": tol.IMAGE_ABS + tol.ALPHA_PER_PIXEL * 2**-24 * pixels,
        "gradient": tol.GRADIENT_REL + tol.ALPHA_SLOPE_PER_PIXEL * 2**-24 * pixels,
    }


def scaled(factor):
    return {name: lambda v: v * factor for name in ("means", "scales", "motion")}


def moved(*by):
    return lambda means: means + np.array(by)


NEAR = float(np.float32(0.01))
BELOW, ABOVE = (float(np.nextafter(np.float32(NEAR), np.float32(x))) for x in (0, 1))
AT_NEAR_PLANE = [
    [1e-3, 0, NEAR],
    [1e-3, -1e-3, BELOW],
    [-1e-3, 1e-3, ABOVE],
    [0, 0, 0],
    [0, 0, -3],
    [1, 1, 0.02],
]
GRAZING = [
    [5, 0, 0.011],
    [0, 5, 0.02],
    [1e3, 1e3, 0.01],
    [1e-3, 0, 0.5],
    [1e17, 0, 1],
    [1, 1, 1e17],
]
GRAZING_SCALES = [[0.2, 0.1, 0.3]] * 4 + [[1e16, 2e16, 1e16], [1e16, 1e17, 1e17]]
ORIGIN = eye(viewmat=np.eye(4))
FAR = np.array([1e5, -1e5, 1e5])
LIFT = np.eye(4)
LIFT[:3, 3] = -FAR
BLOCKS = np.stack(np.meshgrid(np.arange(8) * 8 + 4.0, np.arange(8) * 4 + 2.0), -1).reshape(-1, 2)
# From behind the camera, from its near plane on, and from beyond the point where they are.
THROUGH = [[0, 0, 9], [0.1, 0, 3.5], [0, 0.2, 2.999], [0, 0, -40], [1, 1, 3e3], [0, 0, 0]]
SLOW_REFERENCE = {"every_entry": False}
STIFF_CAMERA = Camera(np.array([[60.0, 0, 16], [0, 60, 12], [0, 0, 1]]), np.eye(4), 32, 24)


def stiff_truth():
    """Return raw attributes of a needle seen along its axis before an almost opaque disc."""
    sh_coeffs = np.zeros((2, 4, 3))
    sh_coeffs[:, 0] = [[1.0, 0.2, -0.5], [-0.5, 0.4, 1.0]]
    return {
        "means": np.array([[0.1, 0.05, 4.0], [-0.2, 0.1, 6.0]]),
        "log_scales": np.log([[0.04, 0.04, 4.0], [1.0, 0.7, 0.01]]),
        "quats": np.array([[1, 0.01, 0.02, 0], [1, 0.1, -0.1, 0.3]]),
        "logit_opacities": np.array([0.5, 7.0]),
        "sh_coeffs": sh_coeffs,
        "motion": np.zeros((2, 3)),
        "logit_confidence": np.zeros(2),
    }


def stiff_case():
    """Return the case of `stiff_truth`."""
    raw = stiff_truth()
    values = {name: raw[name] for name in ("means", "quats", "sh_coeffs", "motion")}
    values |= {
        "scales": np.exp(raw["log_scales"]),
        "opacities": 1 / (1 + np.exp(-raw["logit_opacities"])),
        "confidence": 1 / (1 + np.exp(-raw["logit_confidence"])),
    }
    values = {key: np.float32(value).astype(np.float64) for key, value in values.items()}
    return Case("needle along its axis, before a disc", values, STIFF_CAMERA)


# Beyond what float32 can hold: bounds of the errors that are reached.
BEYOND = {"image": 2.0, "gradient": 10.0}
# By the ratio of the largest to the smallest scale. The last ones are 2.5e6 px long and 0.5 px wide
# on the screen, which is more than the aspect of 1e6 that is drawn.
NEEDLES = {
    10.0**k: case(
        f"needles of aspect 1e{k}",
        scales=10 ** (k * np.array([0.5, -0.5, -0.5])),
        bounds=BEYOND if k > 9 else None,
    )
    for k in range(11)
}
# By distance over extent, through a lens in which the cloud fills the view. From 1e6 on, a float32
# does not distinguish the depths of some Gaussians.
DISTANCES = {
    10.0**k: case(
        f"distance 1e{k} times the extent",
        eye(fov=np.rad2deg(2 * np.arctan(1.5 / 10.0**k)), origin=(0, 0, -(10.0**k))),
        bounds=BEYOND if k > 5 else None,
    )
    for k in range(11)
}
# Errors reached on a 2-core x86, 80-bit reference: image at most 6e-6, gradients at most 2e-5 (4e-5
# for needles across the screen), unless a comment states more. Limits: an aspect beyond 1e6 is
# drawn at 1e6, because a float32 rotation is no more precise; beyond 1e18 units nothing is drawn;
# depths that a float32 cannot distinguish are equal.
CASES_BY_KIND = {
    "ordinary": [
        case("plain"),
        case("one Gaussian", n=1),
        case("two Gaussians", n=2),
        case("camera rolled", eye(up=(0.6, -0.3, 0.1))),
        case("camera upside down", eye(up=(0, 1, 0))),
        case(
            "one Gaussian in every block",
            Camera(np.array([[40.0, 0, 32], [0, 40, 16], [0, 0, 1]]), np.eye(4), 64, 32),
            n=64,
            means=np.c_[(BLOCKS - (32, 16)) / 40 * 3, np.full(64, 3.0)],
            scales=(0.04, 0.06, 0.05),
            bounds=SLOW_REFERENCE,
        ),
    ],
    "needles and discs": [
        stiff_case(),
        case("needles", scales=(1, 1e-4, 1e-4)),
        case("needles across the screen", scales=(100, 1e-2, 1e-2)),
        case("needles of 250,000 px", scales=(1e4, 1, 1)),
        case(
            "needles along the axis",
            scales=(1e-4, 1e-4, 1),
            means=lambda m: m * 0.05,
            quats=(1, 0.0656, 0.0495, 0),
        ),
        case("discs", scales=(1, 1, 1e-4)),
        case("discs across the screen", scales=(100, 100, 1e-2)),
        case("needles 1e-6 x 1e3", scales=(1e3, 1e-6, 1e-6)),
    ],
    "aspects up to 1e9": [*NEEDLES.values()][:-1],
    "distances up to 1e5": [*DISTANCES.values()][:6],
    "aspect of 1e10, distances from 1e6 to 1e10": [*NEEDLES.values()][-1:]
    + [*DISTANCES.values()][6:],
    "scales": [
        case("sub-pixel splats", scales=(1e-6, 2e-6, 3e-6)),
        case("screen-filling splats", scales=(50, 70, 90)),
        case("scales 0", scales=0),
        case("scales 1e-38", scales=1e-38),
        case("scales 1e6", scales=(1e6, 2e6, 3e6)),
        case("scales 1e12", scales=(1e12, 2e12, 3e12)),
        case("scales 3e38", scales=3e38),
        case("scales 1e-30 to 1e12", scales=np.geomspace(1e-30, 1e12, 6)[:, None] * (1, 2, 3)),
    ],
    "near plane, camera inside": [
        case("on the near plane", ORIGIN, means=AT_NEAR_PLANE, scales=(0.002, 0.001, 0.003)),
        case("big, on the near plane", ORIGIN, means=AT_NEAR_PLANE, scales=(0.2, 0.1, 0.3)),
        case(
            "grazing the near plane, and at 1e17 units",
            ORIGIN,
            means=GRAZING,
            scales=GRAZING_SCALES,
        ),
        case("all behind", ORIGIN, means=moved(0, 0, -5)),
        case("camera inside", ORIGIN, means=lambda m: m * 0.01 + (0, 0, 0.03), scales=(3, 2, 5)),
    ],
    "coordinates": [
        case("1e-3 units", eye(origin=(3e-4, -4e-4, -3e-3), near=1e-5), **scaled(1e-3)),
        case("1e6 units", eye(origin=(3e5, -4e5, -3e6), near=1e4), **scaled(1e6)),
        # Means there are multiples of 2^-7; no further precision is lost, because poses are summed
        # in double.
        case("offset by 1e5", eye(viewmat=eye().viewmat @ LIFT), means=moved(*FAR)),
        case("equal depths", ORIGIN, means=lambda m: m * (0.5, 0.5, 0) + (0, 0, 2), opacities=0.9),
        case("1e-6 units", eye(origin=(3e-7, -4e-7, -3e-6), near=1e-8), **scaled(1e-6)),
        case("1e12 units away", eye(origin=(9e10, -1.2e11, -9e11), near=1e10), **scaled(3e11)),
    ],
    "opacities": [
        case("opacities 0, 1 and near", opacities=[0, 1, 1e-7, 1 - 2**-23, 0.99, 0.004]),
        case("opacities 1", opacities=1),
        case("opacities 0", opacities=0),
    ],
    "quaternions": [
        case("some quaternions 0", quats=lambda q: q * np.array([[0], [1], [0], [1], [1], [1]])),
        case("quaternions 1e-25", quats=lambda q: q * 1e-25),
        case("quaternions 1e33", quats=lambda q: q * 1e33),
        # Their gradients of 1e-38 underflow float32 to zero.
        case(
            "quaternions 1e38", quats=lambda q: np.clip(q, -3, 3) * 1e38, bounds={"gradient": 1.0}
        ),
    ],
    "colours": [
        case(
            "colours 1e6 and 1e-6",
            sh_coeffs=lambda c: c * np.array([1e6, 1, 1e-6, 1, -1e6, 1])[:, None, None],
        ),
        case("colours 1e15", sh_coeffs=lambda c: c * 1e15),
    ],
    "images": [
        case("image 1x1", eye(1, 1)),
        case("image 33x1", eye(33, 1)),
        case("image 1x65", eye(1, 65)),
        case("image 4096x1", eye(4096, 1, shift=(1.3, 0)), bounds=SLOW_REFERENCE),
        case("image 1x4096", eye(1, 4096, fov=0.02, shift=(0, 0)), bounds=SLOW_REFERENCE),
    ],
    "lenses": [
        case(
            "principal point outside",
            eye(viewmat=np.eye(4), shift=(-200, 150)),
            means=moved(23.7, -16.4, 3),
        ),
        # Reached: image 1.4e-4, gradients 3e-4. fx x / z + cx cancels; double precision there is
        # not worth its cost.
        case(
            "principal point far outside",
            eye(viewmat=np.eye(4), shift=(-2e4, 1e4)),
            means=moved(2367, -1096, 3),
            bounds=screen_bound(2e4),
        ),
        case("lens of 0.01 degrees", eye(fov=0.01, origin=(1e3, 2e3, -1e4))),
        case("lens of 179.9 degrees", eye(fov=179.9, origin=(0.1, 0.1, -0.5))),
        # Depths are 1e-8 of the distance, so all of them are equal in float32.
        case(
            "lens of 1e-6 degrees",
            eye(fov=1e-6, origin=(0, 0, -1e8), shift=(0, 0)),
            means=lambda m: m[np.argsort(m[:, 2])],
        ),
    ],
    "motion": [
        case("motion through the camera", ORIGIN, means=moved(0, 0, 3), motion=THROUGH),
        case("motion 1e12 units", motion=lambda m: m * 1e12),
    ],
}
CASES = [case for cases in CASES_BY_KIND.values() for case in cases]

# What `rasterize` refuses, with the sentence.
REFUSED = {
    "overflow": (
        {"log_scales": np.full((6, 3), 100.0)},
        r"`scales` must be finite, got inf at \[0, 0\]",
    ),
    "infinite mean": (
        {"means": np.full((6, 3), [0, 0, -np.inf])},
        r"`means` must be finite, got -inf at \[0, 2\]",
    ),
    "behind": (
        {"means": np.full((6, 3), [0, 0, -10.0]), "quats": np.full((6, 4), np.nan)},
        "`quats` must be finite",
    ),
    "one component": (
        {"quats": np.full((6, 4), [0, 0, 0, np.nan])},
        r"`quats` must be finite, got nan at \[0, 3\]",
    ),
    "colours": (
        {"sh_coeffs": np.full((6, 4, 3), 3e38)},
        r"`sh_coeffs` must be at most 1e18, got 3e\+38 at \[0, 0, 0\] \(72 ",
    ),
    "negative colours": (
        {"sh_coeffs": np.full((6, 4, 3), -1e20)},
        r"`sh_coeffs` must be at most 1e18, got -1e\+20",
    ),
    "motion": (
        {"motion": np.full((6, 3), 1e30)},
        r"`motion` must be at most 1e18, got 1e\+30 at \[0, 0\]",
    ),
}


ONE_PIXEL = Camera(np.array([[9.0, 0, 0.5], [0, 9, 0.5], [0, 0, 1]]), np.eye(4), 1, 1)


def stack(n, opacity):
    """Return n Gaussians of various colours behind each other, for a camera at the origin."""
    values = cloud(n)
    values |= {
        "means": np.c_[np.zeros((n, 2)), np.linspace(1, 2, n)],
        "opacities": np.full(n, opacity),
    }
    values["sh_coeffs"] = np.clip(values["sh_coeffs"], -0.4, 0.4)
    return {name: np.float32(value).astype(np.float64) for name, value in values.items()}


def million_on_a_pixel():
    """Return the relative errors of the image and the gradients of a million faint Gaussians."""
    values = stack(1_000_000, 0.004)
    values["means"][:, :2] = np.random.default_rng(0).normal(size=(1_000_000, 2)) * 0.1
    names = ("means", "scales", "quats", "opacities", "sh_coeffs")
    gaussians = Gaussians.from_activated(*(values[name] for name in names))
    config = RenderConfig(alpha_min=1e-6, stop_transmittance=1e-12)
    color, expected = reference64(gaussians, ONE_PIXEL, np.zeros((1, 2)), np.ones((1, 3)), config)
    dr.enable_grad(*gaussians.items().values())
    image = rasterize(gaussians, ONE_PIXEL, ("color",), config=config).color
    backward(image)
    result = {"image": float(np.abs(np.asarray(dr.detach(image)).ravel() - color.ravel()).max())}
    gradients = {name: np.asarray(dr.grad(getattr(gaussians, name))) for name in expected}
    # Per relative change, as those of logarithms are.
    lengths = np.linalg.norm(values["quats"], axis=1, keepdims=True)
    for grads in (expected, gradients):
        grads["quats"] = grads["quats"] * lengths
    largest = {name: float(np.abs(exact).max()) for name, exact in expected.items()}
    # Sums of the same terms: one that almost vanishes is compared relative to the largest.
    floor = 0.01 * max(largest[name] for name in ("log_scales", "quats", "logit_opacities"))
    for activated_name, (name, exact) in zip(names, expected.items(), strict=True):
        off = float(np.abs(gradients[name] - exact).max())
        result[activated_name] = off / max(largest[name], floor)
    return result


def raw_gaussians(**change):
    values = cloud()
    raw = {name: values[name] for name in ("means", "quats", "sh_coeffs", "motion")}
    raw |= {
        "log_scales": np.log(values["scales"]),
        "logit_opacities": np.zeros(6),
        "logit_confidence": np.zeros(6),
    }
    gaussians = Gaussians(**(raw | change))
    dr.enable_grad(*gaussians.items().values())
    return gaussians


def random_case(seed):
    """Return a random mixture of the cases in the table."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 7))
    unit = 10 ** rng.uniform(-3, 6)
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
    values["scales"] = values["scales"] * unit
    values["motion"] = values["motion"] * unit
    viewmat = np.float32(camera.viewmat @ lift).astype(np.float64)
    values = {name: np.float32(value).astype(np.float64) for name, value in values.items()}

    # A float32 can neither order closer ones nor decide on which side of the near plane they lie.
    depths, keep = np.unique(
        np.float32(values["means"] @ viewmat[2, :3] + viewmat[2, 3]), return_index=True
    )
    values = {name: value[keep] for name, value in values.items()}
    between = rng.choice((depths + np.append(depths[1:], 2 * depths[-1])) / 2)
    near = max(0.01 * unit, rng.choice([0, 0, between]))
    camera = Camera(camera.K, viewmat, camera.width, camera.height, near=float(near))
    # The centre of a needle may be 100 px away from a pixel that its end covers.
    return Case(f"seed {seed}", values, camera, screen_bound(100)["image"], tol.FUZZ_GRADIENT_REL)
