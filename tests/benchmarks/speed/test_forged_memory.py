"""The benchmark of the memory that forged streams take, on a few Gaussians."""

from __future__ import annotations

from benchmarks.speed.forged_memory import Options, measure


def test_measure__reports_size_and_memory_of_each_stream():
    (row,) = measure(Options(streams=((20_000, 3),)))
    assert row["gaussians"] == 20_000
    assert row["file_mb"] < 0.01
    assert 5 < row["play_mb"] < row["aim_mb"]
    assert 5 < row["salvage_mb"] < row["aim_mb"]
