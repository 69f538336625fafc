"""Contribution of the method's parts: presets by epochs, and key views with and without offset,
over several seeds.

    python -m benchmarks.reports method CAPTURE... --out out/method

A *setting* is a preset, a number of epochs, a number of key views and a factor on the learning
rates. It is measured with several seeds. Each seed has its own first frame, which depends on none
of these: it is fitted once, and all settings continue from it. Tuned presets are run at several
rates with the first seed. The rate with the best mean PSNR of the held-out view over the later
frames is selected, and the other seeds are run at that rate only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from tyro.conf import Positional

from benchmarks.reports.fits import DEFAULT, Clip, new_loop
from benchmarks.reports.method_tables import gains_table, plot_method
from benchmarks.reports.plots import grouped
from benchmarks.reports.study import Row, Scene, Study, Variant
from benchmarks.speed.output import Output
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.capture.truth import load_truth
from morgs_mi.codec.container import Packet
from morgs_mi.core.rig import choose_key_views
from morgs_mi.evaluate.results import known_mean
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.loop.stream_config import StreamConfig, apply_preset
from morgs_mi.method.flow import observe_key_views
from morgs_mi.method.flow_sources.flow_registry import FramePair
from morgs_mi.platform.files import json_finite

# Rows of the paper's table of key views.
_WITHOUT_OFFSET = "ml"
_WITH_OFFSET = "ml-mo"
_PAPER_EPOCHS = 8
_PATHS = "captures", "out"  # options on which no figure depends
_SETTING = "preset", "epochs", "key_views", "rates"
# Scores that are averaged over the later frames; `by_frame` has those that are plotted over time.
_MEANS = ("psnr", "psnr_moving", "psnr_still", "ssim", "motion_error_moving", "motion_error_still")
_MEANS += ("true_motion_moving", "confidence_iou")
_BY_FRAME = ("psnr", "psnr_moving", "motion_error_moving")
_MOTION_3D = ("error", "relative_error", "length_ratio", "angle")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measure the method's parts, key views, and quality over run time, with several seeds."""

    captures: Positional[tuple[Path, ...]]
    """Folders of captures."""
    out: Path = Path("out/method")
    """Output folder for method.json and, with matplotlib, method.png."""
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
    stream: StreamConfig = field(default_factory=StreamConfig)
    """Settings of the fit; presets, epochs, key views, rates and seeds override them."""

    @property
    def base(self) -> StreamConfig:
        """Settings of the fit that all cells share."""
        fit = replace(self.stream.fit, num_gaussians=self.num_gaussians, epochs=FitConfig.epochs)
        return replace(self.stream, fit=fit)

    @property
    def table_epochs(self) -> int:
        """Number of epochs of the tables: the nearest to the paper's 8."""
        return min(self.epochs, key=lambda epochs: abs(epochs - _PAPER_EPOCHS))

    def run(self) -> None:
        """Fit every clip with every setting and seed, and write the results so far after each clip.

        Raises:
            OSError: a capture cannot be read, or a result cannot be written.
            ValueError: a setting is incompatible with a preset.
        """
        clips = []
        settings = {n: v for n, v in asdict(self).items() if n not in _PATHS}
        for path in self.captures:
            clips.append(measure(path, self))
            result = {"clips": clips, "table_epochs": self.table_epochs, "settings": settings}
            Output(self.out / "method.json").write(result, unprinted=["clips", "settings"])
            if find_spec("matplotlib"):
                plot_method(clips, self.out / "method.png")
        print(f"{gains_table(clips)}\nAll figures: {self.out / 'method.json'}")


def measure(path: Path, options: Options) -> dict[str, Any]:
    """Return the results of one clip."""
    capture = load_capture(path, max_frames=options.frames)
    presets, key_views = variants_of(options, len(capture.train_views))
    variants = [*presets, *(v for v in key_views if v not in presets)]
    rows = fitted(capture, variants, presets, options)
    camera = capture.cameras[0]
    return {
        "name": capture.path.resolve().name,
        "views": len(capture.cameras),
        "frames": capture.num_frames,
        "width": camera.width,
        "height": camera.height,
        "held_out": bool(capture.test_views),
        "cue": flow_error(capture, options.stream) if capture.truth is not None else None,
        "rows": aggregate(rows, presets),
        "key_view_rows": aggregate(rows, key_views),
    }


def variants_of(options: Options, num_views: int) -> tuple[list[Variant], list[Variant]]:
    """Return the settings of the presets, and those that compare numbers of key views; both may
    overlap.
    """

    def variant(preset: str, epochs: int, key_views: int, rates: float) -> Variant:
        keys = {"preset": preset, "epochs": epochs, "key_views": key_views, "rates": rates}
        return Variant(keys, settings_of(options.base, **keys))

    usual = options.stream.motion.key_views
    assert isinstance(usual, int)
    usual = min(usual, num_views)
    presets = [
        variant(preset, epochs, usual, rates)
        for epochs in options.epochs
        for preset in options.presets
        for rates in (options.rates if preset in options.tuned else (1.0,))
    ]
    key_views = [
        variant(preset, options.table_epochs, views, 1.0)
        for views in sorted({min(count, num_views) for count in options.key_views})
        for preset in (_WITHOUT_OFFSET, _WITH_OFFSET)
    ]
    return presets, key_views


def settings_of(
    base: StreamConfig, preset: str, epochs: int, key_views: int, rates: float
) -> StreamConfig:
    """Return `base` with a setting; `rates` is a factor on all learning rates of later frames."""
    if preset != DEFAULT:
        base = apply_preset(base, preset)  # pyright: ignore[reportArgumentType]
    new_rates = {name: rates * rate for name, rate in asdict(base.fit.rates).items()}
    fit = replace(base.fit, epochs=epochs, rates=replace(base.fit.rates, **new_rates))
    return replace(base, fit=fit, motion=replace(base.motion, key_views=key_views))


def fitted(
    capture: Capture, variants: Sequence[Variant], presets: Sequence[Variant], options: Options
) -> list[Row]:
    """Return the rows of all variants with the first seed, and of the others at the best rates and
    all key views.
    """
    clip = Clip.read(capture)
    rows = list[Row]()
    for seed in range(options.seeds):
        config = replace(options.base, seed=seed)
        keyframe, _ = new_loop(capture, config).push(clip.images[0])
        if seed:
            best = [row for row in aggregate(rows, presets) if row["best"]]
            choice = [
                v for v in variants if v not in presets or v.keys in [_setting(row) for row in best]
            ]
        else:
            choice = variants
        rows += Study(later_frames, [Scene({}, (clip, keyframe))], choice, (seed,)).run()
    return rows


def aggregate(rows: Sequence[Row], variants: Sequence[Variant]) -> list[dict[str, Any]]:
    """Return one row per variant: mean and standard deviation of every score over the seeds.

    `best` marks the rates of the first run with the best mean PSNR for their preset, epochs and key
    views.
    """
    keys = [variant.keys for variant in variants]
    groups = [group for group in grouped(rows, *_SETTING).values() if _setting(group[0]) in keys]
    best: dict[tuple[Any, ...], Row] = {}
    for first in (group[0] for group in groups):
        setting = first["preset"], first["epochs"], first["key_views"]
        best[setting] = max(best.get(setting, first), first, key=lambda row: row["psnr"])
    means = []
    for group in groups:
        names = [name for name in group[0] if name not in (*_SETTING, "fit_seed", "by_frame")]
        table = {name: np.array([row[name] for row in group], float) for name in names}
        by_frame = [row["by_frame"] for row in group]
        series = {
            name: np.mean([np.array(row[name], float) for row in by_frame], axis=0)
            for name in by_frame[0]
        }
        spread = len(group) > 1
        row = {
            **_setting(group[0]),
            "runs": len(group),
            "mean": {name: float(values.mean()) for name, values in table.items()},
            "std": {name: float(v.std(ddof=1)) if spread else None for name, v in table.items()},
            "by_frame": {name: values.tolist() for name, values in series.items()},
            "best": any(group[0] is row for row in best.values()),
        }
        means.append(json_finite(row))
    return means


def _setting(row: Row) -> dict[str, Any]:
    return {name: row[name] for name in _SETTING}


def later_frames(clip: Clip, keyframe: Packet, config: StreamConfig) -> dict[str, Any]:
    """Fit all later frames after the packet of the first one, and return their scores.

    Returns:
        Means over the later frames in the held-out view (or all training views): ``psnr``,
        ``psnr_moving``, ``psnr_still`` in dB, ``ssim``, ``motion_error_moving`` and ``_still`` and
        ``true_motion_moving`` in px, ``confidence_iou``, ``motion_3d_error`` in world units,
        ``_relative_error`` and ``_length_ratio`` of the true length, ``_angle`` in degrees,
        ``num_bytes``; ``mtv`` and ``mtv_input`` (x100), ``psnr_slope`` in dB per frame,
        ``seconds``, the median of a later frame; ``by_frame``, lists of some of them. None if
        unknown.
    """
    fit = clip.continued(keyframe, config)
    frames = fit.evaluation.frames[1:]
    motion = [row.motion_3d for row in frames if row.motion_3d is not None]
    series = {name: [getattr(row.scores, name) for row in frames] for name in _MEANS}
    series |= {f"motion_3d_{name}": [getattr(row, name) for row in motion] for name in _MOTION_3D}
    series["num_bytes"] = [row.num_bytes for row in frames]
    return {
        **{name: known_mean(values) for name, values in series.items()},
        "mtv": fit.evaluation.variation.render,
        "mtv_input": fit.evaluation.variation.input,
        "psnr_slope": fit.evaluation.psnr_slope,
        "seconds": float(np.median([report.seconds for report in fit.reports])),
        "by_frame": {name: series[name] for name in _BY_FRAME},
    }


def flow_error(capture: Capture, config: StreamConfig) -> dict[str, float]:
    """Return the mean error of the flow that guides the motion on the key views where the surface
    moves, px.
    """
    assert capture.truth is not None
    motion = config.motion
    errors = []
    for previous, frame in pairwise(capture.frames()):
        for view in choose_key_views(capture.cameras, motion.key_views):
            camera = capture.cameras[view].name
            images = frame.images[view], previous.images[view]
            pair = FramePair(*images, camera, frame.index, capture.masks[view])
            flow = observe_key_views({view: pair}, motion.flow_method, flow=motion.flow)[view]
            truth = load_truth(capture.truth, camera, frame.index)
            errors.append(np.linalg.norm(flow.motion - truth.motion, axis=-1)[truth.mask])
    return {"error": float(np.concatenate(errors).mean())}
