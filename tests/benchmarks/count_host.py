"""Checks of `benchmarks.speed.host`, which replaces operators of Dr.Jit's arrays."""

import sys
from pathlib import Path

import mitsuba as mi
import numpy as np

from benchmarks.speed import frame_speed, host


def check(plot: Path) -> None:
    """Raise an error unless the counts of a tiny scene add up."""
    tiny = frame_speed.Size(64, 48, 3, 600, 2)
    rows = host.count_frame(tiny, epochs=1)
    total = rows["total"]
    assert total["operations"] == sum(total["types"].values())
    for name in ("operations", "reads", "uploads", "stops"):
        assert total[name] == sum(row[name] for stage, row in rows.items() if stage != "total")
    assert min(total["seconds"].values()) > 0
    for name in ("reads", "uploads"):
        assert rows["steps"][name] > 0
    with host.HostCounts() as counts:
        assert "reads" not in counts.read()
        np.asarray(mi.Float(1, 2, 3) + 0)
        assert counts.read()["reads"] == 1
        assert counts.read()["read_bytes"] == 12
    host.MANY_STEPS = 60
    rows[host.FIRST_STEP] = step = host.count_first_step(tiny)
    assert 30 < step["operations"] < 200
    assert host.FIRST_STEP in host.table(rows)
    host.save_figure(host.plot({"tiny": rows}), plot)
    assert plot.stat().st_size > 0


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    check(Path(sys.argv[1]))
