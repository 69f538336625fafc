"""CRCs of overlapping ranges."""

from __future__ import annotations

import zlib

import numpy as np

from morgs_mi.codec.crc import range_crcs


def test_range_crcs__equal_those_of_zlib() -> None:
    rng = np.random.default_rng(0)
    data = rng.bytes(5000)
    starts, stops = np.sort(rng.integers(0, len(data) + 1, (2, 300)), axis=0)
    starts[:3], stops[:3] = (0, 17, 5000), (5000, 17, 5000)
    values = rng.integers(0, 2**32, 300, dtype=np.uint32)
    expected = [zlib.crc32(data[a:b], v) for a, b, v in zip(starts, stops, values.tolist(), strict=True)]
    assert range_crcs(data, starts, stops, values.copy()).tolist() == expected
    nothing = np.zeros(0, np.int64)
    assert len(range_crcs(data, nothing, nothing, np.zeros(0, np.uint32))) == 0
