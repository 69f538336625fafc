"""Tracks of surface points through streams of synthetic clips: AJ, delta_avg and MTE.

    morgs-mi fit CLIP OUT
    python -m benchmarks.reports.tracks OUT ... --json tracks.json

Each CLIP is one of `morgs-mi synth`. Its true points are followed from the frame in which a
training view first sees them. A point is bound to the 8 Gaussians of the largest response, the
opacity times exp(-d^2 / 2) with the Mahalanobis distance d. Each one carries it rigidly, with its
mean and its rotation, and the track is the mean over those that are alive, weighted by the
responses. Without any, the point stays where it was.

The protocol is that of Dynamic 3D Gaussians (Luiten et al. 2024), with the measures of PointOdyssey
(Zheng et al. 2023); AJ, which it does not define, follows from its thresholds. With the distance e
of a tracked point to the true one, v whether a training view sees the true point, v' whether one
sees the tracked one, and a threshold d, over the frames after the first of a track:

    <d  = #(v and e < d) / #v,
    J_d = #(v and v' and e < d) / (#v + #(v' and not (v and e < d))).

delta_avg and AJ are the means over the thresholds 1, 2, 4, 8 and 16 cm, MTE is the median of e over
the visible frames, and a world unit is a metre. All are means over the tracks with two visible
frames and a path of more than 10 cm.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import mitsuba as mi
import numpy as np
import tyro
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import Rotation

from benchmarks.reports.plots import Column, scores_table
from benchmarks.speed.output import Output
from morgs_mi import Camera, Gaussians, RenderConfig, open_stream
from morgs_mi.capture.capture import Capture
from morgs_mi.capture.truth import load_tracks
from morgs_mi.codec.frame_source import FrameState
from morgs_mi.core.geometry import unit_quats
from morgs_mi.core.rig import scene_extent
from morgs_mi.evaluate.results import known_mean
from morgs_mi.playback.player import render
from morgs_mi.playback.stream_header import open_stream_capture, render_config

_THRESHOLDS = np.array([0.01, 0.02, 0.04, 0.08, 0.16])
# Length of a path above which a point moves, as in MVTracker (Rajic et al. 2025).
_MOVING = 0.1
_NUM_GAUSSIANS = 8
# Responses that are computed at a time.
_MOST_ENTRIES = 2**22
# Floor of the scales, as a share of the scene's size, so that a flat Gaussian has a response.
_FLATTEST = 1e-6
# A point is hidden if it lies behind the rendered depth by more than this share.
_DEPTH_TOLERANCE = 0.02

COLUMNS = (
    Column("tracks", "tracks", 0, spread=False),
    Column("AJ, %", "average_jaccard", 1, 100, spread=False),
    Column("delta_avg, %", "delta_avg", 1, 100, spread=False),
    Column("MTE", "median_error", 4, spread=False),
    Column("MTE, % of the extent", "median_error_percent", spread=False),
)


@dataclass(frozen=True)
class Options(Output):
    """Folders of fits, and output."""

    outs: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Folders of the fits of synthetic clips, or stream files."""

    def run(self) -> None:
        """Print the table, and write the scores."""
        mi.set_variant("llvm_ad_rgb")
        rows = []
        for out in self.outs:
            stream = open_stream(out)
            capture = open_stream_capture(stream, None, stream.frame_numbers())
            scores = track_scores(stream.states(), capture, render_config(stream))
            rows.append({"stream": out.name, **scores})
        print(scores_table(rows, {"stream": "stream"}, COLUMNS))
        self.write({"fits": rows})


def track_scores(
    states: Iterable[FrameState], capture: Capture, config: RenderConfig
) -> dict[str, float]:
    """Return the scores of the frames of a stream, whose capture is a synthetic clip."""
    assert capture.truth is not None
    truth = load_tracks(capture.truth)
    cameras = capture.views.train.cameras
    visible = np.any([truth.visible[camera.name] for camera in cameras], axis=0)
    frames, positions, predictions = follow(states, truth.points, visible, cameras, config)
    return score(
        truth.points[:, frames], visible[:, frames], positions, predictions, scene_extent(cameras)
    )


def follow(
    states: Iterable[FrameState],
    points: np.ndarray,
    visible: np.ndarray,
    cameras: Sequence[Camera],
    config: RenderConfig,
) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Return the indices of T frames, the positions of points [P, T, 3] that are followed from the
    frame in which they are first visible, and whether one of the cameras sees them [P, T].

    `points` [P, F, 3] and `visible` [P, F] are the truth in all F frames of the clip.
    """
    shape = len(points), _NUM_GAUSSIANS
    ids = np.full(shape, -1)
    weights = np.zeros(shape)
    local = np.zeros((*shape, 3))
    position = np.zeros((len(points), 3))  # where a point was last
    is_bound = np.zeros(len(points), bool)
    frames = []
    positions = []
    predictions = []
    for state in states:
        gaussians = state.gaussians
        means = gaussians.numpy()["means"].astype(np.float64)
        axes = Rotation.from_quat(unit_quats(gaussians), scalar_first=True).as_matrix()
        rows = np.searchsorted(state.lasting_ids, ids).clip(max=len(means) - 1)
        shares = weights * (state.lasting_ids[rows] == ids)
        alive = shares.any(1)
        shares[alive] /= shares[alive].sum(1, keepdims=True)
        candidates = means[rows] + np.einsum("pkij,pkj->pki", axes[rows], local)
        position[alive] = np.einsum("pk,pki->pi", shares, candidates)[alive]

        start = np.flatnonzero(visible[:, state.frame] & ~is_bound)
        position[start] = points[start, state.frame]
        rows, shares = bind(gaussians, axes, position[start])
        part = start, slice(rows.shape[1])
        ids[part] = state.lasting_ids[rows]
        weights[part] = shares
        local[part] = np.einsum("pkji,pkj->pki", axes[rows], position[start, None] - means[rows])
        is_bound[start] = True
        alive[start] = True

        masks = [sees(camera, gaussians, position, config) for camera in cameras]
        frames.append(state.frame)
        positions.append(position.copy())
        predictions.append(alive & np.any(masks, axis=0))
    return frames, np.stack(positions, 1), np.stack(predictions, 1)


def bind(
    gaussians: Gaussians, axes: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the Gaussians of the largest response at each point [P, K], and their weights.

    K is 8, but at most the number N of Gaussians; `axes` [N, 3, 3] are their rotations.
    """
    raw = gaussians.numpy()
    means = raw["means"].astype(np.float64)
    floor = _FLATTEST * np.abs(means - means.mean(0)).max()
    scales = np.maximum(np.exp(raw["log_scales"].astype(np.float64)), max(floor, 1e-30))
    to_local = axes / scales[:, None]
    log_opacity = -np.logaddexp(0, -raw["logit_opacities"].astype(np.float64))
    count = min(_NUM_GAUSSIANS, len(means))
    rows = np.zeros((len(points), count), int)
    weights = np.zeros((len(points), count))
    step = max(1, _MOST_ENTRIES // len(means))
    for first in range(0, len(points), step):
        part = slice(first, first + step)
        distances = np.einsum("pni,nij->pnj", points[part, None] - means, to_local)
        responses = log_opacity - 0.5 * np.square(distances).sum(-1)
        rows[part] = np.argpartition(-responses, count - 1)[:, :count]
        largest = np.take_along_axis(responses, rows[part], 1)
        # Relative to the largest: far from all Gaussians every response underflows.
        weights[part] = np.exp(largest - largest.max(1, keepdims=True))
    return rows, weights / weights.sum(1, keepdims=True)


def sees(
    camera: Camera, gaussians: Gaussians, points: np.ndarray, config: RenderConfig
) -> np.ndarray:
    """Return the mask of the points [P] that are in the image of a camera and not behind the
    rendered surface.

    That is the farthest depth in the 3x3 pixels around a point; pixels with an alpha below 0.5 hide
    nothing.
    """
    maps = render(gaussians, camera, ("depth", "alpha"), config)
    depth = np.where(maps["alpha"] < 0.5, np.inf, maps["depth"])[..., 0]
    surface = maximum_filter(depth, 3, mode="nearest")
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels, z = camera.project(points)
    mask = (z > camera.near) & ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(-1)
    column, row = pixels[mask].astype(int).T
    mask[mask] = z[mask] <= (1 + _DEPTH_TOLERANCE) * surface[row, column]
    return mask


def score(
    truth: np.ndarray,
    visible: np.ndarray,
    positions: np.ndarray,
    predictions: np.ndarray,
    extent: float,
) -> dict[str, float]:
    """Return the scores of the positions [P, T, 3] of tracks, beside the true ones.

    `visible` and `predictions` [P, T] are the visibility of the true and of the tracked points.
    """
    rows = []
    for points, mask, track, claims in zip(truth, visible, positions, predictions, strict=True):
        path = np.linalg.norm(np.diff(points[mask], axis=0), axis=-1).sum()
        if mask.sum() < 2 or path <= _MOVING:
            continue
        error = np.linalg.norm(track - points, axis=-1)
        later = slice(mask.argmax() + 1, None)
        accurate = mask[later, None] & (error[later, None] < _THRESHOLDS)
        hits = accurate & claims[later, None]
        wrong = claims[later, None] & ~hits
        jaccard = hits.sum(0) / (mask[later].sum() + wrong.sum(0))
        delta = accurate.sum(0) / mask[later].sum()
        rows.append((jaccard.mean(), delta.mean(), np.median(error[mask])))
    jaccard, delta, error = (known_mean([row[k] for row in rows]) for k in range(3))
    return {
        "tracks": len(rows),
        "average_jaccard": jaccard,
        "delta_avg": delta,
        "median_error": error,
        "median_error_percent": 100 * error / extent,
    }


if __name__ == "__main__":
    tyro.cli(Options).run()
