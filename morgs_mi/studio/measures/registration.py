"""Quality of the held-out views in the first frame, from the cameras that fit their images best."""

from __future__ import annotations

from typing import Any

from morgs_mi.core.color_space import encode_light
from morgs_mi.core.rig import scene_extent
from morgs_mi.evaluate.comparison import ComparedClip, ComparedFrame, ComparedView
from morgs_mi.evaluate.measures import Measure
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.view import View, mean_psnr
from morgs_mi.studio.calibration.refine import register_camera


class Registration(Measure):
    """PSNR of the held-out views in the first frame, from the cameras that fit best."""

    def __init__(self, clip: ComparedClip) -> None:
        self._clip = clip
        self._psnr: dict[str, float] = {}
        self._has_begun = False

    def add_view(self, view: ComparedView) -> None:
        if not self._has_begun and view.index in self._clip.recording.test_views:
            self._psnr[view.camera.name] = _registered_psnr(self._clip, view)

    def add_frame(self, frame: ComparedFrame) -> dict[str, Any]:
        self._has_begun = True
        return {}

    def result(self) -> dict[str, Any]:
        return {"registered": self._psnr}


def _registered_psnr(clip: ComparedClip, view: ComparedView) -> float:
    """Return the PSNR of a view from the camera that fits best."""
    cameras = clip.stream.cameras
    image = view.recorded if view.light is None else encode_light(view.light)
    target = View(cameras[view.index], image, view.valid)
    extent = scene_extent([cameras[v] for v in clip.recording.train_views])
    gaussians = view.frame.state.gaussians
    camera = register_camera(gaussians, target, extent, FitConfig(), clip.render)
    return mean_psnr(gaussians, [target._replace(camera=camera)], clip.render)
