"""Cells of a report, which are independent fits: one after the other in this process, or side by
side on workers.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import mitsuba as mi

from morgs_mi.runs.cluster.workers import installed, open_client, prepared

if TYPE_CHECKING:
    from distributed import Client

Name = TypeVar("Name")
Result = TypeVar("Result")
_LOG = logging.getLogger("morgs_mi")


@dataclass(frozen=True, kw_only=True)
class OnWorkers:
    """Base of the reports with fits that other processes can do."""

    workers: int | None = None
    """Number of processes on this machine for the fits, which share its cores; default: this
    process fits alone.
    """
    scheduler: str | None = None
    """Dask scheduler of the workers that do the fits, such as tcp://host:8786."""

    @contextmanager
    def opened(self) -> Iterator[Client | None]:
        """Yield the client of the workers, None where none were asked for."""
        if self.workers is None and self.scheduler is None:
            yield None
            return
        with open_client(self.scheduler, self.workers) as client:
            yield client


def run_cells(
    function: Callable[..., Result],
    cells: Mapping[Name, tuple[Any, ...]],
    client: Client | None,
    arrived: Callable[[Name, Result], None],
) -> dict[Name, Result]:
    """Return the result of each cell, in the order of the cells.

    Args:
        function: function of a module, without side effects.
        cells: its arguments for each cell, by name; workers see the files that they refer to.
        client: from `open_client`; None: this process runs one cell after the other.
        arrived: called in this process with the name and the result of each cell, as soon as it is
            there.

    Raises:
        OSError: a worker died several times, or the scheduler was lost.
    """
    results: dict[Name, Result] = {}
    if client is None:
        for name, args in cells.items():
            results[name] = function(*args)
            arrived(name, results[name])
        return results
    from distributed import as_completed

    task = partial(_run_on_worker, function, str(mi.variant()), installed())
    futures = client.map(task, list(cells.values()), pure=False)
    names = {future.key: name for future, name in zip(futures, cells, strict=True)}
    for future in as_completed(futures, loop=client.loop):
        name = names[future.key]
        results[name], messages = future.result()
        for message in messages:
            _LOG.warning(message)
        arrived(name, results[name])
    return {name: results[name] for name in cells}


def _run_on_worker(
    function: Callable[..., Result],
    variant: str,
    versions: tuple[tuple[str, str], ...],
    args: tuple[Any, ...],
) -> tuple[Result, list[str]]:
    """Return the result of a cell, and the warnings."""
    with prepared(variant, versions) as messages:
        return function(*args), messages
