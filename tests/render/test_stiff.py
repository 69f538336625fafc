"""A stiff fit, a needle seen along its axis in front of an almost opaque disc: it stays finite and
converges.
"""

import drjit as dr
import numpy as np
import pytest
from drjit.opt import Adam

from morgs_mi import Gaussians, rasterize
from tests.render.exact import BACKGROUND, CONFIG
from tests.scenes.extremes import STIFF_CAMERA, stiff_truth
from tests.scenes.gaussians import CHANNELS


def descend(rate, steps):
    """Return the losses and the final raw attributes of Adam with one decaying learning rate for
    all attributes.
    """

    def render(gaussians):
        return rasterize(gaussians, STIFF_CAMERA, CHANNELS, BACKGROUND, config=CONFIG).color

    truth = stiff_truth()
    rng = np.random.default_rng(0)
    target = dr.detach(render(Gaussians(**truth)))
    start = {name: value + 0.03 * rng.normal(size=value.shape) for name, value in truth.items()}
    start["log_scales"] += 0.3 * rng.normal(size=(2, 3))
    start["logit_opacities"] += (1, -3)
    optimizer = Adam(lr=rate, params=Gaussians(**start).items(), epsilon=1e-15)
    losses = []
    for step in range(steps):
        optimizer.set_learning_rate(rate * 0.01 ** (step / steps))
        loss = dr.mean(dr.square(render(Gaussians(**dict(optimizer))) - target), axis=None)
        dr.backward(loss)
        optimizer.step()
        losses.append(float(np.asarray(dr.detach(loss)).item()))
    return losses, Gaussians(**dict(optimizer)).numpy()


@pytest.mark.slow
def test_rasterize__adam_converges_on_a_stiff_problem():
    losses, values = descend(0.02, 150)
    assert np.isfinite(losses).all()
    assert losses[-1] < 1e-3 * losses[0]
    for name, value in stiff_truth().items():
        assert np.abs(values[name] - value).max() < (4 if name == "logit_opacities" else 1), name


def test_rasterize__stays_finite_with_an_excessive_learning_rate():
    losses, values = descend(10.0, 60)
    assert np.isfinite(losses).all()
    assert all(np.isfinite(value).all() for value in values.values())
