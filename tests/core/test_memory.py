"""Copies of NumPy memory for Dr.Jit: types, alignment, and later writes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi.core.memory import from_numpy, owned_copy


@pytest.mark.parametrize("kind", ["Float", "Float64", "Int32", "UInt32", "Bool", "TensorXf"])
def test_from_numpy__converts_to_the_type_in_aligned_memory(kind):
    kind, values = getattr(mi, kind), np.arange(12.0).reshape(3, 4)
    found = np.asarray(from_numpy(kind, values))
    expected = values if dr.is_tensor_v(kind) else values.ravel()
    np.testing.assert_array_equal(found, expected.astype(found.dtype))
    assert found.__array_interface__["data"][0] % 64 == 0


def test_from_numpy__copies_before_kernels_read():
    values = np.zeros(1_000_000, np.float32)
    array = from_numpy(mi.Float, values)
    busy = dr.sin(dr.arange(mi.Float, 4_000_000))
    dr.eval(busy)  # the kernels after it wait
    doubled = 2 * array
    dr.eval(doubled)
    values[:] = 7
    del array
    assert not np.asarray(doubled).any()


def test_from_numpy__accepts_empty_arrays_and_lists():
    assert from_numpy(mi.TensorXf, np.zeros((0, 3))).shape == (0, 3)
    assert dr.width(from_numpy(mi.UInt32, [])) == 0
    assert list(from_numpy(mi.UInt32, [1, 2])) == [1, 2]


def test_owned_copy__is_aligned():
    borrowed = mi.Float(np.arange(1001, dtype=np.float32)[1:])
    copy = np.asarray(owned_copy(borrowed))
    assert np.array_equal(copy, np.arange(1, 1001))
    assert copy.__array_interface__["data"][0] % 64 == 0


def test_from_numpy__is_refused_under_freeze():
    frozen = dr.freeze(lambda x: x + from_numpy(mi.Float, np.ones(4)))
    with pytest.raises(RuntimeError) as error:
        frozen(dr.arange(mi.Float, 4))
    assert "expected a call outside dr.freeze" in str(error.value.__cause__)
