"""The optimisation loop: convergence, rates, order of the views, and losses that are not finite."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi.fit.optimise import (
    Steps,
    adam,
    fit_problem,
    optimise,
    pop_psnr,
    replace_parameter,
    select_rows,
    values_of,
    view_order,
)
from morgs_mi.testing import assert_close


def bowl(values, view):
    x = values["x"]
    return {
        "near": dr.sum(dr.square(x - 1.0), axis=None),
        "far": dr.sum(dr.square(x - 3.0), axis=None),
    }


@pytest.mark.parametrize("decay", [None, lambda step: 0.1 ** (step / 200)])
def test_optimise__minimises_the_weighted_sum(decay):
    start = {"x": mi.TensorXf(np.zeros(4, np.float32))}
    near = adam(start)
    losses = optimise(near, {"x": 0.1}, bowl, Steps([0] * 200, rate_factor=decay), {"far": 0.0})
    assert_close(values_of(near)["x"], np.ones(4), atol=0.02)
    assert losses["far"] == pytest.approx(16, rel=0.05)
    both = adam(start)
    optimise(both, {"x": 0.1}, bowl, Steps([0] * 200, rate_factor=decay))
    assert_close(values_of(both)["x"], np.full(4, 2.0), atol=0.02)


@pytest.mark.parametrize(("momentum", "needed"), [(0.9, 3), (0.5, 1)])
def test_adam__momentum_delays_a_reversal(momentum, needed):
    """With less momentum, fewer opposite gradients reverse the steps."""
    optimizer = adam({"x": mi.TensorXf(np.zeros(1, np.float32))}, momentum)
    path = [0.0]

    def slope(values, view):
        return {"slope": (1 if view else -1) * dr.sum(values["x"], axis=None)}

    for view in [0] * 4 + [1] * 6:
        optimise(optimizer, {"x": 1.0}, slope, Steps([view]))
        path.append(np.asarray(values_of(optimizer)["x"]).item())
    assert int(np.argmax(np.diff(path) < 0)) - 3 == needed


def test_optimise__names_losses_that_are_not_finite():
    start = {"x": mi.TensorXf(np.zeros(1, np.float32))}
    with pytest.raises(FloatingPointError, match="recon are not finite after 3 steps"):
        optimise(
            adam(start),
            {"x": 1.0},
            lambda v, _: {"recon": dr.log(dr.sum(v["x"], axis=None) - 100)},
            Steps([0] * 3),
        )


def test_pop_psnr__takes_the_squared_error_out_of_the_losses():
    losses = {"recon": 0.1, "mse": 0.01}
    assert pop_psnr(losses) == pytest.approx(20)
    assert losses == {"recon": 0.1}
    assert np.isnan(pop_psnr(losses))


@pytest.mark.parametrize(
    ("psnr", "errors", "start"),
    [
        (10.0, [0.01, 0.09], "the training views have 10.0 dB, worse than constant images with 13"),
        (12.0, [0.01, 0.09], ""),  # 13 dB: by a median instead of a mean
        (21.0, [1e-4], ""),  # what changes may have one colour
        (np.nan, [], ""),
    ],
)
def test_fit_problem__names_images_that_are_worse_than_constant_ones(psnr, errors, start):
    sentence = fit_problem(psnr, errors)
    assert sentence.startswith(start)
    assert bool(sentence) == bool(start)


def test_optimise__counts_on_from_its_first_step():
    made = []
    factors = []
    optimizer = adam({"x": mi.TensorXf(np.zeros(3, np.float32))})
    steps = Steps([0] * 3, 5, lambda step: factors.append(step) or 1.0, made.append)
    optimise(optimizer, {"x": 0.1}, bowl, steps)
    assert (factors, made) == ([5, 6, 7], [6, 7, 8])


def test_replace_parameter__keeps_moments():
    """New columns start without moments; the others take the same steps as without them."""
    ends = []
    for widens in (False, True):
        optimizer = adam({"x": mi.TensorXf(np.zeros((2, 1), np.float32))})
        optimise(optimizer, {"x": 0.1}, bowl, Steps([0] * 4))
        if widens:
            value = np.asarray(values_of(optimizer)["x"])
            replace_parameter(
                optimizer,
                "x",
                mi.TensorXf(np.pad(value, [(0, 0), (0, 2)])),
                lambda m: mi.TensorXf(np.pad(m, [(0, 0), (0, 2)])),
            )
        optimise(optimizer, {"x": 0.1}, bowl, Steps([0] * 4, 4))
        ends.append(np.asarray(values_of(optimizer)["x"]))
    assert np.array_equal(ends[0][:, 0], ends[1][:, 0])
    assert ends[1].shape == (2, 3)
    assert 0 < ends[1][0, 1] < ends[1][0, 0]


def test_select_rows__adds_edits_to_the_parameters():
    start = np.arange(6, dtype=np.float32).reshape(3, 2)
    optimizer = adam({"x": mi.TensorXf(start), "y": mi.TensorXf(start)})
    edit = np.array([[1, 0], [0, 2]], np.float32)
    select_rows(optimizer, np.array([2, 0]), np.array([False, True]), {"x": edit})
    values = values_of(optimizer)
    assert np.array_equal(np.asarray(values["x"]), start[[2, 0]] + edit)
    assert np.array_equal(np.asarray(values["y"]), start[[2, 0]])


def test_view_order__draws_without_repetition():
    order = view_order(5, 13, np.random.default_rng(0))
    assert len(order) == 13
    assert sorted(order[:5]) == sorted(order[5:10]) == list(range(5))
    assert order == view_order(5, 13, np.random.default_rng(0))
    assert view_order(5, 0, np.random.default_rng(0)) == []
