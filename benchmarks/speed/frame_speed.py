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
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import tyro

from benchmarks.speed.output import Output
from morgs_mi import Camera, Gaussians, rasterize
from morgs_mi.codec.packets import decode, keyframe_packet
from morgs_mi.fit.fit_config import DensityConfig, FitConfig
from morgs_mi.loop.stream_config import StreamConfig, apply_preset
from morgs_mi.stream_loop import StreamLoop

NOISE = 2.0  # grey levels
_SEED = 0


@dataclass(frozen=True)
class Size:
    """Size of a rig and its scene.

    Attributes:
        width: width of the images, px.
        height: height of the images, px.
        views: number of training views.
        gaussians: number of Gaussians.
        movers: number of moving balls, out of 40.
    """

    width: int
    height: int
    views: int
    gaussians: int
    movers: int


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
        count = size.gaussians
        flat = count // 3
        each = (count - 2 * (count // 3)) // 40
        wall = np.stack([rng.uniform(-3, 3, flat), rng.uniform(-2, 1, flat), np.full(flat, 1.5)], 1)
        floor = np.stack(
            [rng.uniform(-3, 3, flat), np.full(flat, 1.0), rng.uniform(-1.5, 1.5, flat)], 1
        )
        centers = np.stack(
            [rng.uniform(-1.8, 1.8, 40), rng.uniform(-1.2, 0.6, 40), rng.uniform(-0.8, 1.0, 40)], 1
        )
        self.owner = np.concatenate([np.full(2 * flat, -1), np.repeat(np.arange(40), each)])
        self.local = rng.normal(size=(40 * each, 3))
        self.local *= 0.22 / np.linalg.norm(self.local, axis=1, keepdims=True)
        self.centers = centers
        self.ground = np.concatenate([wall, floor])
        rest = np.concatenate([self.ground, centers.repeat(each, 0) + self.local])
        waves = np.sin(rest @ rng.normal(0, 6, (3, 3)) + rng.uniform(0, 6, 3)) * np.sin(
            rest @ rng.normal(0, 15, (3, 3))
        )
        self.sh = (0.9 * waves)[:, None, :].astype(np.float32)
        spacing = np.where(self.owner < 0, (18 / flat) ** 0.5, (4 * np.pi * 0.22**2 / each) ** 0.5)
        self.scales = np.repeat(0.7 * spacing[:, None], 3, 1)
        # The balls nearest to the centre move: a compact region of the image.
        self.moving = np.argsort(np.linalg.norm(centers[:, :2], axis=1))[: size.movers]
        self.direction = rng.normal(size=(40, 3)) * (0.02, 0.02, 0.01)

    def at(self, frame: int) -> Gaussians:
        """Return the true Gaussians of a frame."""
        angle = 0.05 * frame
        turn = np.array(
            [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        )
        owner = self.owner[len(self.ground) :]
        moves = np.isin(owner, self.moving)[:, None]
        balls = self.centers[owner] + np.where(
            moves, self.local @ turn.T + frame * self.direction[owner], self.local
        )
        return self.gaussians(np.concatenate([self.ground, balls]))

    def gaussians(self, means: np.ndarray, noise: float = 0.0, seed: int = 0) -> Gaussians:
        """Return Gaussians at the given means [N, 3], with noise of a standard deviation `noise` on
        the SH.
        """
        rng = np.random.default_rng(seed)
        count = len(means)
        sh = self.sh + noise * rng.normal(size=self.sh.shape)
        quats = np.tile([1.0, 0, 0, 0], (count, 1))
        opacities = np.full(count, 0.9)
        return Gaussians.from_activated(
            means, self.scales, quats, opacities, sh, logit_confidence=np.zeros(count)
        )

    def cameras(self) -> list[Camera]:
        """Return the held-out camera and then the training cameras, on an arc in two rows."""
        angles = np.linspace(-0.5, 0.5, self.size.views)
        places = [
            (5 * np.sin(a), -0.6 + 0.5 * (i % 2), -4.5 * np.cos(a)) for i, a in enumerate(angles)
        ]
        size = (self.size.width, self.size.height)
        return [
            Camera.look_at(p, (0, -0.2, 0.3), (0, -1, 0), 38, *size)
            for p in [(0.1, -0.4, -4.5), *places]
        ]

    def recorded(self, num_frames: int, seed: int) -> list[list[np.ndarray]]:
        """Return the images of the first frames, with camera noise, by camera."""
        rng = np.random.default_rng(seed)
        return [film(self.at(frame), self.cameras(), rng) for frame in range(num_frames)]


def film(gaussians: Gaussians, cameras: list[Camera], rng: np.random.Generator) -> list[np.ndarray]:
    """Return the recorded image of each camera."""
    images = []
    for camera in cameras:
        image = np.asarray(rasterize(gaussians, camera, ("color",)).color)
        noisy = 255 * image + rng.normal(0, NOISE, image.shape)
        images.append(np.clip(noisy + 0.5, 0, 255).astype(np.uint8))
    return images


def config_of(size: Size, **fit: Any) -> StreamConfig:
    """Return the settings of a fit at a size, with further ones of `FitConfig`."""
    return StreamConfig(
        FitConfig(
            sh_degree=0, density=DensityConfig(max_gaussians=round(1.1 * size.gaussians)), **fit
        )
    )


def measure(
    scene: Scene, config: StreamConfig, recorded: list[list[np.ndarray]], live: bool = True
) -> dict[str, Any]:
    """Fit the later frames but the last; return seconds, shares of what is processed, bytes,
    held-out PSNR.

    Unless they arrive `live`, the next frame is observed while one is fitted, in another thread.
    """
    cameras = scene.cameras()
    loop = StreamLoop(cameras[1:], np.zeros((200, 3)), np.zeros((200, 3)), config)
    start = scene.gaussians(np.asarray(scene.at(0).means), 0.02)
    loop.resume(decode(None, keyframe_packet(start, 0, cameras, config.codec)), [recorded[0][1:]])
    rows = []
    for images, upcoming in pairwise(recorded[1:]):
        dr.sync_thread()
        _, report = loop.push(images[1:], upcoming=None if live else upcoming[1:])
        assert loop.gaussians is not None
        image = np.asarray(rasterize(loop.gaussians, cameras[0], ("color",)).color)
        squares = (np.clip(image, 0, 1) - images[0] / 255.0) ** 2
        rows.append(
            {
                "seconds": report.seconds,
                **report.active,
                "bytes": report.num_bytes,
                "psnr": -10 * np.log10(squares.mean()),
            }
        )
    return {name: float(f"{median(row[name] for row in rows[1:]):.4g}") for name in rows[0]}


def settings(options: Options, name: str) -> dict[str, StreamConfig]:
    """Return the settings that are run at a size, by name."""
    runs = {
        f"default, {epochs} epochs": config_of(SIZES[name], epochs=epochs)
        for epochs in options.epochs
    }
    if name in options.full:
        runs["8 epochs, nothing left out"] = config_of(SIZES[name], skip_static=False)
        runs["paper, 8 epochs"] = apply_preset(config_of(SIZES[name], skip_static=False), "paper")
    return runs


def main(options: Options) -> None:
    """Run the benchmark."""
    mi.set_variant(options.variant)
    result: dict[str, Any] = {"seed": _SEED, "noise": NOISE, "variant": options.variant}
    for name in options.sizes:
        scene = Scene(SIZES[name], _SEED)
        rows = {}
        images = scene.recorded(options.frames + 2, _SEED)
        for label, config in settings(options, name).items():
            for live in (False, True) if label.startswith("default") else (True,):
                row = f"{label}, live" if live and label.startswith("default") else label
                rows[row] = measure(scene, config, images, live)
                print(f"{name:6s} {row:28s}", json.dumps(rows[row]), flush=True)
        result[name] = {"size": vars(SIZES[name]), "runs": rows}
    options.write(result, unprinted=options.sizes)


if __name__ == "__main__":
    main(tyro.cli(Options))
