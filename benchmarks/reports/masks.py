"""Measure the overlap of motion masks with the true ones, and of the confidence that is learned from them.

    python -m benchmarks.reports.masks CAPTURE... --json masks.json

Needs captures with ground truth. The first frame is fitted once. The figures of a clip are

- `masks`: flow masks of the key views, refined by each method. `lifted` is the rendered confidence, in the same views,
  of the previous frame's Gaussians moved by the lifted flow, with the confidence of `lift_flow` made hard;
- `loops`: later frames fitted with some methods' masks in every frame, starting from the lifted confidence and without
  it, as in the paper. Reported are the rendered confidence compared with the true mask, in the key views and in the
  held-out view, and the PSNR of the held-out view's moving region;
- `processor_ms`: processor time of each method for one image, without its flow.

The overlap of a mask is its IoU, the share of the true mask that is `found` and the share of the mask that is `true`.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.reports.fits import new_loop
from benchmarks.reports.plots import Column, scores_table
from benchmarks.reports.study import Row, Scene, Study, StudyOptions, Variant
from morgs_mi import Camera, Gaussians, rasterize
from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.truth import load_truth
from morgs_mi.codec.packets import CodedFrame
from morgs_mi.evaluate.metrics import iou, psnr
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.active_set import full_active_set
from morgs_mi.method.confidence import flow_mask
from morgs_mi.method.flow import FlowObservation, observe_flow
from morgs_mi.method.lift import lift_flow
from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS, mask_refiner
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.render.render_config import RenderConfig
from morgs_mi.runs.cluster.tasks import Source
from morgs_mi.stream_loop import StreamLoop

_COLUMNS = Column("IoU", "iou"), Column("PSNR where things move, dB", "psnr_moving")


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Captures and work."""

    captures: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of captures with ground truth."""
    frames: int = 4
    """Number of later frames of each clip."""
    steps: int = 600
    """Steps of the first frame."""
    gaussians: int = 10_000
    """Gaussians of the first frame."""
    loops: tuple[str, ...] = ("grabcut", "superpixels+grabcut")
    """Methods of the masks that later frames are fitted with; a minute each."""

    def study(self) -> Study:
        """Return the study of the captures."""
        sources = {path.resolve().name: Source.of(load_capture(path)) for path in self.captures}
        frames = {name: replace(s, num_frames=min(s.num_frames, self.frames + 1)) for name, s in sources.items()}
        scenes = [Scene({"name": name}, (source, self.loops)) for name, source in frames.items()]
        fit = FitConfig(first_frame_steps=self.steps, num_gaussians=self.gaussians)
        return Study(measure, scenes, [Variant({}, StreamConfig(fit))], self.fit_seeds, seed_key="seed")

    def table(self, rows: Sequence[Row]) -> str:
        """Return the held-out IoU and PSNR of the later frames by start and masks."""
        return loops_table(rows)


def overlap(mask: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Return the overlap of a mask [H, W] bool with the true one."""
    both = float((mask & truth).sum())
    return {"iou": iou(mask, truth), "found": both / truth.sum(), "true": both / max(mask.sum(), 1)}


def confidence_mask(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Return the mask of pixels with a rendered confidence above 0.5, [H, W] bool."""
    return np.asarray(rasterize(gaussians, camera, ("confidence",)).confidence)[..., 0] > 0.5


def lifted(gaussians: Gaussians, cameras: Sequence[Camera], flow: Mapping[int, FlowObservation]) -> Gaussians:
    """Return the Gaussians moved by the lifted flow of the key views, with a hard confidence."""
    lift = lift_flow(gaussians, full_active_set(gaussians, dict(enumerate(cameras)), RenderConfig()).views, flow)
    hard = np.where(lift.logit_confidence > 0, 6, -6).astype(np.float32)
    return replace(gaussians, means=np.asarray(gaussians.means) + lift.displacement, logit_confidence=hard)


def means(rows: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean of every figure."""
    rows = list(rows)
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def processor_ms(image: np.ndarray, previous: np.ndarray) -> dict[str, float]:
    """Return the processor time of each method for one image, summed over threads, ms: medians of 9."""
    flow, costs = observe_flow(image, previous), {}
    moving = flow_mask(flow.motion, flow.reliable)
    for method in MASK_REFINERS.names:
        refine, times = mask_refiner(method), []
        for _ in range(9):
            start = time.process_time()
            refine(image, moving)
            times.append(1e3 * (time.process_time() - start))
        costs[method] = float(np.median(times))
    return costs


class Clip:
    """A capture with its first frame fitted."""

    def __init__(self, source: Source, config: StreamConfig) -> None:
        self.capture, self.config = source.open(), config
        self.views = self.capture.train_views
        self.cameras = [self.capture.cameras[v] for v in self.views]
        if not self.capture.test_views or self.capture.truth is None:
            raise ValueError(
                f"{source.path}: expected a capture with a held-out view and ground truth; make one with synth."
            )
        self.test_view = self.capture.reference_view
        self.truth = self.capture.truth
        self.held_out = self.capture.cameras[self.test_view]
        self.frames = list(self.capture.frames())
        loop = self._loop(MotionConfig())
        loop.push(self._images(0))
        assert loop.state.coded is not None
        self.first: CodedFrame = loop.state.coded

    def _images(self, t: int) -> list[np.ndarray]:
        return [self.frames[t].images[v] for v in self.views]

    def _loop(self, motion: MotionConfig) -> StreamLoop:
        return new_loop(self.capture, replace(self.config, motion=motion))

    def _truth(self, camera: Camera, t: int) -> np.ndarray:
        return load_truth(self.truth, camera.name, t).mask

    def masks(self) -> dict[str, dict[str, float]]:
        """Return the overlap of the key views' masks by method."""
        rows: dict[str, list[dict[str, float]]] = {name: [] for name in (*MASK_REFINERS.names, "lifted")}
        loop = self._loop(MotionConfig())
        loop.resume(self.first, [self._images(0)])
        for t in range(1, len(self.frames)):
            key_views, images, before = loop.setup.key_views, self._images(t), self._images(t - 1)
            flow = {k: observe_flow(images[k], before[k], valid=loop.setup.masks[k]) for k in key_views}
            assert loop.gaussians is not None
            moved = lifted(loop.gaussians, self.cameras, flow)
            for k, observed in flow.items():
                truth, moving = self._truth(self.cameras[k], t), flow_mask(observed.motion, observed.reliable)
                for method in MASK_REFINERS.names:
                    rows[method].append(overlap(mask_refiner(method)(images[k], moving), truth))
                rows["lifted"].append(overlap(confidence_mask(moved, self.cameras[k]), truth))
            loop.push(images)
        return {name: means(found) for name, found in rows.items()}

    def fitted(self, method: str, lift_confidence: bool) -> dict[str, dict[str, float]]:
        """Return the overlap of the confidence that the loop learns from a method's masks."""
        loop = self._loop(MotionConfig(mask_method=method, mask_interval=1, lift_confidence=lift_confidence))
        loop.resume(self.first, [self._images(0)])
        key_views, held_out = [], []
        for t in range(1, len(self.frames)):
            loop.push(self._images(t))
            now = loop.gaussians
            assert now is not None
            for camera in (self.cameras[k] for k in loop.setup.key_views):
                key_views.append(overlap(confidence_mask(now, camera), self._truth(camera, t)))
            color, moving = np.asarray(rasterize(now, self.held_out).color), self._truth(self.held_out, t)
            recorded = self.frames[t].images[self.test_view]
            quality = psnr(np.clip(color, 0, 1), recorded, moving)
            held_out.append({**overlap(confidence_mask(now, self.held_out), moving), "psnr_moving": quality})
        return {"key_views": means(key_views), "held_out": means(held_out)}


def measure(source: Source, loops: Sequence[str], config: StreamConfig) -> dict[str, Any]:
    """Return the figures of one clip."""
    clip = Clip(source, config)
    camera, last = clip.cameras[0], len(clip.frames) - 1
    return {
        "width": camera.width,
        "height": camera.height,
        "masks": clip.masks(),
        "processor_ms": processor_ms(*(clip.frames[t].images[clip.views[0]] for t in (last, last - 1))),
        "loops": {
            start: {method: clip.fitted(method, start == "lifted") for method in loops}
            for start in ("lifted", "as before")
        },
    }


def loops_table(clips: Sequence[Row]) -> str:
    """Return the held-out IoU and PSNR of the later frames of each clip in Markdown."""
    rows = [
        {**fit["held_out"], "clip": clip["name"], "how": f"{label}, `{method}`"}
        for start, label in (("lifted", "lifted"), ("as before", "as in the paper"))
        for clip in clips
        for method, fit in clip["loops"][start].items()
    ]
    return scores_table(rows, {"start, masks": "how", "clip": "clip"}, _COLUMNS, left=2)


if __name__ == "__main__":
    tyro.cli(Options).run()
