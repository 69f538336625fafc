"""Scores of a view, and errors in 3D of a frame.

Every score is one number per view and frame. Frames average over views and the clip over frames;
NaN stands for an unknown score. A name with ``_moving`` or ``_still`` is the score of a region.
With ``truth/``, it is the pixels with a surface that moved since the last frame, in the first frame
until the next. Otherwise it is the pixels in which the recording changed by more than its noise.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from morgs_mi.capture.truth import load_tracks, load_truth
from morgs_mi.codec.container import PacketKind
from morgs_mi.codec.frame_source import FrameState
from morgs_mi.core.color_space import decode_light
from morgs_mi.evaluate.comparison import ComparedClip, ComparedFrame, ComparedView
from morgs_mi.evaluate.lpips import Lpips
from morgs_mi.evaluate.metrics import (
    WINDOW,
    delta_e_map,
    endpoint_error,
    iou,
    mean_over,
    psnr_mu,
    psnr_of,
    ssim_map,
    unit_pair,
)
from morgs_mi.evaluate.motion3d import evaluate_motion
from morgs_mi.evaluate.results import Motion3DScores, ViewScores
from morgs_mi.method.exposure import follow_exposure
from morgs_mi.platform.checks import valid_pixels

REGIONS = ("", "_moving", "_still")


def view_scores(view: ComparedView, lpips: Lpips | None) -> ViewScores:
    """Return the scores of a view's rendered image, motion and confidence.

    Args:
        view: the view.
        lpips: network for LPIPS; without one there is no LPIPS.
    """
    scores = _image_scores(view, lpips)
    # A keyframe has no motion.
    if view.frame.kind == PacketKind.RESIDUAL and view.truth is not None:
        motion = view.maps["motion"]
        true = view.truth.motion
        mask = view.truth.mask
        scores |= {
            "motion_error": endpoint_error(motion, true),
            "motion_error_moving": endpoint_error(motion, true, mask),
            "motion_error_still": endpoint_error(motion, true, ~mask),
            "true_motion_moving": endpoint_error(np.zeros_like(motion), true, mask),
        }
        if "confidence" in view.maps:
            scores["confidence_iou"] = iou(view.maps["confidence"][..., 0] > 0.5, mask)
    return ViewScores(**scores)


class Motion3D:
    """Errors in 3D of the Gaussians that exist in a frame and in the frame before, see
    `evaluate_motion`.

    Args:
        clip: the clip, of which all frames are given in order.
    """

    def __init__(self, clip: ComparedClip) -> None:
        self._cameras = clip.recording.cameras
        self._truth = clip.recording.truth
        self._tracks = None
        if self._truth is not None and (self._truth / "tracks.npz").is_file():
            self._tracks = load_tracks(self._truth)
        self._last_state: FrameState | None = None

    def scores(self, frame: ComparedFrame) -> Motion3DScores:
        """Return the scores of the next frame; NaN without tracks or a previous frame."""
        last_state = self._last_state
        state = frame.state
        self._last_state = state
        tracks = self._tracks
        if (
            frame.kind != PacketKind.RESIDUAL
            or tracks is None
            or state.frame >= tracks.points.shape[1]
        ):
            return Motion3DScores()
        assert last_state is not None
        assert self._truth is not None
        views = []
        for camera in self._cameras:
            truth = load_truth(self._truth, camera.name, state.frame - 1)
            views.append((camera.resized(*truth.mask.shape[::-1]), truth))
        _, last_rows, rows = np.intersect1d(last_state.ids, state.ids, return_indices=True)
        old = last_state.gaussians.numpy()["means"][last_rows].astype(float)
        new = state.gaussians.numpy()["means"][rows].astype(float)
        opacities = np.asarray(last_state.gaussians.opacities)[last_rows]
        points = tracks.points[:, state.frame - 1], tracks.points[:, state.frame], tracks.ids
        return evaluate_motion(old, new - old, opacities, points, views)


def _image_scores(view: ComparedView, lpips: Lpips | None) -> dict[str, float]:
    """Return the scores of a rendered image by metric and region."""
    rendered = view.rendered
    whole = valid_pixels(view.valid, rendered.shape)
    regions = {"": whole}
    if view.moving is not None:
        regions |= {"_moving": whole & view.moving, "_still": whole & ~view.moving}
    a, b = unit_pair("evaluate_stream", rendered, view.recorded)
    exposure_image = follow_exposure(rendered, view.recorded, view.valid)(a).clip(0, 1)
    scores = {"psnr_matched": psnr_of(mean_over(np.square(exposure_image - b), whole))}
    if view.light is not None:
        scores["psnr_mu"] = psnr_mu(decode_light(view.maps["color"]), view.light, view.valid)
    if view.nearest is not None:
        image = cv2.resize(view.nearest, rendered.shape[1::-1])
        copy, _ = unit_pair("evaluate_stream", image, view.recorded)
        scores["psnr_nearest"] = psnr_of(mean_over(np.square(copy - b), whole))
    errors = _by_region("psnr", np.square(a - b), regions)
    scores |= {name: psnr_of(error) for name, error in errors.items()}
    scores |= _by_region("delta_e", delta_e_map(a, b), regions)
    if min(a.shape[:2]) >= WINDOW:
        scores |= _by_region("ssim", ssim_map(a, b), regions)
    if lpips is not None:
        scores |= _by_region("lpips", lpips.distance_map(rendered, view.recorded), regions)
    return scores


def _by_region(
    name: str, values: np.ndarray, regions: Mapping[str, np.ndarray]
) -> dict[str, float]:
    """Return the mean of a map over each region."""
    return {name + region: mean_over(values, mask) for region, mask in regions.items()}
