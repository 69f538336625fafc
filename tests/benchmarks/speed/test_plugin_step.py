"""The benchmark of a step through `mi.render`."""

from __future__ import annotations

import pytest

from benchmarks.speed import plugin_step


@pytest.mark.slow
def test_measure__times_every_kind_of_step():
    row = plugin_step.measure(50, 32, 24, turns=1)
    assert all(
        row[name] > 0
        for name in ("update", "plugin", "rasterize", "cameras_together", "cameras_one_by_one")
    )
