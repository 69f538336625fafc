"""`cryptomatte`: hashes with known values, and the order of the ranks."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi.io.cryptomatte import LAYER, cryptomatte, name_hash


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("hello", 0x248BFA47),
        ("hello, world", 0x149BBB7F),
        ("The quick brown fox jumps over the lazy dog", 0x2E4FF723),
        ("", 1 << 23),  # the hash is 0, which is no normal float
    ],
)
def test_name_hash__is_murmur_hash_3(name, value):
    assert name_hash(name) == value


def test_name_hash__is_always_a_normal_float():
    values = np.array([name_hash(f"object{i}") for i in range(5000)], np.uint32).view(np.float32)
    assert np.isfinite(values).all()
    assert (np.abs(values) >= np.finfo(np.float32).tiny).all()


def test_cryptomatte__ranks_by_coverage_and_omits_those_that_cover_least():
    coverage = np.array([0.05, 0.3, 0.0, 0.2, 0.1, 0.15, 0.12, 0.08])
    channels, attributes = cryptomatte({f"m{i}": np.full((2, 3), c) for i, c in enumerate(coverage)})
    names = [f"{LAYER}{i:02d}.{letter}" for i in range(3) for letter in "RGBA"]
    assert list(channels) == names
    ranked = [float(channels[name][0, 0]) for name in names[1::2]]
    np.testing.assert_allclose(ranked, sorted(coverage, reverse=True)[:6], rtol=1e-6)
    assert channels[names[0]][0, 0].view(np.uint32) == name_hash("m1")
    assert {key.split("/")[1] for key in attributes} == {f"{name_hash(LAYER):08x}"[:7]}


def test_cryptomatte__of_one_name_leaves_the_second_rank_empty():
    channels, _ = cryptomatte({"splats": np.array([[0.5, 0.0]])})
    assert list(channels) == [f"{LAYER}00.{letter}" for letter in "RGBA"]
    np.testing.assert_array_equal(channels[f"{LAYER}00.G"], [[0.5, 0]])
    assert channels[f"{LAYER}00.R"][0, 1] == channels[f"{LAYER}00.B"].max() == channels[f"{LAYER}00.A"].max() == 0
