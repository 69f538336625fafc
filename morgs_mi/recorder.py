"""From a recording to a stream file: the loop run over a capture, one whole packet after the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import mitsuba as mi

from morgs_mi.capture.capture import Capture
from morgs_mi.capture.rig_check import find_common, with_points
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.gaussians import restated
from morgs_mi.files import write_json
from morgs_mi.stream_loop import MIN_POINTS, FrameReport, StreamConfig, StreamLoop

__all__ = ["stream_capture"]


def stream_capture(
    capture: Capture,
    out: str | Path,
    config: StreamConfig | None = None,
    on_step: Callable[[int, int, int], None] | None = None,
) -> list[FrameReport]:
    """Fit a whole capture and write OUT/stream.morgs packet by packet, and OUT/report.json after every frame.

    OUT/capture.json says how the capture was read. One that comes with too few points gets them by triangulation.

    Args:
        capture: cameras and frames; its test view is not trained on, but stands in the stream's header.
        out: folder, made if missing.
        config: settings.
        on_step: called with (frame, steps done, steps of that frame).

    Raises:
        OSError: the disk is full or not writable; what stands in the stream up to then is whole.
        ValueError: as `StreamLoop`.
    """
    config, out = config or StreamConfig(), Path(out)
    if len(capture.points) < MIN_POINTS:
        capture = with_points(capture, find_common(capture))
    train = capture.train_views
    loop = StreamLoop(
        [capture.cameras[v] for v in train],
        capture.points,
        capture.point_colors,
        config,
        [capture.masks[v] for v in train],
    )
    metadata = {
        "capture": str(Path(capture.path).resolve()),
        "downscale": capture.downscale,
        "test_view": capture.test_view,
        "train_views": list(train),
        "num_frames": capture.num_frames,
        "key_views": [train[v] for v in loop.setup.key_views],
        "config": asdict(config),
        "versions": {"mitsuba": mi.__version__},
        "variant": mi.variant(),
    }
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "capture.json", capture.record())
    reports: list[FrameReport] = []
    with StreamWriter(out / "stream.morgs", capture.cameras, capture.fps, metadata) as writer:
        for frame in capture.frames():
            tick = None if on_step is None else _frame_ticker(on_step, frame.index)
            packet, report = loop.push([frame.images[v] for v in train], tick)
            reports.append(replace(report, num_bytes=writer.write(packet)))
            if report.frame and config.codec.keyframe_interval and report.frame % config.codec.keyframe_interval == 0:
                assert loop.state.coded is not None
                writer.write(restated(loop.state.coded))
            write_json(out / "report.json", {**metadata, "frames": [asdict(r) for r in reports]})
    return reports


def _frame_ticker(on_step: Callable[[int, int, int], None], frame: int) -> Callable[[int, int], None]:
    return lambda done, steps: on_step(frame, done, steps)
