"""Evaluate a stream: compare its decoded frames with the recording and with the ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from morgs_mi.capture.fingerprint import image_fingerprints
from morgs_mi.evaluate.comparison import ComparedClip
from morgs_mi.evaluate.lpips import Lpips
from morgs_mi.evaluate.measures import Motion3D, view_scores
from morgs_mi.evaluate.metrics import StillVariation, slope
from morgs_mi.evaluate.results import (
    Evaluation,
    FrameScores,
    PlaybackTimes,
    Sizes,
    VariationScores,
    ViewScores,
    known_mean,
)
from morgs_mi.platform.bounded import read_json
from morgs_mi.platform.checks import require
from morgs_mi.platform.files import REPORT
from morgs_mi.platform.interrupts import interrupts_raised
from morgs_mi.platform.progress import StepReport
from morgs_mi.playback.player import playback_speed
from morgs_mi.playback.stream_header import between_cameras
from morgs_mi.playback.streams import PlayableStream, open_stream

# Compression flickers: after a hundred frames half the pixels of a real recording have changed
# once.
_FALSE_ALARMS = 0.02


class _FitReport(NamedTuple):
    """Entry of a frame in the report of a fit."""

    seconds: float | None = None  # wall time
    num_missing: int = 0  # views without an image
    fingerprints: tuple[str, ...] = ()  # of the images, empty where missing


@interrupts_raised()
def evaluate_stream(
    out: str | Path,
    capture: str | Path | None = None,
    progress: StepReport | None = None,
    lpips: Lpips | None = None,
    any_recording: bool = False,
) -> Evaluation:
    """Decode a stream and compare it with its recording: in the held-out view, or otherwise in all
    training views.

    Args:
        out: stream file or its folder; seconds come from the ``report.json`` beside it.
        capture: recording; default is the capture that the stream was fitted to.
        progress: called with (frames done, frames in all).
        lpips: network for LPIPS; without one there is no LPIPS.
        any_recording: whether `capture` may be another recording by the same cameras than the one
            that was fitted.

    Returns:
        The scores of the clip, its frames and its views.

    Raises:
        FileNotFoundError: the stream or the capture is missing.
        ValueError: the stream is truncated, broken or empty, the stream was fitted to another
            capture or to other images of a frame, the network does not accept images of this size,
            or the true tracks are broken.
    """
    stream = open_stream(out)
    require(
        isinstance(stream, PlayableStream),
        stream.path,
        "expected the stream of a fit, to compare with the images that were fitted",
        "a file of Gaussians",
        "name the folder of a fit; `morgs-mi accuracy` compares renderings of such a file",
    )
    clip = ComparedClip.of(stream, capture, any_recording)
    recording = clip.recording
    fitted = _fitted(stream.path)
    false_alarms = _FALSE_ALARMS if recording.truth is None else 0
    variations = {view: StillVariation(recording.masks[view], false_alarms) for view in clip.views}
    motion = Motion3D(clip)
    rows: list[FrameScores] = []
    for frame in clip.frames():
        # Unknown without an image.
        views = {clip.cameras[view].name: ViewScores() for view in clip.views}
        for view in frame.views():
            views[view.camera.name] = view_scores(view, lpips)
            variations[view.index].add(view.rendered, view.recorded, view.moving)
        index = frame.state.frame
        report = fitted.get(index, _FitReport())
        pairs = zip(report.fingerprints, image_fingerprints(frame.recorded.images), strict=False)
        # An image may have been missing in the fit, or may be missing now.
        if not any_recording and any(a != b for a, b in pairs if a and b):
            raise ValueError(
                f"{recording.path}: expected the recording that {stream.path} was fitted to, got "
                f"other images in frame {index}; pass that capture (--capture), or compare with "
                "any recording (--any-recording)."
            )
        scores = ViewScores.mean(list(views.values()))
        was_fitted = report.num_missing < len(recording.views.train)
        row = FrameScores(
            index,
            frame.kind.name.lower(),
            frame.num_bytes,
            report.seconds,
            scores,
            motion.scores(frame),
            views,
            has_images=was_fitted and not np.isnan(scores.psnr),
        )
        rows.append(row)
        if progress is not None:
            progress(len(rows), len(clip.packets))
    num_bytes = stream.path.stat().st_size
    sizes = Sizes(
        file=num_bytes,
        overhead=num_bytes - sum(row.num_bytes for row in rows),
        per_frame=num_bytes / len(rows),
        per_keyframe=known_mean([row.num_bytes for row in rows if row.kind == "keyframe"]),
        per_residual=known_mean([row.num_bytes for row in rows if row.kind == "residual"]),
    )
    playback = playback_speed(stream, stream.cameras[clip.views[0]], clip.render)
    return Evaluation(
        stream=str(stream.path.resolve()),
        capture=str(recording.path.resolve()),
        held_out=bool(recording.test_views),
        between_cameras=between_cameras(stream),
        complete=len(rows) == stream.metadata.get("num_frames", len(rows)),
        regions="recorded change" if recording.truth is None else "true masks",
        sizes=sizes,
        variation=VariationScores.mean([each.result() for each in variations.values()]),
        playback=PlaybackTimes(**playback),
        psnr_slope=slope([row.scores.psnr for row in rows]),
        frames=tuple(rows),
    )


def _fitted(stream: Path) -> dict[int, _FitReport]:
    """Return the entries of the report beside the stream, by frame; none without a report."""
    path = stream.with_name(REPORT)
    if not path.is_file():
        return {}
    report = read_json(path)
    try:
        return {
            row["frame"]: _FitReport(
                float(row["seconds"]),
                len(row.get("missing_views", ())),
                tuple(row.get("fingerprints", ())),
            )
            for row in report["frames"]
        }
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(
            f"{path}: expected a fit's report, got a broken one ({error!r}); remove it."
        ) from None
