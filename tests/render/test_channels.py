"""Channels of the table of attributes, with rows that a test adds."""

import drjit as dr
import numpy as np
import pytest

from morgs_mi import rasterize
from morgs_mi.testing import assert_close
from tests import tolerances as tol
from tests.scenes.derivatives import backward, gradient
from tests.scenes.gaussians import (
    ExtendedGaussians,
    to_gaussians,
)


@pytest.mark.usefixtures("new_attributes")
def test_rasterize__renders_a_new_attribute_of_the_table(scene):
    raw, camera = scene
    rng = np.random.default_rng(6)
    normals = np.float32(rng.normal(size=(len(raw["means"]), 3)))
    gaussians = ExtendedGaussians(**raw, logit_roughness=raw["logit_confidence"], normals=normals)
    dr.enable_grad(gaussians.logit_confidence, gaussians.logit_roughness)
    channels = ("color", "roughness", "confidence", "normal")
    image = rasterize(gaussians, camera, channels, features=normals)
    assert image["color"].shape == (camera.height, camera.width, 3)
    assert_close(image["roughness"], image.confidence)
    assert_close(image["normal"], image.features)
    backward(dr.square(image["roughness"]) + dr.square(image.confidence))
    grad = gradient(gaussians.logit_confidence)
    assert np.abs(grad).max() > 0
    assert_close(dr.grad(gaussians.logit_roughness), grad, rtol=tol.SUM_ORDER_REL)
    with pytest.raises(
        ValueError, match="channel 'roughness' requires Gaussians with `logit_roughness`, got none"
    ):
        rasterize(to_gaussians(raw), camera, ("roughness",))


def test_image__is_indexed_by_channel(scene):
    raw, camera = scene
    image = rasterize(to_gaussians(raw), camera, ("color", "depth"))
    assert image["color"] is image.color
    assert image["depth"] is image.depth
    with pytest.raises(KeyError, match="expected a channel out of color, depth, got 'alpha'"):
        image["alpha"]
