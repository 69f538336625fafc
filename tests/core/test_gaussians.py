"""Gaussians: parameters of the attribute table, and the parts of the spherical harmonics."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi.core.attributes import ATTRIBUTES
from morgs_mi.core.gaussians import Gaussians, join_sh, read_columns, split_sh
from tests.scenes.derivatives import backward, gradient
from tests.scenes.gaussians import make_scene, to_gaussians


def cloud(degree):
    return to_gaussians(make_scene(degree, n=5))


@pytest.mark.parametrize("degree", [0, 3])
def test_join_sh__inverts_split_sh_with_gradient(degree):
    sh = cloud(degree).sh_coeffs
    dr.enable_grad(sh)
    joined = join_sh(*split_sh(sh))
    assert np.array_equal(np.asarray(joined), np.asarray(sh))
    backward(dr.square(joined))
    assert gradient(sh) == pytest.approx(2 * np.asarray(sh), rel=1e-6)


@pytest.mark.parametrize("size", [3, 4])
def test_read_columns__has_both_derivatives_beside_other_uses_of_the_array(size):
    # Borrowed memory that is not aligned to packets of four.
    array = mi.Float(np.linspace(0, 2, 5 * size + 1, dtype=np.float32)[1:])
    values = np.array(array).reshape(5, size)
    index = mi.UInt32(3, 0, 1)
    active = mi.Bool(True, True, False)
    expected = np.ones((5, size))
    expected[[3, 0]] += 2 * np.arange(1, size + 1) * values[[3, 0]]
    for derivative in (dr.backward, dr.forward):
        dr.enable_grad(array)
        columns = read_columns(array, index, size, active)
        assert np.array_equal(np.array(columns).T, values[[3, 0, 1]] * [[1], [1], [0]])
        loss = sum((k + 1) * dr.sum(dr.square(column)) for k, column in enumerate(columns))
        loss = loss + dr.sum(array)
        derivative(loss if derivative is dr.backward else array)
        if derivative is dr.backward:
            assert gradient(array).reshape(5, size) == pytest.approx(expected, rel=1e-6)
        else:
            assert gradient(loss) == pytest.approx([expected.sum()], rel=1e-6)
        dr.disable_grad(array)


@pytest.mark.parametrize("degree", [0, 2])
def test_parameters__are_those_of_the_table_and_with_parameters_inverts_them(degree):
    gaussians = cloud(degree)
    parameters = gaussians.parameters()
    assert list(parameters) == [a.name for a in ATTRIBUTES if a.name in parameters]
    assert ("sh_rest" in parameters) == (degree > 0)
    for name, value in gaussians.with_parameters(parameters).numpy().items():
        assert np.array_equal(value, gaussians.numpy()[name]), name
    assert gaussians.with_parameters({"sh_dc": parameters["sh_dc"]}).sh_degree == 0


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("quats", np.zeros((4, 4)), r"`quats` must be \[5, 4\], got \[4, 4\]"),
        ("sh_coeffs", np.zeros((5, 2, 3)), r"must be .* or \[5, 16, 3\], got \[5, 2, 3\]"),
        ("means", 0.0, r"`means` must be \[\d, 3\]"),
        ("means", [[1, 2], [3]], "`means` must be an array of real numbers"),
        ("logit_opacities", mi.Float(np.zeros(5)), "must be a NumPy array or a drjit"),
    ],
)
def test_gaussians__refuse_shapes_that_disagree(name, value, message):
    with pytest.raises(ValueError, match=message):
        Gaussians(**{**cloud(1).numpy(), name: value})


def test_gaussians__have_no_unknown_attributes_and_are_at_least_one_to_concatenate():
    with pytest.raises(ValueError, match="must hold at least one"):
        Gaussians.concatenate([])
    with pytest.raises(AttributeError, match="no attribute 'roughness'"):
        _ = cloud(0).roughness


def test_gaussians__are_not_changed_by_later_writes_to_their_arrays():
    """One buffer per attribute is refilled for each of five frames, so large that kernels run while
    it is written.
    """
    N = 200_000
    shapes = {
        "means": (3,),
        "log_scales": (3,),
        "quats": (4,),
        "logit_opacities": (),
        "sh_coeffs": (1, 3),
    }
    buffers = {name: np.zeros((N, *shape), np.float32) for name, shape in shapes.items()}
    frames = []
    for frame in range(5):
        for buffer in buffers.values():
            buffer[:] = frame
        frames.append(Gaussians(**buffers))
    for name in shapes:
        assert [np.unique(np.asarray(getattr(g, name))).tolist() for g in frames] == [
            [k] for k in range(5)
        ], name


def test_numpy__returns_copies():
    gaussians = cloud(0)
    gaussians.numpy()["means"][:] = 7
    assert not (np.asarray(gaussians.means) == 7).any()


@pytest.mark.parametrize(("name", "value"), [("scales", -1), ("opacities", 1.5)])
def test_from_activated__refuses_values_that_are_not_activated(name, value):
    values = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh_coeffs": (1, 3)}
    values = {name: np.full((2, *shape), 0.5) for name, shape in values.items()}
    values[name][1] = value
    with pytest.raises(ValueError, match=rf"`{name}` must be .*, got {value}.* at \[1"):
        Gaussians.from_activated(**values)


def test_repr__has_number_degree_and_size():
    gaussians = replace(cloud(2), means=[(0, 0, 0), (2, 1, 0), *3 * [(1, 0.5, -0.25)]])
    text = "Gaussians(N=5, SH degree 2, box of 2 x 1 x 0.25, motion, logit_confidence)"
    assert repr(gaussians) == text
    assert repr(gaussians.select(np.zeros(5, bool))).startswith("Gaussians(N=0, SH degree 2, box")


def test_concatenate__skips_empty_parts_and_refuses_other_degrees():
    none = cloud(1).select(np.zeros(5, bool))
    joined = Gaussians.concatenate([none, cloud(1), none, cloud(1)])
    assert np.array_equal(joined.means, np.concatenate([cloud(1).means] * 2))
    assert len(Gaussians.concatenate([none, none])) == 0
    with pytest.raises(ValueError, match=r"the same attributes and SH degree, got .*SH degree 2"):
        Gaussians.concatenate([cloud(1), cloud(2)])


def test_with_parameters__takes_the_rest_of_the_harmonics_alone():
    gaussians = cloud(1)
    rest = gaussians.parameters()["sh_rest"]
    changed = gaussians.with_parameters({"sh_rest": 2 * rest})
    assert np.array_equal(changed.sh_coeffs[:, 1:], 2 * np.asarray(rest))
    assert np.array_equal(changed.sh_coeffs[:, :1], gaussians.sh_coeffs[:, :1])


def test_from_activated__refuses_values_that_would_lose_their_gradients():
    gaussians = cloud(0)
    scales = mi.TensorXf(gaussians.scales)
    dr.enable_grad(scales)
    others = (gaussians.quats, gaussians.opacities, gaussians.sh_coeffs)
    with pytest.raises(ValueError, match="`scales` must not be attached to gradients"):
        Gaussians.from_activated(gaussians.means, scales, *others)


def test_gaussians__are_equal_to_themselves_alone():
    gaussians = cloud(0)
    assert gaussians == gaussians
    assert gaussians != cloud(0)
    assert {gaussians: 1}[gaussians] == 1
