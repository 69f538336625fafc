"""The speed benchmark of files of Gaussians."""

from __future__ import annotations

from benchmarks.speed import splat_files


def test_measure__reports_times_and_sizes():
    row = splat_files.measure(200, width=64)
    assert (row["gaussians"], row["width"], row["height"]) == (200, 64, 36)
    assert all(row[name] > 0 for name in row)
