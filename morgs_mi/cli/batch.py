"""`morgs-mi batch`: many fits, side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.box import SIMPLE_HEAD
from rich.live import Live
from rich.table import Table
from tyro.conf import DisallowNone, Positional, arg

from morgs_mi.cli.console import ERR, print_result, print_table, print_warning, sentence_of
from morgs_mi.cli.settings import optional
from morgs_mi.core.documentation import page

if TYPE_CHECKING:
    from morgs_mi.runs.cluster.jobs import JobState

__all__ = ["Batch"]


@dataclass(frozen=True)
class Batch:
    """Fit many captures with many settings and seeds, side by side.

    Jobs that are finished are skipped, and others continue where they stopped.
    """

    jobs: Annotated[Positional[Path], arg(help=f"TOML file with captures, settings and seeds ({page('cluster')}).")]
    workers: Annotated[int | None, DisallowNone, optional("INT", "(default: one per core)")] = None
    """Number of processes on this machine, which share its cores and memory equally."""
    scheduler: Annotated[str | None, DisallowNone, optional("ADDRESS")] = None
    """Dask scheduler whose workers fit the jobs, such as tcp://host:8786, or local."""

    def run(self) -> None:
        from morgs_mi.core.files import write_json
        from morgs_mi.runs.cluster.executor import open_workers
        from morgs_mi.runs.cluster.jobs import read_jobs, run_batch

        jobs = read_jobs(self.jobs)
        with _noting_command(), open_workers(self.scheduler, self.workers) as workers, _shown() as show:
            states = run_batch(jobs, workers, show)
        summary = jobs[0].out.parent / "batch.json"
        write_json(summary, {"jobs": [_row(state) for state in states]})
        print_table(_table(states))
        print_result(f"All results: {summary}")
        failed = [state for state in states if state.error is not None]
        for state in failed:
            print_result(f"{state.job.name}: {_sentence(state)}")
        if failed:
            raise ValueError(f"{self.jobs}: {len(failed)} of {len(jobs)} jobs failed, see above.")


@contextmanager
def _noting_command() -> Iterator[None]:
    """Add to an interruption and to a lost scheduler how to continue."""
    try:
        yield
    except (KeyboardInterrupt, ConnectionError) as error:
        error.add_note("The jobs continue with the same command.")
        raise


@contextmanager
def _shown() -> Iterator[Callable[[Sequence[JobState]], None]]:
    """Show the jobs in a live table, or without a terminal a line when one ends."""
    if ERR.is_terminal:
        with Live(console=ERR, refresh_per_second=2, transient=True) as live:
            yield lambda states: live.update(_table(states))
        return
    ended: set[str] = set()

    def report(states: Sequence[JobState]) -> None:
        for state in states:
            if state.status in ("done", "failed") and state.job.name not in ended:
                ended.add(state.job.name)
                print_warning(f"{state.job.name}: {state.status}, {len(ended)} of {len(states)} jobs.")

    yield report


def _table(states: Sequence[JobState]) -> Table:
    """Return the jobs as a table."""
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("job", "status", "frames", "time", "left", "MB", "last worker"):
        table.add_column(column, justify="right" if column in ("frames", "time", "left", "MB") else "left")
    for state in states:
        left = state.seconds_left if state.status == "fitting" else None
        table.add_row(
            state.job.name,
            state.status,
            f"{state.frames}/{state.num_frames}" if state.num_frames else "",
            _clock(state.seconds),
            "" if left is None else _clock(left),
            f"{state.num_bytes / 1e6:.1f}" if state.num_bytes else "",
            state.worker,
        )
    return table


def _row(state: JobState) -> dict[str, object]:
    """Return the result of a job, for the summary."""
    return {
        "name": state.job.name,
        "capture": str(state.job.capture),
        "out": str(state.job.out),
        "seed": state.job.config.seed,
        "status": state.status,
        "frames": state.frames,
        "num_bytes": state.num_bytes,
        "seconds": state.seconds,
        "sentence": None if state.error is None else _sentence(state),
    }


def _sentence(state: JobState) -> str:
    assert state.error is not None
    return sentence_of(state.error, {})


def _clock(seconds: float) -> str:
    return str(timedelta(seconds=round(seconds)))
