"""3D point tracks of a stream, compared with the true ones of its recording."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.capture.timeline import read_settings
from morgs_mi.codec.frame_source import FrameSource, play
from morgs_mi.core.camera import Camera
from morgs_mi.core.fit_names import CAPTURE
from morgs_mi.core.rig import scene_extent
from morgs_mi.evaluate.comparison import ComparedClip
from morgs_mi.evaluate.measures import Measure
from morgs_mi.evaluate.results import TrackingScores
from morgs_mi.playback.player import render
from morgs_mi.playback.stream_header import render_config
from morgs_mi.studio.measures.point_tracks import seen_in_depth, track_points
from morgs_mi.studio.measures.track_scores import (
    DYNAMIC_3D_GAUSSIANS,
    MVTRACKER,
    TAPVID3D,
    Comparison,
    score_tracks,
)
from morgs_mi.studio.measures.track_truth import TrackTruth, synthetic_tracks, tapvid3d_tracks


class Tracking(Measure):
    """3D point tracks, see `evaluate_tracks`."""

    def __init__(self, clip: ComparedClip) -> None:
        self._clip = clip

    def result(self) -> dict[str, Any]:
        return {
            "tracking": evaluate_tracks(self._clip.stream, self._clip.recording, self._clip.views)
        }


def evaluate_tracks(
    stream: FrameSource, recording: Capture, views: Sequence[int]
) -> tuple[TrackingScores, ...]:
    """Return the scores of a stream's point tracks by each protocol; empty without true tracks or a
    second frame.

    Queries are the true points at the frames where their tracks start. In a synthetic capture, each
    of `views` is a video of TAPVid-3D's protocol; in the other protocols a point is visible if a
    training view sees it. Annotations of TAPVid-3D know the visibility in their own view only,
    which all protocols then use.

    Args:
        stream: the file.
        recording: its capture. Its `capture.json` may state `meters_per_unit`, 1 by default.
        views: the views that are evaluated.

    Raises:
        ValueError: a packet, an annotation or the true tracks are broken.
    """
    single = _videos(recording, views)
    if not single:
        return ()
    joint = synthetic_tracks(recording, recording.train_views)
    frames = stream.frame_numbers()
    videos = [_during(video, frames) for video in (*single, *joint)]
    if len(frames) < 2 or not any(len(video.points) for video in videos):
        return ()
    comparisons = _compared(stream, videos, frames[0])
    return _scores(recording, comparisons[: len(single)], comparisons[len(single) :] or comparisons)


def _videos(recording: Capture, views: Sequence[int]) -> list[TrackTruth]:
    """Return the true tracks in single views."""
    videos = [video for view in views for video in synthetic_tracks(recording, [view])]
    return videos or tapvid3d_tracks(recording)


def _scores(
    recording: Capture, single: Sequence[Comparison], joint: Sequence[Comparison]
) -> tuple[TrackingScores, ...]:
    """Return the scores by each protocol.

    Args:
        recording: the capture.
        single: the videos of single views.
        joint: the videos in which several views see as one.
    """
    scale = read_settings(recording.path / CAPTURE).get("meters_per_unit") or 1
    extent = scene_extent([recording.cameras[view] for view in recording.train_views])
    protocols = ((TAPVID3D, single), (DYNAMIC_3D_GAUSSIANS, joint), (MVTRACKER, joint))
    return tuple(score_tracks(protocol, videos, scale, extent) for protocol, videos in protocols)


def _during(video: TrackTruth, frames: Sequence[int]) -> TrackTruth:
    """Return the part of true tracks in the consecutive frames of a stream, without tracks that
    start in others.
    """
    start = frames[0]
    stop = min(frames[-1] + 1, video.points.shape[1])
    mask = (video.queries >= start) & (video.queries < stop)
    visible = None if video.visible is None else video.visible[mask, start:stop]
    return TrackTruth(
        video.cameras, video.points[mask, start:stop], visible, video.queries[mask] - start
    )


def _compared(stream: FrameSource, videos: Sequence[TrackTruth], start: int) -> list[Comparison]:
    """Return the tracks of the stream beside the true ones of each video, which begins with the
    frame `start`.
    """
    pairs = _tracked(stream, videos, start)
    masks = _seen(stream, videos, [positions for positions, _ in pairs])
    return [
        Comparison(
            video.points, positions, video.visible, mask & alive, alive, video.queries, video.pixel
        )
        for video, (positions, alive), mask in zip(videos, pairs, masks, strict=True)
    ]


def _tracked(
    stream: FrameSource, videos: Sequence[TrackTruth], start: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the positions [P, T, 3] and the mask of the living [P, T] of each video's points."""
    queries = np.concatenate([video.queries for video in videos]) + start
    tracks = track_points(stream, _query_points(videos), queries)
    ends = np.cumsum([len(video.queries) for video in videos])[:-1]
    parts = zip(videos, np.split(tracks.points, ends), np.split(tracks.alive, ends), strict=True)
    return [
        (positions[:, :length], alive[:, :length])
        for video, positions, alive in parts
        for length in (video.points.shape[1],)
    ]


def _query_points(videos: Sequence[TrackTruth]) -> np.ndarray:
    """Return the true points [P, 3] of all videos at the frames of their queries."""
    points = [video.points[np.arange(len(video.queries)), video.queries] for video in videos]
    return np.concatenate(points)


def _seen(
    stream: FrameSource, videos: Sequence[TrackTruth], tracks: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return the masks of the tracked points [P, T, 3] that a view of their video sees, [P, T]."""
    masks = [np.zeros(positions.shape[:2], bool) for positions in tracks]
    for t, camera, depth, alpha in _depth_maps(stream, _cameras(videos)):
        for video, positions, mask in zip(videos, tracks, masks, strict=True):
            if t < positions.shape[1] and camera.name in [view.name for view in video.cameras]:
                mask[:, t] |= seen_in_depth(depth, alpha, camera, positions[:, t])
    return masks


def _cameras(videos: Sequence[TrackTruth]) -> list[Camera]:
    """Return the cameras of the videos with visibility, each once."""
    cameras = {
        camera.name: camera
        for video in videos
        if video.visible is not None
        for camera in video.cameras
    }
    return [*cameras.values()]


def _depth_maps(
    stream: FrameSource, cameras: Sequence[Camera]
) -> Iterator[tuple[int, Camera, np.ndarray, np.ndarray]]:
    """Yield (place of the frame in the stream, camera, depth [H, W], alpha [H, W])."""
    config = render_config(stream)
    for t, (_, gaussians) in enumerate(play(stream) if cameras else ()):
        for camera in cameras:
            maps = render(gaussians, camera, ("depth", "alpha"), config)
            yield t, camera, maps["depth"][..., 0], maps["alpha"][..., 0]
