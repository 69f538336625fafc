"""Studies: fits of scenes in variants of the settings with several seeds, and the table of their
scores.

A *cell* is a scene in a variant with a seed. Its *row* in the JSON has the keys of the scene and of
the variant, the seed, and the scores that the measure returns. A report describes its study as
data::

    scenes = [Scene({"seed": 3}, (capture,))]
    Study(measure, scenes, variants=[Variant({}, StreamConfig())], seeds=(0, 1, 2))

and its options (`StudyOptions`) fit the cells, print the table, and write the rows with the
settings, the commit, the date, the machine and the versions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from numbers import Integral, Real
from typing import Any

import mitsuba as mi

from benchmarks.speed.output import Output
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.platform.files import json_finite

Row = Mapping[str, Any]
_SHOWN = 300  # characters of a cell's scores that are printed
# Options on which no figure depends.
_PATHS = ("json", "clips", "capture", "silhouettes", "plot")


@dataclass(frozen=True)
class Scene:
    """A recording of a study.

    Attributes:
        keys: entries of its rows.
        args: first arguments of the measure, such as the capture.
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
    """

    measure: Callable[..., Row | Sequence[Row]]
    scenes: Sequence[Scene]
    variants: Sequence[Variant] = (Variant({}, StreamConfig()),)
    seeds: Sequence[int] = (0,)

    def run(self) -> list[Row]:
        """Return the rows of all cells, in the order of scenes, variants and seeds."""
        rows = list[Row]()
        for scene, variant, seed in product(self.scenes, self.variants, self.seeds):
            keys = {**scene.keys, **variant.keys, "fit_seed": seed}
            result = self.measure(*scene.args, replace(variant.config, seed=seed))
            scores = json_finite(rounded(result))
            name = ", ".join(f"{key} {value}" for key, value in keys.items())
            print(f"{name}: {str(scores)[:_SHOWN]}", flush=True)
            rows += [{**keys, **row} for row in (scores if isinstance(scores, list) else [scores])]
        return rows


@dataclass(frozen=True)
class StudyOptions(Output):
    """Base of the options of a study: seeds, work and output."""

    fit_seeds: tuple[int, ...] = (0,)
    """Seeds of the fits of each scene."""

    def study(self) -> Study:
        """Return the study; clips that are missing are made."""
        raise NotImplementedError

    def table(self, rows: Sequence[Row]) -> str:
        """Return the rows as a table in Markdown."""
        raise NotImplementedError

    def run(self) -> list[Row]:
        """Run the study, print its table, write its rows, and return them."""
        mi.set_variant("llvm_ad_rgb")
        rows = self.study().run()
        print(self.table(rows))
        self.write({"settings": self.settings(), "fits": rows}, unprinted=["settings", "fits"])
        return rows

    def settings(self) -> dict[str, Any]:
        """Return the options on which the figures depend."""
        return {name: value for name, value in asdict(self).items() if name not in _PATHS}


def rounded(scores: Any) -> Any:
    """Return scores with five significant digits of each number that is no integer."""
    if isinstance(scores, Mapping):
        return {name: rounded(value) for name, value in scores.items()}
    if isinstance(scores, list | tuple):
        return [rounded(value) for value in scores]
    if isinstance(scores, Integral):
        return int(scores)
    return float(f"{float(scores):.5g}") if isinstance(scores, Real) else scores
