"""Contribution of the method's parts: presets by epochs, and key views with and without offset, over several seeds.

A *setting* is a preset, a number of epochs, a number of key views and a factor on the learning rates. It is measured
with several seeds; each seed has its own first frame, which all settings share. Tuned presets are run at several rates
with the first seed. The rate with the best mean PSNR of the held-out view over the later frames is selected, and the
other seeds are run at that rate only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from benchmarks.reports.flow import FlowReportConfig, report_flow
from benchmarks.reports.method_cells import (
    DEFAULT,
    Cell,
    Clip,
    Scores,
    fit_cells,
    method_version,
    scores_of,
    scratch_scores,
)
from benchmarks.reports.method_results import FlowError, MethodClip, MethodResult, ScratchRow, SettingRow
from morgs_mi.capture.capture import load_capture
from morgs_mi.cluster.executor import Workers
from morgs_mi.config import PRESETS, StreamConfig
from morgs_mi.evaluate.environment import machine, versions
from morgs_mi.fit.config import FitConfig

__all__ = ["MethodReportConfig", "report_method"]

# Rows of the paper's table of key views.
_WITHOUT_OFFSET, _WITH_OFFSET = "ml", "ml-mo"
_PAPER_EPOCHS = 8
_SCRATCH = 20


@dataclass(frozen=True)
class MethodReportConfig:
    """Settings of the report on the method."""

    presets: tuple[str, ...] = ("baseline", "ml", "ml-mo", "ml-mo-mc", "paper", DEFAULT)
    """Presets of morgs-mi fit; default means none."""
    epochs: tuple[int, ...] = (1, 2, 3, 5, 8, 12)
    """Passes over the views for every later frame."""
    key_views: tuple[int, ...] = (2, 4, 8, 12)
    """Compared numbers of key views, with and without offset; limited to the number of views."""
    rates: tuple[float, ...] = (1, 2, 4)
    """Factors on the learning rates of the tuned presets; the others have 1."""
    tuned: tuple[str, ...] = ("baseline", DEFAULT)
    """Tuned presets: run at all rates with the first seed."""
    seeds: int = 3
    """Number of runs of every setting."""
    frames: int | None = None
    """Maximum number of frames from the start."""
    num_gaussians: int = 10_000
    """Number of Gaussians of the first frame; overrides stream.fit."""
    scratch: int = 0
    """Number of frames of each clip that are also fitted from scratch, with 20 times the steps of 8 epochs."""
    version: str | None = None
    """Version of the method, default a digest of its sources; stored results of the same version are reused."""
    stream: StreamConfig = field(default_factory=StreamConfig)
    """Settings of the fit; presets, epochs, key views, rates and seeds override them."""

    def __post_init__(self) -> None:
        unknown = [name for name in (*self.presets, *self.tuned) if name not in (DEFAULT, *PRESETS)]
        if unknown or not self.presets:
            raise ValueError(
                f"MethodReportConfig(): `presets` and `tuned` must be among {', '.join((DEFAULT, *PRESETS))}, got "
                f"{', '.join(unknown) or 'none'}."
            )
        for name in ("epochs", "rates", "seeds", "num_gaussians"):
            values = np.atleast_1d(getattr(self, name))
            if not len(values) or not (values > 0).all():
                raise ValueError(f"MethodReportConfig(): `{name}` must be positive, got {getattr(self, name)}.")
        if self.scratch < 0 or any(count < 1 for count in self.key_views):
            raise ValueError("MethodReportConfig(): `scratch` must be at least 0 and `key_views` at least 1.")

    @property
    def base(self) -> StreamConfig:
        """Settings of the fit that all cells share."""
        fit = replace(self.stream.fit, num_gaussians=self.num_gaussians, epochs=FitConfig.epochs)
        return replace(self.stream, fit=fit)

    @property
    def table_epochs(self) -> int:
        """Number of epochs of the tables: the nearest to the paper's 8."""
        return min(self.epochs, key=lambda epochs: abs(epochs - _PAPER_EPOCHS))


def report_method(
    captures: Sequence[str | Path],
    out: str | Path,
    config: MethodReportConfig,
    progress: Callable[[str, float, float], None] = lambda *_: None,
    finished: Callable[[MethodResult], None] = lambda _: None,
    workers: Workers | None = None,
) -> MethodResult:
    """Fit every clip with every setting and seed, reusing stored results.

    Args:
        captures: folders of captures, two frames or more.
        out: folder that stores first frames and cells, so that an interrupted report continues.
        config: settings.
        progress: called with (stage, done, total).
        finished: called with the result so far after each clip.
        workers: from `open_workers`, which fit the cells side by side; None: this process fits them, one by one.

    Returns:
        One clip per capture, the settings, the machine and the versions.

    Raises:
        OSError: a capture cannot be read, or a result cannot be written.
        ValueError: there is no capture, two captures have the same name, a capture has a single frame, or a setting is
            incompatible with a preset.
    """
    names = [Path(path).resolve().name for path in captures]
    if not names or len(set(names)) < len(names):
        raise ValueError(
            f"report_method(): `captures` must be one folder or more with distinct names, got {', '.join(names)}."
        )
    version = config.version or method_version()
    result = MethodResult((), config.table_epochs, version, asdict(config), machine(), versions())
    for path in captures:
        result = replace(result, clips=(*result.clips, _clip(path, Path(out), config, version, progress, workers)))
        finished(result)
    return result


def cells_of(config: MethodReportConfig, num_views: int) -> tuple[list[Cell], list[Cell]]:
    """Return the first seed's cells of the presets, and those that compare numbers of key views; both may overlap."""
    usual = min(config.stream.motion.key_views, num_views)
    presets = [
        Cell(preset, epochs, usual, rate, seed=0)
        for epochs in config.epochs
        for preset in config.presets
        for rate in (config.rates if preset in config.tuned else (1.0,))
    ]
    key_views = [
        Cell(preset, config.table_epochs, views, 1.0, seed=0)
        for views in sorted({min(count, num_views) for count in config.key_views})
        for preset in (_WITHOUT_OFFSET, _WITH_OFFSET)
    ]
    return list(dict.fromkeys(presets)), key_views


def best_cells(found: Mapping[Cell, Scores]) -> set[Cell]:
    """Return the first seed's cells with the best rate for their preset, epochs and key views."""
    best: dict[Cell, Cell] = {}
    for cell in (cell for cell in found if cell.seed == 0):
        setting = replace(cell, rates=1.0)
        best[setting] = max(best.get(setting, cell), cell, key=lambda cell: found[cell]["psnr"])
    return set(best.values())


def aggregate(found: Mapping[Cell, Scores]) -> tuple[SettingRow, ...]:
    """Return one row per setting: mean and standard deviation of every score over the seeds."""
    best, groups = best_cells(found), dict[Cell, list[Scores]]()
    for cell, scores in found.items():
        groups.setdefault(replace(cell, seed=0), []).append(scores)
    rows = []
    for setting, runs in groups.items():
        names = [name for name in runs[0] if name != "by_frame"]
        table = {name: np.array([run[name] for run in runs], float) for name in names}
        by_frame = {
            name: np.mean([np.array(run["by_frame"][name], float) for run in runs], axis=0).tolist()
            for name in runs[0]["by_frame"]
        }
        rows.append(
            SettingRow(
                preset=setting.preset,
                epochs=setting.epochs,
                key_views=setting.key_views,
                rates=setting.rates,
                runs=len(runs),
                mean={name: float(values.mean()) for name, values in table.items()},
                std={name: _spread(values) for name, values in table.items()},
                by_frame={name: tuple(values) for name, values in by_frame.items()},
                best=setting in best,
            )
        )
    return tuple(rows)


def _clip(
    path: str | Path,
    out: Path,
    config: MethodReportConfig,
    version: str,
    progress: Callable[[str, float, float], None],
    workers: Workers | None,
) -> MethodClip:
    capture = load_capture(path, max_frames=config.frames)
    if capture.num_frames < 2:
        raise ValueError(f"{capture.path}: expected a capture of two frames or more, got {capture.num_frames}.")
    clip, base = Clip.read(capture), config.base
    presets, key_views = cells_of(config, len(capture.train_views))
    found = _measured(clip, presets, key_views, config, version, out, progress, workers)

    def rows_of(cells: Sequence[Cell]) -> tuple[SettingRow, ...]:
        return aggregate({cell: scores for cell, scores in found.items() if replace(cell, seed=0) in cells})

    steps = _SCRATCH * _PAPER_EPOCHS * len(capture.train_views)
    chosen = np.linspace(capture.num_frames - 1, 1, config.scratch + 1)[: config.scratch].round().astype(int)
    scratch: list[ScratchRow] = []
    for done, frame in enumerate(dict.fromkeys(chosen.tolist())):
        progress(f"Fitting {clip.name} from scratch", done, config.scratch)
        scratch.append(scratch_scores(clip, frame, base, steps, version, out))
    camera = capture.cameras[0]
    return MethodClip(
        name=clip.name,
        views=len(capture.cameras),
        frames=capture.num_frames,
        width=camera.width,
        height=camera.height,
        held_out=capture.test_view is not None,
        flow=_flow_error(path, config) if capture.truth is not None else None,
        scratch=tuple(scratch),
        rows=rows_of(presets),
        key_view_rows=rows_of(key_views),
    )


def _measured(
    clip: Clip,
    presets: Sequence[Cell],
    key_views: Sequence[Cell],
    config: MethodReportConfig,
    version: str,
    out: Path,
    progress: Callable[[str, float, float], None],
    workers: Workers | None,
) -> dict[Cell, Scores]:
    """Return the scores of the first seed's cells, and of the others' at the best rates and all key views."""
    found: dict[Cell, Scores] = {}

    def measure(cells: Sequence[Cell], seed: int) -> None:
        stage = f"Fitting {clip.name}" + (f", seed {seed + 1} of {config.seeds}" if seed else "")
        cells = [replace(cell, seed=seed) for cell in cells]
        if workers is not None:
            fit_cells(clip, cells, config.base, version, out, workers, lambda done: progress(stage, done, len(cells)))
        for done, cell in enumerate(cells):
            progress(stage, done, len(cells))
            found[cell] = scores_of(clip, cell, config.base, version, out)
        progress(stage, len(cells), len(cells))

    first = list(dict.fromkeys([*presets, *key_views]))
    measure(first, seed=0)
    later = best_cells({cell: found[cell] for cell in presets}) | set(key_views)
    # Seed by seed: after an interruption, a report with fewer seeds is complete.
    for seed in range(1, config.seeds):
        measure([cell for cell in first if cell in later], seed)
    return found


def _flow_error(path: str | Path, config: MethodReportConfig) -> FlowError:
    """Return the error of the flow that guides the motion."""
    motion = config.stream.motion
    flow = FlowReportConfig((motion.flow_method,), motion.key_views, config.frames)
    moving = report_flow([path], flow).clips[0].rows[0].moving
    return FlowError(moving.error, moving.reliable_error)


def _spread(values: np.ndarray) -> float:
    """Return the standard deviation of several runs; NaN for a single run."""
    return float(values.std(ddof=1)) if len(values) > 1 else float("nan")
