"""Time a later frame of the loop at two sizes, and report bytes and PSNR.

    python -m benchmarks.speed.frame_speed --json out.json [--sizes small n3dv] [--frames 3]

The scene consists of Gaussians: a wall, a floor and 40 balls, of which some move and turn. Its
images are rendered from them, with camera noise. The loop starts from the scene at frame 0 with
small errors in its colours, similar to a fit's. `small` is 640x480, 12 views, 50,000 Gaussians;
`n3dv` 1352x1014, 20 views, 200,000 Gaussians. One more view is held out. Each setting is run on the
same images: the default at several numbers of epochs, without skipping static parts, and the
paper's scheme.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import median
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from benchmarks.speed.output import Output
from morgs_mi import Camera, Gaussians, rasterize
from morgs_mi.codec.packets import decode, keyframe_packet
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.fit.fit_config import DensityConfig, FitConfig
from morgs_mi.loop.stream_config import StreamConfig, apply_preset
from morgs_mi.stream_loop import StreamLoop

NOISE = 2.0  # grey levels
_SEED = 0


@dataclass(frozen=True)
class Size:
    """Size of a rig and its scene."""

    width: int  # of the images, px
    height: int  # of the images, px
    views: int  # for training
    gaussians: int
    movers: int  # moving balls, out of 40


SIZES = {"small": Size(640, 480, 12, 50_000, 3), "n3dv": Size(1352, 1014, 20, 200_000, 2)}


@dataclass(frozen=True)
class Options(Output):
    """Sizes, settings and output."""

    sizes: tuple[str, ...] = ("small", "n3dv")
    """Sizes to run, among small and n3dv."""
    frames: int = 3
    """Number of later frames; the first is warm-up, medians of the others are reported."""
    epochs: tuple[int, ...] = (1, 2, 4, 8)
    """Numbers of epochs of the default settings."""
    full: tuple[str, ...] = ("small",)
    """Sizes at which the paper's scheme and a fit without skipping are also run; they take minutes.
    """
    variant: str = "llvm_ad_rgb"
    """Mitsuba variant."""


class Scene:
    """Moving scene of Gaussians on a wall, a floor and 40 balls."""

    def __init__(self, size: Size, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.size = size
        flat = size.gaussians // 3
        each = (size.gaussians - 2 * flat) // 40

        def points(count: int, *ranges: tuple[float, float] | float) -> np.ndarray:
            columns = [
                rng.uniform(*r, count) if isinstance(r, tuple) else np.full(count, r)
                for r in ranges
            ]
            return np.stack(columns, 1)

        wall = points(flat, (-3, 3), (-2, 1), 1.5)
        floor = points(flat, (-3, 3), 1.0, (-1.5, 1.5))
        self.centers = points(40, (-1.8, 1.8), (-1.2, 0.6), (-0.8, 1.0))
        self.owner = np.concatenate([np.full(2 * flat, -1), np.repeat(np.arange(40), each)])
        self.local = rng.normal(size=(40 * each, 3))
        self.local *= 0.22 / np.linalg.norm(self.local, axis=1, keepdims=True)
        self.ground = np.concatenate([wall, floor])
        rest = np.concatenate([self.ground, self.centers.repeat(each, 0) + self.local])
        waves = np.sin(rest @ rng.normal(0, 6, (3, 3)) + rng.uniform(0, 6, 3))
        waves *= np.sin(rest @ rng.normal(0, 15, (3, 3)))
        self.sh = (0.9 * waves)[:, None, :].astype(np.float32)
        spacing = np.where(self.owner < 0, (18 / flat) ** 0.5, (4 * np.pi * 0.22**2 / each) ** 0.5)
        self.scales = np.repeat(0.7 * spacing[:, None], 3, 1)
        # The balls nearest to the centre move: a compact region of the image.
        self.moving = np.argsort(np.linalg.norm(self.centers[:, :2], axis=1))[: size.movers]
        self.direction = rng.normal(size=(40, 3)) * (0.02, 0.02, 0.01)

    def at(self, frame: int) -> Gaussians:
        """Return the true Gaussians of a frame."""
        turn = Rotation.from_euler("y", 0.05 * frame).as_matrix()
        owner = self.owner[len(self.ground) :]
        moves = np.isin(owner, self.moving)[:, None]
        turned = self.local @ turn.T + frame * self.direction[owner]
        balls = self.centers[owner] + np.where(moves, turned, self.local)
        return self.gaussians(np.concatenate([self.ground, balls]))

    def gaussians(self, means: np.ndarray, noise: float = 0.0) -> Gaussians:
        """Return Gaussians at the given means [N, 3], with noise of a standard deviation `noise` on
        the SH.
        """
        count = len(means)
        sh = self.sh + noise * np.random.default_rng(0).normal(size=self.sh.shape)
        quats = np.tile([1.0, 0, 0, 0], (count, 1))
        opacities = np.full(count, 0.9)
        return Gaussians.from_activated(
            means, self.scales, quats, opacities, sh, logit_confidence=np.zeros(count)
        )

    def cameras(self) -> list[Camera]:
        """Return the held-out camera and then the training cameras, on an arc in two rows."""
        places = [(0.1, -0.4, -4.5)]
        for i, a in enumerate(np.linspace(-0.5, 0.5, self.size.views)):
            places.append((5 * np.sin(a), -0.6 + 0.5 * (i % 2), -4.5 * np.cos(a)))
        size = (self.size.width, self.size.height)
        return [Camera.look_at(p, (0, -0.2, 0.3), (0, -1, 0), 38, *size) for p in places]

    def recorded(self, num_frames: int, seed: int) -> list[list[np.ndarray]]:
        """Return the images of the first frames, with camera noise, by camera."""
        rng = np.random.default_rng(seed)
        frames = []
        for frame in range(num_frames):
            gaussians = self.at(frame)
            images = []
            for camera in self.cameras():
                image = np.asarray(rasterize(gaussians, camera, ("color",)).color)
                noisy = 255 * image + rng.normal(0, NOISE, image.shape)
                images.append(np.clip(noisy + 0.5, 0, 255).astype(np.uint8))
            frames.append(images)
        return frames


def default_config(size: Size, epochs: int) -> StreamConfig:
    """Return the default settings for the Gaussians of a size."""
    density = DensityConfig(max_gaussians=round(1.1 * size.gaussians))
    return StreamConfig(FitConfig(sh_degree=0, epochs=epochs, density=density))


def loop_of(scene: Scene, config: StreamConfig, images: list[np.ndarray]) -> StreamLoop:
    """Return a loop whose next frame is 1, with the images of frame 0 by camera."""
    cameras = scene.cameras()
    loop = StreamLoop(cameras[1:], np.zeros((200, 3)), np.zeros((200, 3)), config)
    start = scene.gaussians(np.asarray(scene.at(0).means), 0.02)
    loop.resume(decode(None, keyframe_packet(start, 0, cameras, config.codec)), [images[1:]])
    return loop


def measure(
    scene: Scene, config: StreamConfig, recorded: list[list[np.ndarray]], live: bool = True
) -> dict[str, Any]:
    """Fit the later frames but the last; return seconds, shares of what is processed, bytes,
    held-out PSNR.

    Unless they arrive `live`, the next frame is observed while one is fitted, in another thread.
    """
    camera = scene.cameras()[0]
    loop = loop_of(scene, config, recorded[0])
    rows = []
    for images, upcoming in pairwise(recorded[1:]):
        dr.sync_thread()
        _, report = loop.push(images[1:], upcoming=None if live else upcoming[1:])
        assert loop.gaussians is not None
        image = np.asarray(rasterize(loop.gaussians, camera, ("color",)).color)
        scores = {"bytes": report.num_bytes, "psnr": psnr(np.clip(image, 0, 1), images[0] / 255.0)}
        rows.append({"seconds": report.seconds, **report.active, **scores})
    return {name: float(f"{median(row[name] for row in rows[1:]):.4g}") for name in rows[0]}


def main(options: Options) -> None:
    """Run the benchmark."""
    mi.set_variant(options.variant)
    result: dict[str, Any] = {"seed": _SEED, "noise": NOISE, "variant": options.variant}
    for name in options.sizes:
        size = SIZES[name]
        scene = Scene(size, _SEED)
        images = scene.recorded(options.frames + 2, _SEED)
        configs: dict[str, StreamConfig] = {}
        for epochs in options.epochs:
            config = default_config(size, epochs)
            configs |= {f"default, {epochs} epochs{live}": config for live in ("", ", live")}
        if name in options.full:
            config = default_config(size, 8)
            everything = replace(config, fit=replace(config.fit, skip_static=False))
            configs["8 epochs, nothing left out"] = everything
            configs["paper, 8 epochs"] = apply_preset(everything, "paper")
        rows = {}
        for label, config in configs.items():
            live = label.endswith("live") or not label.startswith("default")
            rows[label] = measure(scene, config, images, live)
            print(f"{name:6s} {label:28s}", json.dumps(rows[label]), flush=True)
        result[name] = {"size": vars(size), "runs": rows}
    options.write(result, unprinted=options.sizes)


if __name__ == "__main__":
    main(tyro.cli(Options))
