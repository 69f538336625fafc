"""Entropy coding: exact, close to the entropy, and harmless when damaged."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.codec.entropy import LIMIT, ColumnReader, ColumnWriter

RNG = np.random.default_rng(3)
COLUMNS = {
    "empty": np.zeros(0, np.int64),
    "one": np.array([-7]),
    "constant": np.zeros(5000, np.int64),
    "narrow": np.rint(RNG.laplace(0, 0.6, 5000)).astype(np.int64),
    "wide": np.rint(RNG.laplace(3, 400, 5000)).astype(np.int64),
    "limits": np.array(
        [LIMIT - 1, 1 - LIMIT, 15, -15, 16, -16, 2**16 - 1, 2**16, 2**17 - 1, -(2**17)]
    ),
    "any": RNG.integers(1 - LIMIT, LIMIT, 300),
}


def coded(*columns):
    writer = ColumnWriter()
    for column in columns:
        writer.put(column)
    return writer.words()


def test_column_reader__inverts_the_writer_in_order():
    reader = ColumnReader(coded(*COLUMNS.values()))
    for name, column in COLUMNS.items():
        assert_array_equal(reader.take(len(column)), column, name)


@pytest.mark.parametrize("scale", [0.3, 40])
def test_column_writer__is_close_to_the_entropy(scale):
    values = np.rint(np.random.default_rng(0).laplace(0, scale, 10_000)).astype(int)
    _, counts = np.unique(values, return_counts=True)
    entropy = -(counts * np.log2(counts / counts.sum())).sum()
    size = 32 * len(coded(values))
    # Learning the distribution costs about ten bits per distinct token, and octaves are modelled as
    # uniform.
    assert entropy < size < 1.035 * entropy + 300


def test_column_writer__stores_a_constant_column_in_a_few_bytes():
    assert coded(np.zeros(100_000, np.int64)).nbytes < 40
