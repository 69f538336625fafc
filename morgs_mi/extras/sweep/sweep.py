"""Error against run time of a capture, and the parts of the method that it does not need.

An arm is the method with some settings, under a name. All arms of a seed whose settings agree in
the first frame continue the same fit of it, so they differ in later frames alone. Fits that are in
the folder of the results, of the same capture and with the same settings, are not made again.
"""

from __future__ import annotations

import base64
import html
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.util import find_spec
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from annotated_types import Ge

from morgs_mi.capture.capture import Capture
from morgs_mi.extras.sweep.clock import busy_sentence, moment
from morgs_mi.extras.sweep.fits import Arm, Fits, first_frame_config, fit_arms
from morgs_mi.extras.sweep.plot import draw_changes, draw_sweep
from morgs_mi.extras.sweep.report import (
    Table,
    ablation_name,
    leave_out_sentence,
    leave_out_tables,
    sweep_report,
)
from morgs_mi.extras.sweep.statistics import DECIDING, INDEX, SCORES, excess
from morgs_mi.extras.sweep.sweep_scores import SweepScores
from morgs_mi.extras.sweep.vary import Vary
from morgs_mi.loop.stream_config import PRESETS, PresetName, StreamConfig
from morgs_mi.platform.bounded import JsonObject
from morgs_mi.platform.checks import require
from morgs_mi.platform.config import (
    Count,
    NonNegative,
    apply_values,
    check_type,
    check_value,
    config_or_default,
)
from morgs_mi.platform.environment import machine, versions
from morgs_mi.platform.files import write_json
from morgs_mi.platform.interrupts import interrupts_raised
from morgs_mi.platform.plots import check_plot, save_plot
from morgs_mi.platform.progress import Progress, Report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PARTS = {
    "flow guidance": "motion.learn_motion = false",
    "flow loss": "fit.objective.flow_weight = 0.0",
    "offset": "motion.learn_offset = false",
    "confidence": "motion.learn_confidence = false",
    "masks": "fit.objective.mask_weight = 0.0\nfit.confidence_steps = 0",
    "propagation": "motion.propagate_motion = false",
    "search": "motion.search_motion = false",
    "refinement": "motion.refine_start = false",
    "density control": "fit.density.rounds = 0\nfit.density.later_frames = false",
    "SH above 0": "fit.sh_degree = 0",
    "exposure": 'fit.exposure = "off"',
    "active set": "fit.skip_static = false",
}
"""Parts of the method that can be left out, with the settings that do so. Without flow guidance,
the motion starts from zero as well.
"""
ConfigName = PresetName | Literal["default"]
"""Name of a config: a preset, or the defaults."""
CONFIGS: Mapping[str, JsonObject] = {"default": {}, **PRESETS}
"""Settings of each."""
_VARY = Vary()
_MEASURES = ("psnr", "psnr_moving", "ssim", "motion_error_moving", "lpips")


@dataclass(frozen=True, eq=False, repr=False)
class SweepResult(SweepScores):
    """Scores of fits of a capture by several arms. In a notebook it is tables and a plot.

    Attributes:
        tables: by their titles, lists of rows, the first with the names of the columns.
        sentence: sentences on the result, one a line.
        toml: settings that leave out the parts that the scene does not need, of `leave_out`.
    """

    tables: Mapping[str, Table] = field(default_factory=dict)
    sentence: str = ""
    toml: str = ""

    def plot(self, path: str | Path) -> None:
        """Draw the scores over the seconds, a curve for each config; of `leave_out`, the changes
        without each part.

        Raises:
            ValueError: as `check_plot`.
            OSError: the file cannot be written.
        """
        path = Path(path)
        check_plot(path)
        save_plot(path, self._figure(), "SweepResult.plot()")

    def __repr__(self) -> str:
        arms, seeds, _ = self.scores.shape
        return f"SweepResult({self.capture}, {arms} arms, {seeds} seeds)"

    def _figure(self) -> Figure:
        return draw_changes(self) if self.excess.size else draw_sweep(self)

    def _repr_html_(self) -> str:
        text = ""
        for title, table in self.tables.items():
            rows = "".join(f"<tr><td>{'<td>'.join(map(html.escape, row))}" for row in table)
            text += f"<table><caption>{html.escape(title)}</caption>{rows}</table>"
        with suppress(ImportError):
            data = BytesIO()
            self._figure().savefig(data)
            image = base64.b64encode(data.getvalue()).decode()
            text += f'<img alt="Scores" src="data:image/png;base64,{image}">'
        return f"{text}<pre>{html.escape(self.sentence)}\n{self.toml}</pre>"


@interrupts_raised()
def sweep(
    capture: Capture,
    configs: Sequence[ConfigName] | Mapping[str, StreamConfig] = ("baseline", "default"),
    vary: Vary = _VARY,
    seeds: int = 3,
    frames: int = 8,
    out: str | Path = "sweep",
    progress: Report | None = None,
) -> SweepResult:
    """Fit and evaluate a capture with several configs, numbers of steps of the first frame, of
    epochs of later frames, and seeds: error against run time.

    The cheapest fits come first, and all fits of a seed before those of the next one. After each of
    them, OUT/sweep.json has the result so far, with machine, load, settings and versions, and
    OUT/sweep.png its plot where matplotlib is installed. OUT/baseline-epochs4-seed0 etc. have the
    streams. Fits that are there, of the same capture and with the same settings, are not made
    again; others of these names are replaced.

    Args:
        capture: the capture.
        configs: names of presets, and "default" for the defaults; or settings by any name.
        vary: what is varied, and the measure.
        seeds: number of seeds 0, 1, ....
        frames: most frames that are fitted, from the first one, at least two.
        out: folder.
        progress: called with (stage, done, total).

    Example:
        >>> few = morgs_mi.StreamConfig(fit=morgs_mi.FitConfig(num_gaussians=5000))
        >>> result = morgs_mi.sweep(capture, {"default": morgs_mi.StreamConfig(), "few": few})
        >>> print(result.sentence)

    Raises:
        ValueError: a number is too small, a preset or the measure is unknown, or as
            `stream_capture`.
        OSError: as `stream_capture`.
    """
    if not isinstance(configs, Mapping):
        check_value("sweep()", "configs", tuple(configs), tuple[Literal[*CONFIGS], ...])
        configs = {name: apply_values(StreamConfig(), CONFIGS[name]) for name in configs}
    check_type("sweep()", "vary", vary, Vary)
    check_value("sweep()", "epochs", tuple(vary.epochs), tuple[Count, ...])
    check_value("sweep()", "first_frame_steps", tuple(vary.first_frame_steps), tuple[Count, ...])
    measure = vary.measure.partition(":")[0]
    check_value("sweep()", "measure", measure, Literal[_MEASURES])
    capture = _beginning(capture, frames, seeds)

    first_names: dict[StreamConfig, list[str]] = {}
    for name, config in configs.items():
        check_type("sweep()", "name of a config", name, str)
        check_type("sweep()", f"configs[{name!r}]", config, StreamConfig)
        first_config = _with_steps(first_frame_config(config), None)
        first_names.setdefault(first_config, []).append(name)
    arms = [
        Arm(" and ".join(names), _with_steps(config, steps), steps, first_alone=True)
        for steps, (config, names) in product(
            sorted({*vary.first_frame_steps}), first_names.items()
        )
    ]
    arms += [
        Arm(name, replace(config, fit=replace(config.fit, epochs=epochs)), epochs)
        for epochs, (name, config) in product(sorted({*vary.epochs}), configs.items())
    ]
    require(arms, "sweep()", "expected a config and something to vary", "none", "name some")
    points = [(arm.first_alone, arm.point) for arm in arms]
    reference = np.array([points.index(point) for point in points], int)  # the first arm there

    settings = _reading(capture)
    settings["configs"] = {name: asdict(config) for name, config in configs.items()}

    def write(fits: Fits) -> SweepResult:
        held_out = bool(capture.test_views)
        result = SweepResult(capture.path.name, held_out, arms, fits.scores, reference, measure)
        tables, sentence = sweep_report(result)
        result = replace(result, tables=tables, sentence=sentence)
        return _write_result(result, Path(out) / "sweep.json", fits, settings)

    stage = Progress(progress, "Fitting and evaluating")
    return write(fit_arms(arms, capture, seeds, Path(out), vary.measure, stage, write))


def _with_steps(config: StreamConfig, steps: int | None) -> StreamConfig:
    """Return settings with another number of steps of the first frame."""
    return replace(config, fit=replace(config.fit, first_frame_steps=steps))


def _beginning(capture: Capture, frames: int, seeds: int) -> Capture:
    """Return the first frames of a capture, at least two, so that there is a later one; check the
    number of seeds.
    """
    check_value("sweep()", "seeds", seeds, Count)
    check_value("sweep()", "frames", frames, Count)
    frames = min(frames, capture.num_frames)
    check_value("sweep()", "frames", frames, Annotated[int, Ge(2)])
    return replace(capture, num_frames=frames)


def _reading(capture: Capture) -> JsonObject:
    """Return how a capture was read, for the JSON of a result."""
    return {
        "num_frames": capture.num_frames,
        "downscale": capture.downscale,
        "test_views": capture.test_views,
    }


@interrupts_raised()
def leave_out(
    capture: Capture,
    tolerance: float = 0.05,
    seeds: int = 3,
    frames: int = 8,
    out: str | Path = "sweep",
    config: StreamConfig | None = None,
    progress: Report | None = None,
) -> SweepResult:
    """Fit and evaluate a capture without each of the `PARTS` of the method that `config` uses, and
    without all together that it does not need.

    A part is needed because of a score if the paired difference without it, of fits with the same
    seed and of the same first frame, exceeds twice its standard error over the seeds, and the
    tolerance: `tolerance` of the PSNR of the images or of their moving pixels, 5 % of the motion
    error, the bytes or the seconds of a later frame. Parts that act on the first frame have a fit
    of it of their own. See `morgs_mi.extras.sweep.statistics.excess` for the seconds, and for one
    seed.

    Parts may stand in for each other: while those that are not needed alone are needed together,
    the one that costs most PSNR stays in. Fits without several parts run in turn with further fits
    with all of them, so that their seconds can be compared.

    OUT/without-search-epochs8-seed0 etc. have the streams; OUT/leave-out.json and OUT/leave-out.png
    the result so far, as of `sweep`; and at the end OUT/leave-out.toml the settings that leave out
    what is not needed, for `fit --config`.

    Args:
        capture: the capture.
        tolerance: in dB.
        seeds: as for `sweep`, like all that follow.
        frames: most frames that are fitted.
        out: folder.
        config: settings with all parts.
        progress: called with (stage, done, total).

    Raises:
        ValueError: as `sweep`.
        OSError: as `sweep`.
    """
    config = config_or_default("leave_out()", config, StreamConfig())
    check_value("leave_out()", "tolerance", tolerance, NonNegative)
    capture = _beginning(capture, frames, seeds)
    stage = Progress(progress, "Fitting and evaluating")
    trial = _Trial(capture, config, tolerance, seeds, Path(out), stage, Fits.of(0, seeds))
    parts = [part for part in PARTS if _without([part], config) != config]
    result = trial.compare("all parts", [[part] for part in parts])
    changes = result.changes.mean[:, INDEX["psnr"]]
    # Parts that are not needed alone, with the change of the PSNR without each.
    spare = {part: changes[k] for k, part in enumerate(parts, 1) if not result.reasons[k]}
    while len(spare) > 1:
        # With all parts once more, so that seconds are of fits that ran in turn.
        result = trial.compare(f"all parts beside {len(spare)}", [list(spare)])
        if not result.reasons[-1]:
            break
        spare.pop(min(spare, key=spare.__getitem__))
    left_out = list(spare)
    toml = _toml(left_out)
    (Path(out) / "leave-out.toml").write_text(toml, encoding="utf-8")
    sentence = leave_out_sentence(result, left_out, tolerance)
    return trial.write(replace(result, sentence=sentence, toml=toml))


@dataclass
class _Trial:
    """Fits of a capture with all parts of a method, and without some of them."""

    capture: Capture  # the frames that are fitted
    config: StreamConfig  # settings with all parts
    tolerance: float  # as of `leave_out`, like those that follow
    seeds: int
    out: Path
    progress: Progress
    fits: Fits  # those so far
    arms: list[Arm] = field(default_factory=list)
    reference: np.ndarray = field(default_factory=partial(np.zeros, 0, int))  # as of `SweepScores`

    def compare(self, name: str, ablations: Sequence[Sequence[str]]) -> SweepResult:
        """Fit all parts, under a name, in turn with fits that lack some; return the result so
        far.
        """
        config = self.config
        epochs = config.fit.epochs
        arms = [Arm(name, config, epochs)]
        arms += [Arm(ablation_name(parts), _without(parts, config), epochs) for parts in ablations]
        self.reference = np.append(self.reference, np.full(len(arms), len(self.arms)))
        self.arms += arms
        earlier = self.fits

        def write(later: Fits) -> SweepResult:
            self.fits = earlier + later
            return self._write_scores()

        # Every round has a bar and a pace of its own.
        stage = self.progress.of(f"Fitting and evaluating {name}")
        return write(fit_arms(arms, self.capture, self.seeds, self.out, "psnr", stage, write))

    def _write_scores(self) -> SweepResult:
        """Write and return the result of the fits so far."""
        scores = self.fits.scores
        ratios = excess(scores, self.reference, self.fits.calls, self.tolerance)
        held_out = bool(self.capture.test_views)
        name = self.capture.path.name
        result = SweepResult(name, held_out, self.arms, scores, self.reference, excess=ratios)
        return self.write(replace(result, tables=leave_out_tables(result)))

    def write(self, result: SweepResult) -> SweepResult:
        """Write and return a result of the fits so far."""
        settings = _reading(self.capture)
        settings |= {"tolerance": self.tolerance}
        settings |= {"configs": {"all parts": asdict(self.config)}}
        return _write_result(result, self.out / "leave-out.json", self.fits, settings)


def _without(parts: Sequence[str], config: StreamConfig) -> StreamConfig:
    """Return settings without some parts."""
    return apply_values(config, tomllib.loads(_toml(parts)))


def _toml(parts: Sequence[str]) -> str:
    """Return the settings that leave out some parts."""
    return "".join(f"{PARTS[part]}\n" for part in parts)


def _write_result(result: SweepResult, path: Path, fits: Fits, settings: JsonObject) -> SweepResult:
    """Write a result as JSON, and as a plot where matplotlib is installed; return it with a
    sentence on a busy machine.

    Args:
        result: the result so far.
        path: of the JSON file; the plot is beside it.
        fits: the fits so far.
        settings: what was fitted and how.
    """
    sentence = f"{result.sentence}\n{busy_sentence(fits.clocks)}".strip()
    tables = {title: table for title, table in result.tables.items() if len(table) > 1}
    result = replace(result, sentence=sentence, tables=tables)
    changes = result.changes
    document = {
        "capture": result.capture,
        "held_out": result.held_out,
        "measure": result.measure,
        "date": moment(),
        "complete": bool(fits.calls.all()),
        "arms": result.names.tolist(),
        "points": result.points.tolist(),
        "score_names": list(SCORES),
        "scores": result.scores.tolist(),
        "reference": result.reference.tolist(),
        "changes": changes.mean.tolist(),
        "standard_errors": changes.error.tolist(),
        "deciding": DECIDING,
        "excess": result.excess.tolist(),
        "tables": result.tables,
        "sentence": result.sentence,
        "toml": result.toml,
        "clocks": [asdict(clock) for clock in fits.clocks],
        "settings": settings,
        "machine": machine(),
        "versions": versions(),
    }
    write_json(path, document)
    if find_spec("matplotlib"):
        result.plot(path.with_suffix(".png"))
    return result
