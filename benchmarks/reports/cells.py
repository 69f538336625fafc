"""Cells of a report, which are independent fits: one after the other in this process, or side by side on workers."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import mitsuba as mi

from morgs_mi.runs.cluster.executor import Workers, open_workers, wait_for
from morgs_mi.runs.cluster.tasks import installed, prepared

__all__ = ["OnWorkers", "run_cells"]

Name = TypeVar("Name")
Result = TypeVar("Result")
_LOG = logging.getLogger("morgs_mi")


@dataclass(frozen=True, kw_only=True)
class OnWorkers:
    """Base of the reports with fits that other processes can do."""

    workers: int | None = None
    """Number of processes on this machine for the fits, which share its cores; default: this process fits alone."""
    scheduler: str | None = None
    """Dask scheduler of the workers that do the fits, such as tcp://host:8786, or local."""

    @contextmanager
    def opened(self) -> Iterator[Workers | None]:
        """Yield the workers, None where none were asked for."""
        if self.workers is None and self.scheduler is None:
            yield None
            return
        with open_workers(self.scheduler, self.workers) as workers:
            yield workers


def run_cells(
    function: Callable[..., Result],
    cells: Mapping[Name, tuple[Any, ...]],
    workers: Workers | None,
    arrived: Callable[[Name, Result], None],
) -> dict[Name, Result]:
    """Return the result of each cell, in the order of the cells.

    Args:
        function: function of a module, without side effects.
        cells: its arguments for each cell, by name; workers see the files that they refer to.
        workers: from `open_workers`; None: this process runs one cell after the other.
        arrived: called in this process with the name and the result of each cell, as soon as it is there.

    Raises:
        OSError: a worker died several times, or the scheduler was lost.
    """
    results: dict[Name, Result] = {}
    if workers is None:
        for name, args in cells.items():
            results[name] = function(*args)
            arrived(name, results[name])
        return results
    about = str(mi.variant()), installed()

    async def run(name: Name, args: tuple[Any, ...]) -> None:
        results[name], messages = await workers.run(_run_on_worker, function, args, *about)
        for message in messages:
            _LOG.warning(message)
        arrived(name, results[name])

    async def run_all() -> None:
        async with asyncio.TaskGroup() as group:
            for name, args in cells.items():
                group.create_task(run(name, args))

    try:
        wait_for(run_all())
    except BaseExceptionGroup as errors:
        raise errors.exceptions[0] from None
    return {name: results[name] for name in cells}


def _run_on_worker(
    function: Callable[..., Result], args: tuple[Any, ...], variant: str, versions: tuple[tuple[str, str], ...]
) -> tuple[Result, list[str]]:
    """Return the result of a cell, and the warnings."""
    with prepared(variant, versions) as messages:
        return function(*args), messages
