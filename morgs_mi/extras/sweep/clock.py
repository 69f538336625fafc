"""The clock of a fit: when it ran, how long, and what else ran on the machine meanwhile."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from morgs_mi.platform.threads import usable_cores

# Share of the cores that other processes use at most on a machine that counts as quiet.
_QUIET = 0.1
# Counters of a core in /proc/stat: idle, and waiting for a disk; and the number of those that count
# all of its time. Those that follow are parts of the first two.
_IDLE = [3, 4]
_COUNTERS = 8
_UNKNOWN = float("nan")


@dataclass(frozen=True)
class Clock:
    """When and how fast a fit ran; NaN, or None in JSON, where the system does not know."""

    date: str = ""  #: When it began, ISO 8601.
    #: When the call that made it began. Fits of one call ran in turn, so their seconds compare.
    call: str = ""
    load: float = _UNKNOWN  #: Load average over a minute when the call began.
    wall_seconds: float = _UNKNOWN  #: Of the whole fit, with reading and writing.
    processor_seconds: float = _UNKNOWN  #: Of all its threads.
    #: Mean number of cores that others used meanwhile, also other virtual machines.
    other_cores: float = _UNKNOWN


def moment() -> str:
    """Return the time now, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def load_average() -> float:
    """Return the mean number of threads that ran or waited in the last minute."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else _UNKNOWN


def stopwatch(call: str, load: float) -> Callable[[], Clock]:
    """Start a clock, and return the function that stops it.

    Args:
        call: moment at which the call began.
        load: load average at that moment.
    """
    date = moment()
    begin = np.array([time.perf_counter(), time.process_time(), _busy_seconds()])

    def stop() -> Clock:
        end = np.array([time.perf_counter(), time.process_time(), _busy_seconds()])
        wall, processor, busy = (end - begin).tolist()
        other_cores = np.maximum(busy - processor, 0).item() / wall
        return Clock(date, call, load, wall, processor, other_cores)

    return stop


def _busy_seconds() -> float:
    """Return the seconds that all cores together have been busy since the machine started."""
    try:
        line = Path("/proc/stat").read_text(encoding="utf-8").splitlines()[0]
    except OSError:
        return _UNKNOWN
    counters = np.array(line.split()[1 : 1 + _COUNTERS], float)
    return float(counters.sum() - counters[_IDLE].sum()) / os.sysconf("SC_CLK_TCK")


def busy_sentence(clocks: Sequence[Clock]) -> str:
    """Return a sentence about a machine that was busy with other things while fits ran; empty if it
    was quiet, or if the system does not know.
    """
    cores = usable_cores()
    numbers = np.array([[clock.load, clock.other_cores] for clock in clocks], float)
    load, others = np.nan_to_num(numbers).reshape(-1, 2).max(0, initial=0)
    if max(load, others / _QUIET) <= cores:
        return ""
    return (
        f"The machine was busy: its load average was up to {load:.1f} before the fits, and others "
        f"used up to {others:.1f} of its {cores} cores meanwhile. Compare seconds with care."
    )
