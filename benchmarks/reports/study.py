"""Studies: fits of scenes in variants of the settings with several seeds, and the table of their
scores.

A *cell* is a scene in a variant with a seed. Its *row* in the JSON has the keys of the scene and of
the variant, the seed, and the scores that the measure returns. A report describes its study as
data::

    scenes = [Scene({"seed": 3}, (source,))]
    Study(measure, scenes, variants=[Variant({}, StreamConfig())], seeds=(0, 1, 2))

and its options (`StudyOptions`) fit the missing cells, in this process or on workers, print the
table, and write the rows with the settings, the commit, the date, the machine and the versions.
"""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import product
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mitsuba as mi

import morgs_mi
from benchmarks.reports.cells import OnWorkers, run_cells
from benchmarks.speed.output import Output
from morgs_mi.core.files import json_finite, write_json
from morgs_mi.loop.stream_config import StreamConfig

if TYPE_CHECKING:
    from distributed import Client

Row = Mapping[str, Any]
_SHOWN = 300  # characters of a cell's scores that are printed
# Options for the paths of files and for the processes that fit.
_WORK = ("json", "workers", "scheduler", "store", "plot", "clips", "captures", "model", "pictures")


@dataclass(frozen=True)
class Scene:
    """A recording of a study.

    Attributes:
        keys: entries of its rows.
        args: first arguments of the measure, such as the `Source` of the recording.
    """

    keys: Row
    args: tuple[Any, ...]


@dataclass(frozen=True)
class Variant:
    """Settings of a study.

    Attributes:
        keys: entries of its rows.
        config: last argument of the measure, in which the seed is replaced.
    """

    keys: Row
    config: StreamConfig


@dataclass(frozen=True)
class Study:
    """Fits of scenes in variants of the settings with several seeds.

    Attributes:
        measure: function of a module, called with the arguments of a scene and the settings;
            returns the scores of a cell, or several rows of them.
        scenes: recordings.
        variants: settings.
        seeds: seeds of the fits of each scene and variant.
        seed_key: key of the seed in the rows.
    """

    measure: Callable[..., Row | Sequence[Row]]
    scenes: Sequence[Scene]
    variants: Sequence[Variant] = (Variant({}, StreamConfig()),)
    seeds: Sequence[int] = (0,)
    seed_key: str = "fit_seed"

    def run(self, client: Client | None, store: Path | None = None) -> list[Row]:
        """Return the rows of all cells, in the order of scenes, variants and seeds.

        Args:
            client: from `open_client`; None: this process fits one cell after the other.
            store: folder of the scores of finished cells, which are not fitted again while the
                version of the method, the settings and the files of the scene stay as they are;
                None: all cells are fitted.

        Raises:
            OSError: a worker died several times, the scheduler was lost, or a score cannot be
                stored.
        """
        cells = {}
        keys = {}
        for scene, variant, seed in product(self.scenes, self.variants, self.seeds):
            cell_keys = {**scene.keys, **variant.keys, self.seed_key: seed}
            name = ", ".join(f"{key} {value}" for key, value in cell_keys.items())
            cells[name] = (*scene.args, replace(variant.config, seed=seed))
            keys[name] = cell_keys
        files = (
            {name: self.stored_file(store, args) for name, args in cells.items()} if store else {}
        )
        results_by_name = {
            name: json.loads(file.read_text("utf-8"))
            for name, file in files.items()
            if file.is_file()
        }

        def arrived(name: str, result: Any) -> None:
            results_by_name[name] = json_finite(rounded(result))
            print(f"{name}: {str(results_by_name[name])[:_SHOWN]}", flush=True)
            if store:
                write_json(files[name], results_by_name[name])

        run_cells(
            self.measure,
            {n: args for n, args in cells.items() if n not in results_by_name},
            client,
            arrived,
        )
        results = {
            name: results_by_name[name]
            if isinstance(results_by_name[name], list)
            else [results_by_name[name]]
            for name in cells
        }
        return [{**keys[name], **row} for name, rows in results.items() for row in rows]

    def stored_file(self, store: Path, args: tuple[Any, ...]) -> Path:
        """Return the file of a cell's scores. Its name has a digest of all that the scores depend
        on.
        """
        files = [
            state
            for value in args
            if (path := getattr(value, "path", None))
            for state in _files(Path(path))
        ]
        name = f"{self.measure.__module__}.{self.measure.__qualname__}"
        parts = method_version(), name, args, files
        return store / f"{name}-{hashlib.sha256(repr(parts).encode()).hexdigest()[:16]}.json"


@dataclass(frozen=True)
class StudyOptions(Output, OnWorkers):
    """Base of the options of a study: seeds, work and output."""

    fit_seeds: tuple[int, ...] = (0,)
    """Seeds of the fits of each scene."""
    store: Path | None = None
    """Folder of finished fits, with which an interrupted report continues."""

    def study(self) -> Study:
        """Return the study; clips that are missing are made."""
        raise NotImplementedError

    def table(self, rows: Sequence[Row]) -> str:
        """Return the rows as a table in Markdown."""
        raise NotImplementedError

    def run(self) -> None:
        """Run the study, print its table, and write its rows."""
        mi.set_variant("llvm_ad_rgb")
        with self.opened() as client:
            rows = self.study().run(client, self.store)
        print(self.table(rows))
        self.write({"settings": self.settings(), "fits": rows}, unprinted=["settings", "fits"])

    def settings(self) -> dict[str, Any]:
        """Return the options on which the figures depend."""
        return {name: value for name, value in asdict(self).items() if name not in _WORK}


def rounded(scores: Any) -> Any:
    """Return scores with five significant digits of each number that is no integer."""
    if isinstance(scores, Mapping):
        return {name: rounded(value) for name, value in scores.items()}
    if isinstance(scores, list | tuple):
        return [rounded(value) for value in scores]
    if isinstance(scores, Integral):
        return int(scores)
    return float(f"{float(scores):.5g}") if isinstance(scores, Real) else scores


@cache
def method_version(
    folders: tuple[Path, ...] = (Path(morgs_mi.__file__).parent, Path(__file__).parent),
) -> str:
    """Return a digest of the sources of the package and of the reports. Layout and comments do not
    count.
    """
    files = sorted(file for folder in folders for file in folder.rglob("*.py"))
    sources = [ast.dump(ast.parse(file.read_text(encoding="utf-8"))) for file in files]
    return hashlib.sha256("".join(sources).encode()).hexdigest()[:16]


def _files(folder: Path) -> list[tuple[str, int, int]]:
    """Return path, size and time of change of each file of a capture."""
    states = (
        (path.relative_to(folder), path.stat())
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    )
    return [(str(path), state.st_size, state.st_mtime_ns) for path, state in states]
