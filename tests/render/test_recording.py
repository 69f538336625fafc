"""Recordings are bounded in number, and what has made room is recorded again."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from morgs_mi.render import recording


def scaled(factor: int, *arrays: Any) -> list[Any]:
    return [factor * array for array in arrays]


def test_many_combinations_of_sizes_leave_few_recordings(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(recording, "_MOST_RECORDINGS", 10)
    function = recording.recorded(scaled, 3)
    for _ in range(2):
        for pattern in range(32):
            sizes = [2 + (pattern >> bit & 1) for bit in range(5)]
            arrays = [mi.Float(np.arange(size, dtype=np.float32)) for size in sizes]
            for array, result in zip(arrays, function(*arrays), strict=True):
                np.testing.assert_array_equal(np.asarray(result), 3 * np.asarray(array))
    assert function.n_cached_recordings <= 10 < function.n_recordings
    assert not capfd.readouterr().err
