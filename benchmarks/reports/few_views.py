"""Views between the cameras of rigs with few or distant cameras: how much worse they are than those trained on.

    python -m benchmarks.reports.few_views --seeds 0 1 2 3 4 5 --captures CAPTURE --json out.json

Each seed gives two clips: `morgs-mi synth random`, as in `random_scenes`, and the same scene without its side walls,
with 13 cameras on an arc of 120 degrees. Of each, some cameras that are spread over the rig are trained on, and all
others are held out. Of the captures given by `--captures`, one camera is held out in turn. The points of the clips are
not used.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.cells import CellOptions
from benchmarks.reports.fits import first_frame, random_capture
from benchmarks.reports.plots import grouped, markdown, plus_minus
from morgs_mi.calibration.rig_check import dense_points, match_capture, triangulate_points
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig
from morgs_mi.core.camera import Camera
from morgs_mi.fit.forecast import angles_to, forecast, quality_of, scene_depths
from morgs_mi.fit.noise import white_noise_of
from morgs_mi.synth.scene import load_scene
from morgs_mi.synth.synth_config import SynthConfig
from morgs_mi.synth.synthesize import synthesize

Points = Literal["stereo", "triangulated", "random"]


@dataclass(frozen=True)
class Options(CellOptions):
    """Clips, work and output."""

    seeds: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    """Seeds of the scenes."""
    clips: Path = Path("out/random")
    """Folder of the clips."""
    rigs: tuple[Literal["random", "wide"], ...] = ("random", "wide")
    """Rigs of the clips."""
    captures: tuple[Path, ...] = ()
    """Further captures, which are reduced by eight."""
    views: tuple[int, ...] = (3, 4, 6, 8, 12)
    """Numbers of training views of the clips."""
    points: tuple[Points, ...] = ("stereo",)
    """Points that the first frame starts from: triangulated and from stereo, triangulated, or random."""
    droppings: tuple[float, ...] = (0.0,)
    """Probabilities of dropping."""
    downscale: float = 2
    """Factor by which the clips are reduced."""
    steps: int = 800
    """Steps of the first frame."""
    gaussians: int = 8000
    """Number of Gaussians."""
    fit_seeds: tuple[int, ...] = (0,)
    """Seeds of the fits of each rig."""


def wide_capture(clips: Path, seed: int, downscale: float) -> Capture:
    """Return the random scene of a seed on an arc of 120 degrees, which is made in `clips` if it is not there."""
    clip = clips / f"wide-{seed}"
    if not clip.exists():
        scene = load_scene("random", seed)
        objects = {name: item for name, item in scene.objects.items() if name not in ("left", "right")}
        scene = replace(scene, objects=objects, rig=replace(scene.rig, spread=(60.0, 10.0)))
        synthesize(scene, clip, SynthConfig(cameras=13, frames=1, seed=seed))
    return load_capture(clip, downscale)


def spread_views(cameras: Sequence[Camera], count: int, among: Sequence[int]) -> tuple[int, ...]:
    """Return the indices of `count` of the cameras `among` all that are far from each other."""
    positions = np.array([cameras[v].position for v in among])
    chosen = [int(np.argmax(np.linalg.norm(positions - positions.mean(axis=0), axis=1)))]
    while len(chosen) < count:
        distance = np.linalg.norm(positions[:, None] - positions[chosen], axis=-1).min(axis=1)
        chosen.append(int(np.argmax(distance)))
    return tuple(sorted(among[k] for k in chosen))


def cases(options: Options) -> Iterator[tuple[Capture, tuple[int, ...]]]:
    """Yield each capture and the views to train on."""
    for seed in options.seeds:
        for rig in options.rigs:
            make = random_capture if rig == "random" else wide_capture
            capture = make(options.clips, seed, options.downscale)
            others = capture.train_views
            for count in (n for n in options.views if n <= len(others)):
                yield capture, spread_views(capture.cameras, count, others)
    for path in options.captures:
        capture = load_capture(path, 8)
        views = range(len(capture.cameras))
        for held_out in views:
            train = tuple(v for v in views if v != held_out)
            yield capture, train


def with_points(capture: Capture, train: Sequence[int], points: Points) -> Capture:
    """Return the capture with the points that some of its views give."""
    if points == "random":
        return replace(capture, points=capture.points[:0], point_colors=capture.point_colors[:0])
    cameras, masks, sources = (
        tuple(of_view[v] for v in train) for of_view in (capture.cameras, capture.masks, capture._sources)
    )
    alone = replace(capture, cameras=cameras, masks=masks, _sources=sources, test_view=None)
    find = dense_points if points == "stereo" else triangulate_points
    found = find(alone, match_capture(alone))
    return replace(capture, points=found.points, point_colors=found.point_colors)


def measure(source: Source, train: Sequence[int], points: Points, config: StreamConfig) -> dict[str, Any]:
    """Return the PSNR of the training views and of each held-out one, with its angles to the training views.

    `noise` is the standard deviation of the white noise of the training views.
    """
    capture = with_points(source.open(), train, points)
    scores, report = first_frame(capture, train, config)
    images = next(capture.frames(0, 1)).images
    cameras = [capture.cameras[v] for v in train]
    rig, held_out = forecast(cameras, capture.points), [v for v in range(len(capture.cameras)) if v not in train]
    depths = scene_depths(capture.cameras, capture.points)
    angles = {v: np.sort(angles_to(capture.cameras[v], depths[v], cameras)) for v in held_out}
    return {
        "train": list(train),
        "points": len(capture.points),
        "noise": round(float(np.mean([white_noise_of(images[v]) for v in train])), 3),
        "spacing": round(rig.spacing, 2),
        "overlap": round(rig.overlap, 3),
        "reach": round(rig.reach, 2),
        "forecast": rig.quality,
        "training": round(float(scores[list(train)].mean()), 2),
        "held_out": [
            {"view": v, "angles": angles[v][:3].round(2).tolist(), "psnr": round(float(scores[v]), 2)} for v in held_out
        ],
        "seconds": round(report.seconds, 1),
    }


def held_out_psnr(fit: Mapping[str, Any]) -> float:
    """Return the mean PSNR of the held-out views of a fit, dB."""
    return float(np.mean([view["psnr"] for view in fit["held_out"]]))


def points_table(fits: Sequence[Mapping[str, Any]]) -> str:
    """Return the held-out PSNR of each clip by the points that its fits start from, in Markdown."""
    rows: dict[str, list[str]] = {}
    for each in grouped(fits, "capture", "train", "start").values():
        found = plus_minus([held_out_psnr(fit) for fit in each])
        rows.setdefault(each[0]["capture"], []).append(f"{found} dB, {each[0]['points']:,} points")
    starts = dict.fromkeys(fit["start"] for fit in fits)
    return markdown(("clip", *starts), ((f"`{name}`", *cells) for name, cells in rows.items()))


def dropping_table(fits: Sequence[Mapping[str, Any]]) -> str:
    """Return the held-out PSNR of each rig by the probability of dropping, in Markdown."""
    rows: dict[tuple[str, ...], list[str]] = {}
    for each in grouped(fits, "capture", "train", "dropping").values():
        first = each[0]
        about = f"`{first['capture']}`", f"{len(first['train'])}", f"{first['noise']:.3f}"
        rows.setdefault(about, []).append(f"{plus_minus([held_out_psnr(fit) for fit in each])} dB")
    strengths = (f"p = {p:g}" for p in dict.fromkeys(fit["dropping"] for fit in fits))
    return markdown(("clip", "training views", "noise", *strengths), ((*about, *row) for about, row in rows.items()))


def forecast_table(fits: Sequence[Mapping[str, Any]]) -> str:
    """Return the held-out PSNR of each rig and number of views, and how often the forecast is right, in Markdown.

    Ranges are those of the captures, each of which is the mean of its fits.
    """
    rigs: dict[tuple[str, int], list[tuple[float, ...]]] = {}
    for each in grouped(fits, "capture", "train").values():
        first, psnr = each[0], float(np.mean([held_out_psnr(fit) for fit in each]))
        loss = float(np.mean([fit["training"] for fit in each])) - psnr
        right = first["forecast"] == quality_of(psnr, loss, 0.0)
        key = first["capture"].partition("-")[0], len(first["train"])
        rigs.setdefault(key, []).append((first["spacing"], first["reach"], psnr, loss, right))
    rows = []
    for (rig, views), found in sorted(rigs.items(), key=lambda item: (item[0][0], -item[0][1])):
        spacing, reach, psnr, loss, right = zip(*found, strict=True)
        measured = _span(spacing, 0), _span(reach, 0), f"{_span(psnr)} dB", f"{_span(loss)} dB"
        rows.append((f"`{rig}`", f"{views}", *measured, f"{sum(right):.0f} of {len(right)}"))
    return markdown(("rig", "views", "degrees apart", "`reach`", "held-out views", "loss", "forecast right"), rows)


def _span(values: Sequence[float], digits: int = 1) -> str:
    """Return the smallest and the largest value, or the only one."""
    low, high = f"{min(values):.{digits}f}", f"{max(values):.{digits}f}"
    return low if low == high else f"{low} to {high}"


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    config, about, cells = StreamConfig(), {}, {}
    fit = replace(config.fit, first_frame_steps=options.steps, num_gaussians=options.gaussians)
    settings = options.points, options.droppings, options.fit_seeds
    for (capture, train), points, dropping, seed in product(cases(options), *settings):
        name = f"{capture.path} {train} {points} {dropping:g} {seed}"
        own = replace(config, seed=seed, fit=replace(fit, dropping=dropping))
        cells[name] = Source.of(capture), train, points, own
        about[name] = {"capture": capture.path.name, "start": points, "dropping": dropping, "seed": seed}
    rows = [{**about[name], **row} for name, row in options.run(measure, cells).items()]
    given = {"downscale": options.downscale, "steps": options.steps, "gaussians": options.gaussians}
    options.write({**given, "fits": rows}, unprinted=["fits"])


if __name__ == "__main__":
    main(tyro.cli(Options))
