"""Time a later frame against the share of the pixels that change.

    python -m benchmarks.speed.moving_share --json moving_share.json --plot moving_share.png

The scene is `frame_speed`'s at the size `small`, in which 0 to 40 balls move; in the last row the light flickers,
and every pixel changes. Each scene is also fitted with nothing left out. One view is held out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.plots import blank_figure, save_figure
from benchmarks.speed.frame_speed import SIZES, Scene, config_of, measure
from benchmarks.speed.output import Output
from morgs_mi import SH_C0, Gaussians, rasterize

RUNS = ("default", "nothing left out")
VISIBLE = 4 / 255
"""Change of a pixel's colour from which it counts, two standard deviations of the noise."""


@dataclass(frozen=True)
class Options(Output):
    """Work and output."""

    plot: Path | None = None
    """Image of the plot, .png or .svg."""
    size: str = "small"
    """Size of the rig, small or n3dv."""
    movers: tuple[int, ...] = (0, 1, 2, 5, 10, 20, 40)
    """Numbers of moving balls."""
    frames: int = 4
    """Number of later frames; the first is warm-up, medians of the others are reported."""
    epochs: int = 2
    """Epochs of a later frame."""
    seed: int = 0
    """Seed of scene and noise."""


class FlickeringScene(Scene):
    """The scene with all balls at rest under a light that is brighter in every second frame."""

    def at(self, frame: int) -> Gaussians:
        """Return the true Gaussians of a frame."""
        gaussians = super().at(frame)
        brighter = (1 + 0.1 * (frame % 2)) * (0.5 + SH_C0 * self.sh) - 0.5
        return replace(gaussians, sh_coeffs=brighter / SH_C0)


def changed_share(scene: Scene) -> float:
    """Return the share of the training views' pixels that change visibly from frame 0 to frame 1."""
    before, after = (
        [np.asarray(rasterize(scene.at(frame), camera, ("color",)).color) for camera in scene.cameras()[1:]]
        for frame in (0, 1)
    )
    return float(np.mean([(np.abs(b - a) > VISIBLE).any(axis=-1).mean() for b, a in zip(before, after, strict=True)]))


def fits(scene: Scene, options: Options) -> dict[str, Any]:
    """Return the figures of a scene, with and without leaving out what is static."""
    recorded = scene.recorded(options.frames + 2, options.seed)
    runs = {
        name: measure(scene, config_of(scene.size, epochs=options.epochs, skip_static=skip), recorded)
        for name, skip in zip(RUNS, (True, False), strict=True)
    }
    return {"changed": changed_share(scene), **runs}


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Plot seconds over the changed share."""
    figure = blank_figure(6, 4)
    axes = figure.add_subplot()
    for name in RUNS:
        axes.plot([100 * row["changed"] for row in rows], [row[name]["seconds"] for row in rows], "o-", label=name)
    axes.set(xlabel="changed pixels, %", ylabel="seconds per frame", ylim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend()
    save_figure(figure, path)


def main(options: Options) -> None:
    """Run the benchmark."""
    mi.set_variant("llvm_ad_rgb")
    size = SIZES[options.size]
    scenes = [Scene(replace(size, movers=count), options.seed) for count in options.movers]
    rows = []
    for scene in [*scenes, FlickeringScene(replace(size, movers=0), options.seed)]:
        rows.append(fits(scene, options))
        print(
            f"{rows[-1]['changed']:6.1%}", *(f"{rows[-1][n]['seconds']:.2f} s" for n in ("default", "nothing left out"))
        )
    if options.plot is not None:
        draw(rows, options.plot)
    options.write({"size": vars(size), "epochs": options.epochs, "rows": rows}, unprinted=["rows"])


if __name__ == "__main__":
    main(tyro.cli(Options))
