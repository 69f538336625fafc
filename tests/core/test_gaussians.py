"""The Gaussians value: parameters of the attribute table, and the parts of the spherical harmonics."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest

from morgs_mi.core.attributes import ATTRIBUTES
from morgs_mi.core.gaussians import Gaussians, join_sh, split_sh
from tests.scenes.gaussians import make_scene, to_gaussians


def cloud(degree: int) -> Gaussians:
    return to_gaussians(make_scene(degree, n=5))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_join_sh__inverts_split_sh_with_gradient(degree):
    sh = cloud(degree).sh_coeffs
    dr.enable_grad(sh)
    joined = join_sh(*split_sh(sh))
    assert np.array_equal(np.asarray(joined), np.asarray(sh))
    dr.backward(dr.sum(dr.square(joined), axis=None))
    assert np.asarray(dr.grad(sh)) == pytest.approx(2 * np.asarray(sh), rel=1e-6)


@pytest.mark.parametrize("degree", [0, 2])
def test_parameters__are_those_of_the_table_and_with_parameters_inverts_them(degree):
    gaussians = cloud(degree)
    parameters = gaussians.parameters()
    assert list(parameters) == [a.name for a in ATTRIBUTES if a.name in parameters]
    assert ("sh_rest" in parameters) == (degree > 0)
    for name, value in gaussians.with_parameters(parameters).numpy().items():
        assert np.array_equal(value, gaussians.numpy()[name]), name
    assert gaussians.with_parameters({"sh_dc": parameters["sh_dc"]}).sh_degree == 0


def test_gaussians__refuse_shapes_that_disagree_and_unknown_attributes():
    raw = cloud(1).numpy()
    with pytest.raises(ValueError, match=r"`quats` must be \[N, 4\] with N=5, got \(4, 4\)"):
        Gaussians(**{**raw, "quats": raw["quats"][:4]})
    with pytest.raises(ValueError, match="K in 1, 4, 9, 16"):
        Gaussians(**{**raw, "sh_coeffs": raw["sh_coeffs"][:, :2]})
    with pytest.raises(AttributeError, match="no attribute 'roughness'"):
        _ = cloud(0).roughness
