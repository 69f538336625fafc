"""Scores of 3D point tracks, by three published protocols.

Notation: e is the distance of a tracked point to the true one, v whether the true point is visible
and v' whether it is predicted to be. With a threshold d, over the points and frames that count:

    <d  = #(v and e < d) / #v,
    J_d = #(v and v' and e < d) / (#v + #(v' and not (v and e < d))),
    OA  = #(v == v') / #all.

delta_avg and AJ are the means of <d and J_d over the protocol's thresholds. MTE is the median of e
over the visible frames of a track, and survival the share of its frames before the first one with v
and e > s; both are averaged over tracks. What counts:

- TAPVid-3D (Koppula et al. 2024): each view is a video of its own, in which the other views do not
  matter. All frames count, the query's and earlier ones too, all points of a video are counted
  together, and videos are averaged. The thresholds are 1, 2, 4, 8 and 16 pixels of an image with a
  shorter side of 256, on a plane through the true point: d z / f in world units, with its depth z
  and the focal length f. The benchmark's global scale of the prediction is 1, because calibrated
  views determine it. It defines no MTE and no survival.
- Dynamic 3D Gaussians (Luiten et al. 2024), with the measures of PointOdyssey (Zheng et al. 2023)
  in centimetres: thresholds of 1, 2, 4, 8 and 16 cm, and s = 50 cm.
- MVTracker (Rajic et al. 2025), with its thresholds for Panoptic Studio: 5, 10, 20 and 40 cm, and s
  = 1 m.

For the last two the frames after the query count (for MTE and survival, also the query's), each
track has its own scores, and these are averaged; a point is visible if any view sees it. A track
needs two visible frames from its query on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from morgs_mi.evaluate.results import TrackingScores, TrackScores, known_mean

_CENTIMETRE = 0.01
# MVTracker's definition of a moving point: the length of its path in metres, over the frames in
# which it is visible.
_MOVING = 0.1


@dataclass(frozen=True)
class Protocol:
    """A published way to score 3D point tracks."""

    name: str  #: Name in tables.
    thresholds: tuple[float, ...]  #: Of the distance: pixels if `per_view`, otherwise centimetres.
    #: Distance at which a track fails, cm; None if the protocol defines neither survival nor MTE.
    survival: float | None
    #: Whether each view is a video of its own, with its points counted together in all frames.
    per_view: bool = False

    @property
    def description(self) -> str:
        """The thresholds with their unit."""
        numbers = ", ".join(f"{threshold:g}" for threshold in self.thresholds)
        return f"{numbers} {'px at 256 px' if self.per_view else 'cm'}"


TAPVID3D = Protocol("TAPVid-3D", (1, 2, 4, 8, 16), None, per_view=True)
DYNAMIC_3D_GAUSSIANS = Protocol("Dynamic 3D Gaussians", (1, 2, 4, 8, 16), 50)
MVTRACKER = Protocol("MVTracker", (5, 10, 20, 40), 100)


@dataclass(frozen=True)
class Comparison:
    """Tracks of P points through T frames beside the true ones, in one video: one view, or several
    that see as one.
    """

    truth: np.ndarray  #: True positions [P, T, 3], world units.
    found: np.ndarray  #: Tracked positions [P, T, 3].
    #: bool [P, T], whether the true point is visible; None if unknown, which counts as visible.
    visible: np.ndarray | None
    found_visible: np.ndarray  #: bool [P, T], whether the tracked point is predicted to be visible.
    alive: np.ndarray  #: bool [P, T], whether the tracked point is bound to a living Gaussian.
    queries: np.ndarray  #: int [P], the index of each track's query frame.
    #: [P, T], width of a pixel at the true point in world units, for an image with a shorter side
    #: of 256; None for several views.
    pixel: np.ndarray | None = None

    def select(self, rows: np.ndarray) -> Comparison:
        """Return some of the tracks, by a mask [P]."""
        return replace(
            self,
            **{name: values[rows] for name, values in vars(self).items() if values is not None},
        )

    @property
    def counts(self) -> np.ndarray:
        """Mask [P, T] of the visible points from the query on."""
        return _visibility(self)[0] & (np.arange(self.truth.shape[1]) >= self.queries[:, None])


def score_tracks(
    protocol: Protocol, videos: Sequence[Comparison], meters_per_unit: float, extent: float
) -> TrackingScores:
    """Return the scores of all tracks, and of those that move, by a protocol.

    Args:
        protocol: one of those in this module.
        videos: at least one.
        meters_per_unit: length of a world unit in metres.
        extent: scene extent, world units.
    """
    moving = [video.select(_path_length(video) * meters_per_unit > _MOVING) for video in videos]
    rows = (score(protocol, part, meters_per_unit, extent) for part in (videos, moving))
    return TrackingScores(protocol.name, protocol.description, *rows)


def score(
    protocol: Protocol, videos: Sequence[Comparison], meters_per_unit: float, extent: float
) -> TrackScores:
    """Return the scores of the tracks of some videos; see `score_tracks`."""
    if not protocol.per_view:
        videos = [video.select(video.counts.sum(1) >= 2) for video in videos]
    num_tracks = sum(len(video.truth) for video in videos)
    if not num_tracks:
        return TrackScores()
    masks = [_evaluated(protocol, video) for video in videos]
    shares = _shares_of_videos(protocol, videos, masks, meters_per_unit)
    average_jaccard, delta_avg, accuracy = (known_mean(column) for column in shares.T)
    alive = np.concatenate([video.alive[mask] for video, mask in zip(videos, masks, strict=True)])
    scores = TrackScores(
        num_tracks,
        average_jaccard,
        delta_avg,
        accuracy if all(video.visible is not None for video in videos) else float("nan"),
        bound=float(alive.mean()),
    )
    if protocol.survival is None:
        return scores
    failure = _CENTIMETRE * protocol.survival / meters_per_unit
    error, survival = np.concatenate(
        [_median_error_and_survival(video, failure) for video in videos]
    ).mean(0)
    return replace(
        scores,
        median_error=float(error),
        median_error_percent=float(100 * error / extent),
        survival=float(survival),
    )


def _shares_of_videos(
    protocol: Protocol,
    videos: Sequence[Comparison],
    masks: Sequence[np.ndarray],
    meters_per_unit: float,
) -> np.ndarray:
    """Return AJ, delta_avg and OA [M, 3] of each track, or of each video where a view is one."""
    counts = [
        _counts(protocol, video, mask, meters_per_unit)
        for video, mask in zip(videos, masks, strict=True)
    ]
    if protocol.per_view:
        counts = [count.sum(1, keepdims=True) for count in counts]
    return np.concatenate([_shares(count) for count in counts])


def _evaluated(protocol: Protocol, video: Comparison) -> np.ndarray:
    """Return the mask [P, T] of the points and frames that count for all scores but MTE and
    survival.
    """
    mask = np.arange(video.truth.shape[1]) > video.queries[:, None]
    return np.ones_like(mask) if protocol.per_view else mask


def _counts(
    protocol: Protocol, video: Comparison, evaluated: np.ndarray, meters_per_unit: float
) -> np.ndarray:
    """Return numbers of points [6, P, D] for D thresholds: those that `_shares` needs."""
    visible, found_mask = (mask[..., None] for mask in _visibility(video))
    error = np.linalg.norm(video.found - video.truth, axis=-1)[..., None]
    unit = _threshold_unit(protocol, video, meters_per_unit)
    accurate = visible & (error < np.array(protocol.thresholds) * unit)
    hits = accurate & found_mask
    masks = (
        visible,
        accurate,
        hits,
        found_mask & ~hits,
        visible == found_mask,
        evaluated[..., None],
    )
    return np.stack(
        [(np.broadcast_to(mask, accurate.shape) & evaluated[..., None]).sum(1) for mask in masks]
    )


def _threshold_unit(protocol: Protocol, video: Comparison, meters_per_unit: float) -> np.ndarray:
    """Return the unit of a protocol's thresholds, world units, [] or [P, T, 1]."""
    if not protocol.per_view:
        return np.array(_CENTIMETRE / meters_per_unit)
    assert video.pixel is not None
    return video.pixel[..., None]


def _shares(counts: np.ndarray) -> np.ndarray:
    """Return AJ, delta_avg and OA [M, 3] from numbers of points [6, M, D]; NaN where none is
    visible.

    The numbers count visible points, visible points within the threshold, true positives, false
    positives, points with the right visibility, and all points.
    """
    visible, accurate, hits, false_positives, right, everything = counts
    with np.errstate(invalid="ignore", divide="ignore"):
        jaccard = np.where(visible > 0, hits / (visible + false_positives), np.nan)
        return np.stack(
            [values.mean(1) for values in (jaccard, accurate / visible, right / everything)], axis=1
        )


def _median_error_and_survival(video: Comparison, failure: float) -> np.ndarray:
    """Return the median error in world units and the survival of each track [P, 2]."""
    error = np.linalg.norm(video.found - video.truth, axis=-1)
    survival = _survival(video.counts & (error > failure), video.queries)
    median = [np.median(row[mask]) for row, mask in zip(error, video.counts, strict=True)]
    return np.stack([np.array(median), survival], axis=1).reshape(-1, 2)


def _survival(failures: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Return the share of each track's frames from the query on before its first failure [P]."""
    num_frames = failures.shape[1]
    first = np.where(failures.any(1), failures.argmax(1), num_frames)
    return (first - queries) / (num_frames - queries)


def _visibility(video: Comparison) -> tuple[np.ndarray, np.ndarray]:
    """Return the true and the predicted visibility [P, T]: both true if the former is unknown."""
    if video.visible is None:
        everything = np.ones(video.truth.shape[:2], bool)
        return everything, everything
    return video.visible, video.found_visible


def _path_length(video: Comparison) -> np.ndarray:
    """Return the length of each true path over its visible frames from the query on, world units
    [P].
    """
    steps = (
        np.diff(points[mask], axis=0)
        for points, mask in zip(video.truth, video.counts, strict=True)
    )
    return np.array([np.linalg.norm(step, axis=-1).sum() for step in steps])
