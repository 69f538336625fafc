"""The renderer at the extremes: every case against the reference implementation, or finite within a
stated bound.

Gradients are compared by attribute, relative to the largest entry. Gradients of scales, quaternions
and opacities are per relative change, as for an optimiser of logarithms.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import Camera, rasterize
from tests import tolerances as tol
from tests.render.exact import (
    ATTRIBUTES,
    BACKGROUND,
    CONFIG,
    Activated,
    clear_pixels,
    errors,
    exact_image,
    run,
    weights,
)
from tests.scenes.derivatives import tangents
from tests.scenes.extremes import CASES, REFUSED, eye, random_case, raw_gaussians
from tests.scenes.gaussians import CHANNELS


def failures(case):
    """Return the failed comparisons of a case, empty if all pass."""
    try:
        largest_errors = errors(case)
    except (AssertionError, ValueError) as error:
        return [f"{case.name}: {error}"]
    bounds = {name: case.image if name == "image" else case.gradient for name in largest_errors}
    return [
        f"{case.name}: {name} off by {e:.1e}, bound {bounds[name]:.1e}"
        for name, e in largest_errors.items()
        if not e < bounds[name]
    ]


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_rasterize__agrees_with_the_reference_at_the_extremes(case):
    assert not failures(case)


@pytest.mark.slow
def test_rasterize__forward_and_reverse_mode_are_dual_at_the_extremes():
    """<g, J v> = <J' g, v> along the signs of J' g, where nothing cancels."""
    failed = []
    for case in CASES:
        weight = weights(
            exact_image(case.values, case.camera),
            np.ones((case.camera.height, case.camera.width), bool),
        )
        _, grads = run(case.values, case.camera, weight)
        gaussians = Activated(case.values)
        image = rasterize(gaussians, case.camera, CHANNELS, BACKGROUND, config=CONFIG)
        steps = {}
        for name in ATTRIBUTES:
            # Steps as long as the attribute: a unit step of a scale of 1e-38 would overflow.
            steps[name] = np.sign(grads[name]) * np.minimum(np.abs(case.values[name]), 1e6)
            grads[name] = np.vdot(grads[name], steps[name])
        results = tangents(gaussians, steps, [image[name] for name in CHANNELS])
        forward = sum(np.vdot(t, weight[name]) for t, name in zip(results, CHANNELS, strict=True))
        reverse = sum(grads.values())
        if not abs(forward - reverse) <= tol.DUALITY_REL * abs(reverse):
            failed.append(f"{case.name}: forward {forward:.7g}, reverse {reverse:.7g}")
    assert not failed


@pytest.mark.slow
def test_rasterize__gradients_of_the_pose_at_the_extremes():
    """Columns are compared separately: rotating a world at 1e5 units moves it 1e5 times as far as
    translating it.
    """
    failed = []
    for case in CASES:
        camera = case.camera
        exact = np.zeros((3, 4))
        posed = Camera(
            camera.K,
            mi.TensorXf(np.float32(camera.viewmat)),
            camera.width,
            camera.height,
            near=camera.near,
        )
        dr.enable_grad(posed.viewmat)
        weight = weights(exact_image(case.values, camera), clear_pixels(case.values, camera))
        run(case.values, posed, weight)
        gradient = np.asarray(dr.grad(posed.viewmat), np.float64)[:3]
        for index in np.ndindex(*exact.shape):
            nudged = camera.viewmat.astype(np.clongdouble)
            nudged[index] += 1e-30j
            image = exact_image(case.values, camera, viewmat=nudged)
            exact[index] = sum(np.sum(image[c].imag * weight[c]) for c in CHANNELS) / 1e-30
        off = np.abs(gradient - exact).max(axis=0) / np.maximum(np.abs(exact).max(axis=0), 1e-30)
        if not (off <= case.gradient).all():
            failed.append(f"{case.name}: columns off by {off}, bound {case.gradient:.1e}")
    assert not failed, "\n".join(failed)


@pytest.mark.parametrize(
    "change",
    [
        {"log_scales": np.array([-200.0, -100, -50, 0, 50, 88])[:, None] * np.ones(3)},
        {"log_scales": np.array([88.0, -200, 0]) * np.ones((6, 1))},
        {"logit_opacities": np.array([-1e38, -100, -17, 17, 100, 1e38])},
        {"logit_confidence": np.array([-1e38, -100, -17, 17, 100, 1e38])},
        {"means": np.array([1e30, -3e38, 1e19, 0, 1e-30, 3e38])[:, None] * np.ones(3)},
        {"sh_coeffs": np.full((6, 4, 3), -1e18)},
        {"sh_coeffs": np.full((6, 4, 3), 1e18)},
        {"motion": np.full((6, 3), 1e17)},
    ],
    ids=[
        "scales",
        "needles",
        "opacities",
        "confidence",
        "means",
        "colours below 0",
        "colours",
        "motion",
    ],
)
def test_rasterize__raw_extremes_stay_finite(change):
    gaussians = raw_gaussians(**change)
    image = rasterize(gaussians, eye(), CHANNELS, BACKGROUND, config=CONFIG)
    for name in CHANNELS:
        assert np.isfinite(np.asarray(image[name])).all(), name
    dr.backward(sum(dr.mean(image[name], axis=None) for name in CHANNELS))
    for name, value in gaussians.items().items():
        assert np.isfinite(np.asarray(dr.grad(value))).all(), name


OPACITIES = ({"logit_opacities": np.full(6, np.nan)}, "`opacities` must be finite, got nan")


@pytest.mark.parametrize(
    ("change", "message"), [*REFUSED.values(), OPACITIES], ids=[*REFUSED, "opacities"]
)
def test_rasterize__refuses_non_finite_attributes_anywhere(change, message):
    with pytest.raises(ValueError, match=message):
        rasterize(raw_gaussians(**change), eye(), CHANNELS, BACKGROUND, config=CONFIG)


def fuzz(seeds):
    return [line for seed in seeds for line in failures(random_case(seed))]


def test_rasterize__fuzz():
    assert not fuzz(range(4))


@pytest.mark.slow
def test_rasterize__fuzz_with_further_seeds():
    assert not fuzz(range(4, 10))


@pytest.mark.long
def test_rasterize__fuzz_with_many_seeds():
    assert not fuzz(range(10, 210))
