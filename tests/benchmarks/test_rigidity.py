"""Local rigidity: zero for rigid motion, against float64 twins, and gradients against central
differences, and what they do in the fit of a frame.
"""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.field.rigidity import LOSSES, find_neighbours
from morgs_mi.core.geometry import rotated, unit_quats
from morgs_mi.fit.fit_config import DensityConfig
from morgs_mi.method.objective import ObjectiveConfig, Prediction, losses_of
from tests.scenes.derivatives import difference, gradient
from tests.scenes.gaussians import make_wide_scene, to_gaussians
from tests.scenes.shifted_ball import FIT, PLAIN, fit_shifted

COUNT = 5
REACH = 0.3
EXTENT = 2.0
BEFORE = make_wide_scene(40)


def neighbours():
    pairs = find_neighbours(to_gaussians(BEFORE), EXTENT, COUNT, REACH)
    return pairs


def other(seed=0, size=0.1):
    """Return the Gaussians, each moved and turned by itself."""
    rng = np.random.default_rng(seed)
    start = to_gaussians(BEFORE)
    means, quats = (
        np.asarray(v) + size * rng.normal(size=v.shape) for v in (start.means, start.quats)
    )
    return replace(start, means=means, quats=quats)


def reference(gaussians):
    """Return the losses in float64, pair by pair."""
    start = to_gaussians(BEFORE)
    old, new = (np.asarray(g.means, np.float64) / EXTENT for g in (start, gaussians))
    q_old, q_new = (
        Rotation.from_quat(unit_quats(g), scalar_first=True) for g in (start, gaussians)
    )
    sums = dict.fromkeys(LOSSES, 0.0)
    count = 0
    turns = (q_new * q_old.inv()).as_quat(scalar_first=True)
    for i in range(len(old)):
        for j in np.argsort(np.linalg.norm(old - old[i], axis=1))[1 : 1 + COUNT]:
            e = old[j] - old[i]
            e_now = new[j] - new[i]
            w = np.exp(-(e @ e) / REACH**2)
            turn = Rotation.from_quat(turns[i], scalar_first=True)
            sums["rigid"] += w * np.linalg.norm(e_now - turn.apply(e))
            # A quaternion and its negative are one rotation; small changes keep the sign of both
            # factors.
            sums["rotation"] += w * min(np.linalg.norm(turns[j] - s * turns[i]) for s in (1, -1))
            sums["isometry"] += w * abs(np.linalg.norm(e_now) - np.linalg.norm(e))
            count += 1
    return {name: value / count for name, value in sums.items()}


@pytest.mark.parametrize("name", LOSSES)
def test_rigidity__is_that_of_its_definition(name):
    loss = np.asarray(LOSSES[name](other(), neighbours())).item()
    assert loss == pytest.approx(reference(other())[name], rel=1e-4)


@pytest.mark.parametrize("name", LOSSES)
def test_rigidity__is_zero_for_a_body_that_moves_as_a_whole(name):
    start = to_gaussians(BEFORE)
    turned = rotated(start, Rotation.from_euler("xyz", (30, -20, 50), degrees=True).as_matrix())
    body = replace(turned, means=np.asarray(turned.means) + np.array([0.4, 0, -0.2]))
    assert np.asarray(LOSSES[name](body, neighbours())).item() < 1e-5
    assert np.asarray(LOSSES[name](other(), neighbours())).item() > 1e-2


@pytest.mark.parametrize(
    ("name", "attribute"),
    [("rigid", "means"), ("rigid", "quats"), ("rotation", "quats"), ("isometry", "means")],
)
def test_rigidity__gradients_agree_with_central_differences(name, attribute):
    gaussians = other(1)
    loss = LOSSES[name]
    value = getattr(gaussians, attribute)
    dr.enable_grad(value)
    dr.backward(loss(gaussians, neighbours()))
    direction = np.random.default_rng(2).normal(size=value.shape).astype(np.float32)
    # Float32 leaves 1e-3 of a difference this small.
    expected = difference(
        lambda at: loss(replace(gaussians, **{attribute: at}), neighbours()),
        dr.detach(value),
        direction,
        1e-3,
    )
    assert np.vdot(gradient(value), direction) == pytest.approx(expected, rel=0.02, abs=1e-4)


@pytest.mark.parametrize("name", LOSSES)
def test_rigidity__has_a_finite_gradient_where_nothing_moves(name):
    still = to_gaussians(BEFORE)
    dr.enable_grad(still.means, still.quats)
    dr.backward(LOSSES[name](still, neighbours()))
    assert all(
        np.isfinite(np.asarray(dr.grad(value))).all() for value in (still.means, still.quats)
    )


def test_find_neighbours__weighs_near_ones_more():
    pairs = neighbours()
    lengths = np.asarray(dr.norm(pairs.edges))
    weights = np.asarray(pairs.weights) * len(lengths)
    assert weights == pytest.approx(np.exp(-((lengths / REACH) ** 2)), rel=1e-4)
    assert np.asarray(pairs.difference @ np.ones(40)) == pytest.approx(np.zeros(200), abs=0)


@pytest.mark.parametrize("name", LOSSES)
def test_rigid_terms__have_the_neighbours_of_the_previous_frame(name):
    prediction = Prediction(
        None, {}, None, 1.0, 1 / (40 * EXTENT), EXTENT, other(), to_gaussians(BEFORE)
    )
    config = ObjectiveConfig(terms=(f"{name}:1",))
    expected = LOSSES[name](other(), find_neighbours(to_gaussians(BEFORE), EXTENT))
    loss = losses_of(prediction, {}, config)[name]
    assert np.asarray(loss).item() == pytest.approx(np.asarray(expected).item(), rel=1e-6)
    one = to_gaussians(BEFORE).select(np.array([3]))
    alone = replace(prediction, gaussians=one, previous=one)
    assert np.asarray(losses_of(alone, {}, config)[name]).item() == 0


def test_rigid_terms__compare_the_neighbours_of_births_with_their_parents():
    """With births, there are more Gaussians after the round of density control than before it."""
    objective = ObjectiveConfig(terms=("rigid:1",))
    density = DensityConfig(births=0.3, min_error=0)
    config = replace(FIT, epochs=4, objective=objective, density=density)
    result = fit_shifted(PLAIN, config=config)
    assert len(result.gaussians) > 400
    assert np.isfinite(result.losses["rigid"])
