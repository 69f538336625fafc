"""The demonstration: a clip is path-traced, reconstructed with and without learned motion, judged and drawn."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.config import StreamConfig
from morgs_mi.core.files import write_json
from morgs_mi.evaluate.environment import machine, versions
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.evaluate.figures import motion_scale
from morgs_mi.export.frames import PLAYABLE, even
from morgs_mi.fit.config import FitConfig
from morgs_mi.io.video_writer import write_video
from morgs_mi.playback.player import channel_image, open_stream, render_stream, truth_for_camera
from morgs_mi.playback.visualise import contact_sheet, label, motion_legend, side_by_side, write_png
from morgs_mi.recorder import stream_capture
from morgs_mi.synth.synthesize import synthesize

__all__ = ["Clip", "DemoConfig", "run_demo"]

Progress = Callable[[str, float, float], None]
_COMPARED = ("psnr", "ssim", "motion_error", "motion_error_moving", "motion_error_still", "true_motion_moving")
# The eye sees errors of a tenth; these are smaller.
_ERROR_GAIN = 4
_LEAST_SECONDS = 3


@dataclass(frozen=True)
class Clip:
    """The clip that is path-traced; its fields are the arguments of `synthesize`."""

    num_cameras: int = 10
    """cam00 among them, which is held out."""
    num_frames: int = 10
    """Frames per camera."""
    width: int = 320
    """In pixels, even."""
    height: int = 240
    """In pixels, even."""
    spp: int = 16
    """Samples per pixel: noise like a good camera's."""
    fps: float = 30.0
    """Frames per second."""


@dataclass(frozen=True)
class DemoConfig:
    """What the demonstration does."""

    scene: str = "spheres"
    """Name or file of the scene."""
    clip: Clip = field(default_factory=Clip)
    """The recording."""
    plain_frames: int = 5
    """Frames that are fitted a second time without learned motion, offset and confidence, for comparison."""
    stream: StreamConfig = field(default_factory=lambda: StreamConfig(fit=FitConfig(first_frame_steps=600)))
    """The fit, its first frame cut short to be done within minutes; its seed is the clip's too."""


def run_demo(out: str | Path, config: DemoConfig | None = None, progress: Progress | None = None) -> dict[str, Any]:
    """Make a clip, fit it, and leave pictures and figures of its held-out view in `out`.

    ``capture/`` (kept if it is there and the same), ``stream/``, ``stream_plain/``, ``side_by_side.mp4`` (truth,
    render, motion, confidence), ``contact_sheet.png`` and ``report.json``.

    Args:
        out: the folder.
        config: what to do.
        progress: called with (stage, done, total).

    Returns:
        What ``report.json`` holds: `evaluate_stream` of both fits as ``full`` and ``plain``, ``comparison`` with
        their means over the same frames after the first, seconds per stage, machine, versions and seed.

    Raises:
        ValueError: a setting is out of range.
        OSError: something cannot be written, or ``capture`` exists and is no capture.
    """
    out, config, tell = Path(out), config or DemoConfig(), progress or (lambda stage, done, total: None)
    seconds: dict[str, float] = {}

    def stage(name: str, work: Callable[[Callable[[float, float], None]], Any]) -> Any:
        start = time.perf_counter()
        result = work(lambda done, total: tell(name, done, total))
        seconds[name] = time.perf_counter() - start
        return result

    def fit(folder: str, settings: StreamConfig, frames: int | None) -> Callable[..., Any]:
        capture = load_capture(out / "capture", max_frames=frames)
        shown = capture.num_frames
        return lambda tell: stream_capture(
            capture, out / folder, settings, lambda frame, step, steps: tell(frame + step / steps, shown)
        )

    stage("Path-tracing the clip", lambda tell: _clip(out / "capture", config, tell))
    off = {"learn_motion": False, "learn_offset": False, "learn_confidence": False}
    plain = replace(config.stream, motion=replace(config.stream.motion, **off))
    stage("Fitting", fit("stream", config.stream, None))
    stage("Fitting without ML, MO, MC", fit("stream_plain", plain, min(config.plain_frames, config.clip.num_frames)))
    results = {
        name: stage(f"Judging {folder}", lambda tell, folder=folder: evaluate_stream(out / folder, progress=tell))
        for name, folder in (("full", "stream"), ("plain", "stream_plain"))
    }
    stage("Drawing", lambda tell: _draw(out, load_capture(out / "capture"), tell))
    report = {
        "config": asdict(config),
        "seed": config.stream.seed,
        "comparison": _compared(results),
        "seconds": {**seconds, "total": sum(seconds.values())},
        "machine": machine(),
        "versions": versions(),
        **results,
    }
    write_json(out / "report.json", report)
    return report


def _clip(folder: Path, config: DemoConfig, tell: Callable[[float, float], None]) -> None:
    """Path-trace the clip, unless `folder` holds the same already: a capture's folder appears whole or not at all."""
    wanted = {"scene": config.scene, "seed": config.stream.seed, **asdict(config.clip)}
    try:
        about = json.loads((folder / "capture.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        about = {}
    if all(about.get(name) == value for name, value in wanted.items()):
        tell(1, 1)
        return
    settings = {**asdict(config.clip), "seed": config.stream.seed}
    synthesize(config.scene, folder, **settings, overwrite=True, progress=tell)


def _compared(results: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return both fits' means over the frames that both have, the first one left out, for nothing moves in it."""
    count = min(result["num_frames"] for result in results.values())
    rows = {name: result["frames"][1:count] for name, result in results.items()}
    return {"frames": [row["frame"] for row in rows["full"]]} | {
        name: {score: float(np.mean([row[score] for row in own])) if own else None for score in _COMPARED}
        for name, own in rows.items()
    }


def _draw(out: Path, capture: Capture, tell: Callable[[float, float], None]) -> None:
    """Write the video and the contact sheet."""
    scale = motion_scale(capture, capture.cameras[capture.test_view or 0])
    full = _panels(capture, out / "stream", scale)
    plain = _panels(capture, out / "stream_plain", scale, ", no ML, MO, MC")
    shown = ("truth", "render", "motion", "confidence")
    rows = [side_by_side([panels[name] for name in shown if name in panels]) for panels in full]
    # Slowed down where the clip would be over in a blink.
    write_video(out / "side_by_side.mp4", map(even, rows), min(capture.fps, len(rows) / _LEAST_SECONDS), PLAYABLE)
    tell(1, 2)
    last = len(plain) - 1
    chosen = [full[t] for t in sorted({min(1, len(full) - 1), last, len(full) - 1})]
    sheet = [list(panels.values()) for panels in chosen]
    # A confidence that was never learned says nothing.
    without = [panel for name, panel in plain[last].items() if name != "confidence"]
    sheet.append([*without, motion_legend(scale)])
    write_png(out / "contact_sheet.png", contact_sheet(sheet))
    tell(2, 2)


def _panels(capture: Capture, stream: Path, scale: float, note: str = "") -> list[dict[str, np.ndarray]]:
    """Return the pictures of every frame of the held-out view by name, labelled; `note` tells the fit."""
    reader, view = open_stream(stream), capture.test_view or 0
    camera = reader.cameras[view]
    frames = []
    for recorded, (index, images) in zip(capture.frames(), render_stream(reader, camera), strict=False):
        truth, picture = truth_for_camera(capture, camera, index), channel_image("color", images["color"])
        error = np.abs(picture.astype(float) - recorded.images[view]) * _ERROR_GAIN / 255
        panels = {"truth": recorded.images[view], "render": picture, "error": channel_image("color", error)}
        if truth is not None:
            panels["true motion"] = channel_image("motion", truth.motion, scale)
        panels |= {name: channel_image(name, images[name], scale) for name in _moving(images)}
        labels = {"truth": f"truth, frame {index}", "error": f"error x{_ERROR_GAIN}", "true motion": "true motion"}
        frames.append({name: label(panel, labels.get(name, name + note)) for name, panel in panels.items()})
    return frames


def _moving(images: Mapping[str, np.ndarray]) -> Sequence[str]:
    return [name for name in ("motion", "confidence") if name in images]
