"""Measure how well motion masks fit the true ones, and what they do to the confidence that is learned from them.

    python -m benchmarks.reports.masks CAPTURE... --json masks.json

Needs captures with ground truth. The first frame is fitted once. Then, per clip,

- `masks`: key views' flow masks, refined by each method; `lifted` is the mask that one gets by rendering, in the same
  views, the Gaussians of the frame before where the flow carries them, as sure of who moves as `motion.lift` is;
- `loops`: the later frames fitted with some methods' masks in every frame, from the lifted confidence and without it,
  as in the paper: the rendered confidence beside the true mask, in the key views and in the held-out one, and the
  held-out view's PSNR where things move;
- `processor_ms`: what each method costs on one picture, its flow not counted.

All masks are judged by IoU and by the shares of the true mask that is `found` and of the mask that is `true`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from morgs_mi import Camera, Gaussians, rasterize
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.codec.packets import CodedFrame
from morgs_mi.config import StreamConfig
from morgs_mi.core.files import write_json
from morgs_mi.evaluate.environment import machine, versions
from morgs_mi.evaluate.metrics import iou, psnr
from morgs_mi.fit.config import FitConfig
from morgs_mi.method.active_set import full_active_set
from morgs_mi.method.confidence import flow_mask
from morgs_mi.method.config import MotionConfig
from morgs_mi.method.flow import FlowObservation, observe_flow
from morgs_mi.method.lift import lift_flow
from morgs_mi.method.mask_refiners.registry import MASK_REFINERS, mask_refiner
from morgs_mi.render.config import RenderConfig
from morgs_mi.stream_loop import StreamLoop
from morgs_mi.synth.ground_truth import load_truth


@dataclass(frozen=True)
class Options:
    """Measure the overlap of motion masks with the truth."""

    captures: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of captures with ground truth."""
    json: Path | None = None
    """File for the figures; they are printed too."""
    frames: int = 4
    """Later frames of each."""
    first_frame_steps: int = 600
    """Steps of the first frame's fit."""
    num_gaussians: int = 10_000
    """Of the first frame."""
    loops: tuple[str, ...] = ("grabcut", "superpixels+grabcut")
    """Methods whose masks the loop is run with; a minute each."""


def overlap(mask: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Return how well a mask [H, W] bool fits the true one."""
    both = float((mask & truth).sum())
    return {"iou": iou(mask, truth), "found": both / truth.sum(), "true": both / max(mask.sum(), 1)}


def confidence_mask(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Return where the rendered confidence exceeds a half, [H, W] bool."""
    return np.asarray(rasterize(gaussians, camera, ("confidence",)).confidence)[..., 0] > 0.5


def carried(gaussians: Gaussians, cameras: Sequence[Camera], cues: Mapping[int, FlowObservation]) -> Gaussians:
    """Return the Gaussians where the key views' flow carries them, sure of who moves and who does not."""
    lift = lift_flow(gaussians, full_active_set(gaussians, cameras, RenderConfig()).views, cues)
    sure = np.where(lift.logit_confidence > 0, 6, -6).astype(np.float32)
    return replace(gaussians, means=np.asarray(gaussians.means) + lift.displacement, logit_confidence=sure)


def means(rows: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean of every figure."""
    rows = list(rows)
    return {name: round(float(np.mean([row[name] for row in rows])), 3) for name in rows[0]}


def processor_ms(image: np.ndarray, previous: np.ndarray) -> dict[str, float]:
    """Return the processor time of each method on one picture, all threads together, ms: medians of 9."""
    cue, costs = observe_flow(image, previous), {}
    moves = flow_mask(cue.motion, cue.reliable)
    for method in MASK_REFINERS.names:
        refine, times = mask_refiner(method), []
        for _ in range(9):
            start = time.process_time()
            refine(image, moves)
            times.append(1e3 * (time.process_time() - start))
        costs[method] = round(float(np.median(times)), 1)
    return costs


class Clip:
    """A capture whose first frame is fitted."""

    def __init__(self, path: Path, options: Options) -> None:
        self.capture: Capture = load_capture(path, max_frames=options.frames + 1)
        self.views = self.capture.train_views
        self.cameras = [self.capture.cameras[v] for v in self.views]
        self.held_out = self.capture.cameras[self.capture.test_view]
        self.frames = list(self.capture.frames())
        self.fit = FitConfig(first_frame_steps=options.first_frame_steps, num_gaussians=options.num_gaussians)
        loop = self._loop(MotionConfig())
        loop.push(self._images(0))
        assert loop.state.coded is not None
        self.first: CodedFrame = loop.state.coded

    def _images(self, t: int) -> list[np.ndarray]:
        return [self.frames[t].images[v] for v in self.views]

    def _loop(self, motion: MotionConfig) -> StreamLoop:
        masks = [self.capture.masks[v] for v in self.views]
        config = StreamConfig(fit=self.fit, motion=motion)
        return StreamLoop(self.cameras, self.capture.points, self.capture.point_colors, config, masks)

    def _truth(self, camera: Camera, t: int) -> np.ndarray:
        assert self.capture.truth is not None
        return load_truth(self.capture.truth, camera.name, t).mask

    def masks(self) -> dict[str, dict[str, float]]:
        """Return the figures of each way to a mask of the key views."""
        rows: dict[str, list[dict[str, float]]] = {name: [] for name in (*MASK_REFINERS.names, "lifted")}
        loop = self._loop(MotionConfig())
        loop.resume(self.first, [self._images(0)])
        for t in range(1, len(self.frames)):
            key_views, images, before = loop.setup.key_views, self._images(t), self._images(t - 1)
            cues = {k: observe_flow(images[k], before[k], valid=loop.setup.masks[k]) for k in key_views}
            assert loop.gaussians is not None
            lifted = carried(loop.gaussians, self.cameras, cues)
            for k, cue in cues.items():
                truth, moves = self._truth(self.cameras[k], t), flow_mask(cue.motion, cue.reliable)
                for method in MASK_REFINERS.names:
                    rows[method].append(overlap(mask_refiner(method)(images[k], moves), truth))
                rows["lifted"].append(overlap(confidence_mask(lifted, self.cameras[k]), truth))
            loop.push(images)
        return {name: means(found) for name, found in rows.items()}

    def fitted(self, method: str, lift_confidence: bool) -> dict[str, dict[str, float]]:
        """Return the figures of the confidence that the loop learns from a method's masks."""
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
            recorded = self.frames[t].images[self.capture.test_view]
            quality = psnr(np.clip(color, 0, 1), recorded, moving)
            held_out.append({**overlap(confidence_mask(now, self.held_out), moving), "psnr_moving": quality})
        return {"key_views": means(key_views), "held_out": means(held_out)}


def measure(path: Path, options: Options) -> dict[str, Any]:
    """Return one clip's figures."""
    clip = Clip(path, options)
    camera = clip.cameras[0]
    masks, last = clip.masks(), clip.capture.num_frames - 1
    costs = processor_ms(*(clip.frames[t].images[clip.views[0]] for t in (last, last - 1)))
    loops = {
        start: {method: clip.fitted(method, start == "lifted") for method in options.loops}
        for start in ("lifted", "as before")
    }
    size = {"width": camera.width, "height": camera.height}
    return {"name": path.resolve().name, **size, "masks": masks, "processor_ms": costs, "loops": loops}


def main(options: Options) -> None:
    """Print the figures and write them."""
    mi.set_variant("llvm_ad_rgb")
    result: dict[str, Any] = {"clips": []}
    settings = {name: value for name, value in asdict(options).items() if name not in ("captures", "json")}
    for path in options.captures:
        result["clips"].append(measure(path, options))
        print(json.dumps(result["clips"][-1]), flush=True)
        if options.json:
            write_json(options.json, {**result, "settings": settings, "machine": machine(), "versions": versions()})


if __name__ == "__main__":
    main(tyro.cli(Options))
