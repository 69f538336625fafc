"""The demonstration: synthesise a clip, fit it with and without learned motion, evaluate both fits
and draw images.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.capture.outputs import check_output
from morgs_mi.capture.truth import GroundTruth
from morgs_mi.core.camera import Camera
from morgs_mi.core.types import Arrays
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.evaluate.results import ViewScores
from morgs_mi.extras.synth.synth_config import SynthConfig
from morgs_mi.extras.synth.synthesize import stored_settings, synthesize
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.io.video_writer import H264, write_video
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.platform.config import config_or_default
from morgs_mi.platform.environment import machine, versions
from morgs_mi.platform.files import REPORT, locked_folder, write_json
from morgs_mi.platform.progress import Progress, Report, StepReport
from morgs_mi.playback.export.frames import pad_to_even
from morgs_mi.playback.player import explained_image, render_stream
from morgs_mi.playback.stream_header import truth_for_camera
from morgs_mi.playback.streams import open_stream
from morgs_mi.playback.visualise import contact_sheet, label, side_by_side, to_uint8, write_png
from morgs_mi.runs.fit_capture import begin_as, stream_capture
from morgs_mi.runs.fit_files import stream_metadata

_COMPARED = (
    "psnr",
    "ssim",
    "motion_error",
    "motion_error_moving",
    "motion_error_still",
    "true_motion_moving",
)
# Shortest duration of the video in seconds; a short clip is played more slowly.
_LEAST_SECONDS = 3


@dataclass(frozen=True)
class DemoConfig:
    """Settings of the demonstration."""

    scene: str = "spheres"
    """Name or file of the scene."""
    clip: SynthConfig = field(default_factory=lambda: SynthConfig(cameras=10, frames=10, spp=16))
    """The path-traced clip, with the seed of the fit."""
    plain_frames: int = 5
    """Number of frames of the second fit, without learned motion, offset and confidence, for
    comparison.
    """
    stream: StreamConfig = field(
        default_factory=lambda: StreamConfig(
            fit=FitConfig(num_gaussians=20_000, first_frame_steps=750)
        )
    )
    """The fit, with a shortened, smaller first frame; its seed is also the clip's."""


def run_demo(
    out: str | Path, config: DemoConfig | None = None, progress: Report | None = None
) -> dict[str, Any]:
    """Synthesise a clip, fit it, write images and results of its held-out view into `out`, and
    return the content of ``report.json``.

    The folder contains ``capture/`` (reused if it has the same settings), ``stream/``,
    ``stream_plain/``, ``side_by_side.mp4`` (truth, render, motion, confidence),
    ``contact_sheet.png`` and ``report.json``.

    Args:
        out: the folder.
        config: the settings.
        progress: called with (step, done, total).

    Raises:
        ValueError: a setting is out of range, or `out` lies in a capture.
        OSError: a file cannot be written, another process writes into the folder, or ``capture``
            exists and is not a synthetic capture.
    """
    root = check_output(Path(out))
    config = config_or_default("run_demo()", config, DemoConfig())
    seconds: dict[str, float] = {}

    def run_step(name: str, work: Callable[[Progress], Any]) -> Any:
        """Return the result of a step's work, and store its time."""
        start = time.perf_counter()
        result = work(Progress(progress, name))
        seconds[name] = time.perf_counter() - start
        return result

    with locked_folder(root, "run_demo()"):
        capture = root / "capture"
        run_step("Path-tracing the clip", partial(_synthesize_clip, capture, config))
        run_step("Fitting", partial(_fit, load_capture(capture), root / "stream", config.stream))
        run_step("Fitting without ML, MO, MC", partial(_fit_plain, root, config))
        results = {
            name: run_step(f"Evaluating {folder}", partial(evaluate_stream, root / folder, None))
            for name, folder in (("full", "stream"), ("plain", "stream_plain"))
        }
        run_step("Drawing", partial(_draw, root, load_capture(capture)))
        # The frames that both fits have, without the first, which has no motion.
        count = min(result.num_frames for result in results.values())
        frames = [row.frame for row in results["full"].frames[1:count]]
        comparison: dict[str, Any] = {"frames": frames}
        for name, result in results.items():
            mean = ViewScores.mean([frame.scores for frame in result.frames[1:count]])
            comparison[name] = {score: getattr(mean, score) for score in _COMPARED}
        seconds["total"] = sum(seconds.values())
        report = {
            "config": asdict(config),
            "seed": config.stream.seed,
            "comparison": comparison,
            "seconds": seconds,
            "machine": machine(),
            "versions": versions(),
            **{name: result.as_dict() for name, result in results.items()},
        }
        write_json(root / REPORT, report)
        return report


def _fit(
    capture: Capture, out: Path, config: StreamConfig, progress: Progress, resume: bool = False
) -> None:
    def report(stage: str, done: float, total: float) -> None:
        progress.of(f"{progress.stage}: {stage.lower()}")(done, total)

    stream_capture(capture, out, config, resume, report)


def _fit_plain(root: Path, config: DemoConfig, progress: Progress) -> None:
    """Fit without motion, offset and confidence, from the first frame of the fit with them."""
    capture = load_capture(
        root / "capture", max_frames=min(config.plain_frames, config.clip.frames)
    )
    switches = {"learn_motion": False, "learn_offset": False, "learn_confidence": False}
    plain = replace(config.stream, motion=replace(config.stream.motion, **switches))
    # The first frame has no motion, so the settings of the motion change nothing.
    out = root / "stream_plain"
    metadata = stream_metadata(capture, next(capture.partial_frames()), plain)
    begin_as(root / "stream", out, capture, metadata)
    _fit(capture, out, plain, progress, resume=True)


def _synthesize_clip(folder: Path, config: DemoConfig, report: StepReport) -> None:
    """Path-trace the clip unless `folder` has it already; captures are written atomically, so it is
    complete.
    """
    clip = replace(config.clip, seed=config.stream.seed)
    settings = {"scene": config.scene, **clip.as_dict()}
    given_settings = {name: value for name, value in settings.items() if value is not None}
    if given_settings.items() <= stored_settings(folder).items():
        report(1, 1)
        return
    synthesize(config.scene, folder, clip, overwrite=True, progress=report)


def _draw(out: Path, capture: Capture, report: StepReport) -> None:
    """Write the video and the contact sheet."""
    camera = capture.cameras[capture.reference_view]
    truths = [_truth(capture, camera, frame) for frame in range(1, capture.num_frames)]
    motions = [truth.motion[truth.mask] for truth in truths]
    speeds = np.linalg.norm(np.concatenate([*motions, np.ones((1, 2))]), axis=1)
    scale = float(np.percentile(speeds, 95))  # px
    full = _panels(capture, out / "stream", scale)
    plain = _panels(capture, out / "stream_plain", scale, ", no ML, MO, MC")
    names = ("truth", "render", "motion", "confidence")
    rows = [side_by_side([panels[name] for name in names]) for panels in full]
    fps = min(capture.fps, len(rows) / _LEAST_SECONDS)
    write_video(out / "side_by_side.mp4", map(pad_to_even, rows), fps, H264)
    report(1, 2)
    # The contact sheet has three frames of the one fit, and one of the other, which does not learn
    # the confidence.
    last = len(plain) - 1
    frames = sorted({min(1, len(full) - 1), last, len(full) - 1})
    plain_panels = [panel for name, panel in plain[last].items() if name != "confidence"]
    sheet = [list(full[frame].values()) for frame in frames]
    sheet.append(plain_panels)
    write_png(out / "contact_sheet.png", contact_sheet(sheet))
    report(2, 2)


def _truth(capture: Capture, camera: Camera, frame: int) -> GroundTruth:
    """Return the ground truth of a frame, which a synthetic capture has."""
    truth = truth_for_camera(capture, camera, frame)
    assert truth is not None
    return truth


def _panels(capture: Capture, stream: Path, scale: float, note: str = "") -> list[Arrays]:
    """Return the labelled images of every frame of the held-out view by name; `note` is appended to
    the labels.
    """
    reader = open_stream(stream)
    view = capture.reference_view
    camera = reader.cameras[view]
    frames = []
    for frame, (index, images) in zip(
        capture.frames(), render_stream(reader, camera), strict=False
    ):
        picture = to_uint8(images["color"])
        truth_image = frame.images[view]
        panels = {
            "truth": label(truth_image, f"truth, frame {index}"),
            "render": label(picture, f"render{note}, {psnr(picture, truth_image):.2f} dB"),
            "error": explained_image("error", abs(picture / 255 - truth_image / 255)),
        }
        motion = _truth(capture, camera, index).motion
        panels["true motion"] = explained_image("motion", motion, scale, "true motion", truth_image)
        for name in ("motion", "confidence"):
            panels[name] = explained_image(name, images[name], scale, name + note, picture)
        frames.append(panels)
    return frames
