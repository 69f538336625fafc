"""Several cameras in one call of `rasterize`, against one call for each."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi import rasterize
from morgs_mi.testing import assert_close
from tests.scenes.cameras import make_camera
from tests.scenes.derivatives import gradient
from tests.scenes.gaussians import make_scene, to_gaussians

CHANNELS = ("color", "alpha", "depth", "motion", "confidence")


def cameras(count):
    """Return cameras beside each other, with sizes that are no multiples of a block."""
    camera = replace(make_camera(), width=45, height=37)
    viewmats = [np.array(camera.viewmat, np.float64) for _ in range(count)]
    for v, viewmat in enumerate(viewmats):
        viewmat[0, 3] += 0.1 * v
    return [replace(camera, viewmat=viewmat) for viewmat in viewmats]


@pytest.fixture(scope="module")
def gaussians():
    return to_gaussians(make_scene())


@pytest.mark.parametrize("count", [1, 3])
def test_rasterize__draws_cameras_together_as_one_by_one(gaussians, count):
    views = cameras(count)
    batch = rasterize(gaussians, views, CHANNELS, background=(0.2, 0.4, 0.6))
    for v, camera in enumerate(views):
        alone = rasterize(gaussians, camera, CHANNELS, background=(0.2, 0.4, 0.6))
        for name in CHANNELS:
            assert batch[name].shape == (count, *alone[name].shape)
            assert_array_equal(np.array(batch[name])[v], np.array(alone[name]), err_msg=name)


@pytest.mark.slow
def test_rasterize__sums_the_gradients_of_cameras():
    views = cameras(3)
    weights = np.random.default_rng(0).normal(size=(3, 37, 45, 3)).astype(np.float32)

    def gradients(draw):
        trained = to_gaussians(make_scene(), grad=True)
        poses = [mi.TensorXf(np.array(camera.viewmat)) for camera in views]
        dr.enable_grad(poses)
        posed = [replace(camera, viewmat=pose) for camera, pose in zip(views, poses, strict=True)]
        dr.backward(draw(trained, posed))
        grads = {
            name: gradient(getattr(trained, name)) for name in ("means", "log_scales", "sh_coeffs")
        }
        return grads | {f"pose {v}": gradient(pose) for v, pose in enumerate(poses)}

    def loss(trained, posed, weight):
        return dr.sum(rasterize(trained, posed).color * mi.TensorXf(weight), axis=None)

    batch = gradients(lambda trained, posed: loss(trained, posed, weights))
    alone = gradients(lambda trained, posed: sum(map(loss, [trained] * 3, posed, weights)))
    for name, grads in batch.items():
        assert np.abs(grads).max() > 0
        assert_close(grads, alone[name], rtol=1e-5, atol=1e-5)


def test_rasterize__refuses_cameras_that_do_not_fit(gaussians):
    first, second = cameras(2)
    with pytest.raises(ValueError, match="same size, got 45x37 and 90x37"):
        rasterize(gaussians, [first, replace(second, width=90)])
    with pytest.raises(ValueError, match="got an empty sequence"):
        rasterize(gaussians, [])
