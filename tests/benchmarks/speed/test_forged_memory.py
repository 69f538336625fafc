"""The benchmark of the memory that forged streams take, on one stream."""

from __future__ import annotations

import pytest

from benchmarks.speed.forged_memory import Options, measure


@pytest.mark.slow  # two processes that import Mitsuba
def test_measure__reports_size_and_memory_of_each_stream():
    (row,) = measure(Options(streams=((60_000, 3),)))
    assert row["gaussians"] == 60_000
    assert row["file_mb"] < 0.02
    assert 50 < row["play_mb"] < row["aim_mb"]
