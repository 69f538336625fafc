"""One cell of the report on the method: a clip fitted with one setting and one seed, and what it is worth.

All cells of a clip and a seed go on from the very same first frame, which depends on no preset and no number of epochs;
it is fitted once and kept as a stream of one keyframe. A cell's scores are kept as a small JSON file, named after a
digest of all that they depend on: the settings, the pictures, and the sources of the method (or a version in words).
What has a file of that name is not fitted again.
"""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import morgs_mi
from morgs_mi.capture.capture import Capture
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import coded_frames
from morgs_mi.config import StreamConfig, apply_preset
from morgs_mi.core.files import whole, write_json
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.playback.player import open_stream
from morgs_mi.stream_loop import FrameReport, StreamLoop, StreamState

__all__ = ["DEFAULT", "Cell", "Clip", "Scores", "method_version", "scores_of", "scratch_scores"]

# What a preset is called that changes nothing.
DEFAULT = "default"
# Means over the later frames of these; `by_frame` has those that are drawn over time.
_MEANS = ("psnr", "psnr_moving", "psnr_still", "ssim", "motion_error_moving", "motion_error_still")
_MEANS += ("true_motion_moving", "confidence_iou", "num_bytes")
_BY_FRAME = ("psnr", "psnr_moving", "motion_error_moving")
_MOTION_3D = ("error", "relative_error", "length_ratio", "angle")
_JUDGES = ("evaluate.py", "metrics.py", "motion3d.py", "temporal.py")

Scores = dict[str, Any]


@dataclass(frozen=True)
class Cell:
    """A setting and a seed.

    Attributes:
        preset: name out of `fit.presets`, or ``default``.
        epochs: passes over the views for every later frame, whatever the preset says.
        key_views: cameras with optical flow.
        rates: factor on all learning rates of later frames.
        seed: of the first frame and all that follows.
    """

    preset: str
    epochs: int
    key_views: int
    rates: float
    seed: int

    def config(self, base: StreamConfig) -> StreamConfig:
        """Return `base` with this setting."""
        if self.preset != DEFAULT:
            base = apply_preset(base, self.preset)  # pyright: ignore[reportArgumentType]
        faster = {name: self.rates * rate for name, rate in asdict(base.fit.rates).items()}
        fit = replace(base.fit, epochs=self.epochs, rates=replace(base.fit.rates, **faster))
        return replace(base, fit=fit, motion=replace(base.motion, key_views=self.key_views), seed=self.seed)

    def __str__(self) -> str:
        return f"{self.preset}-{self.epochs}e-{self.key_views}k-{self.rates:g}x-s{self.seed}"


@dataclass(frozen=True, eq=False)
class Clip:
    """A capture whose pictures are in memory.

    Attributes:
        capture: the recording.
        images: by frame, by training view, uint8 [H, W, 3].
        digest: of the pictures and the points.
    """

    capture: Capture
    images: tuple[tuple[np.ndarray, ...], ...]
    digest: str

    @classmethod
    def read(cls, capture: Capture) -> Clip:
        """Decode a capture."""
        images = tuple(tuple(f.images[v] for v in capture.train_views) for f in capture.frames())
        contents = hashlib.sha256(np.ascontiguousarray(capture.points).tobytes())
        for picture in (picture for frame in images for picture in frame):
            contents.update(np.ascontiguousarray(picture))
        return cls(capture, images, contents.hexdigest())

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.capture.path.resolve().name

    def loop(self, config: StreamConfig) -> StreamLoop:
        """Return the loop on the training views, before its first frame."""
        capture, train = self.capture, self.capture.train_views
        cameras, masks = [capture.cameras[v] for v in train], [capture.masks[v] for v in train]
        return StreamLoop(cameras, capture.points, capture.point_colors, config, masks)

    def writer(self, path: Path, config: StreamConfig) -> StreamWriter:
        """Return a new stream of this clip."""
        about = {"capture": str(self.capture.path.resolve()), "downscale": self.capture.downscale}
        about |= {"test_view": self.capture.test_view, "config": asdict(config)}
        return StreamWriter(path, self.capture.cameras, self.capture.fps, about)


def method_version(package: Path = Path(morgs_mi.__file__).parent) -> str:
    """Return a digest of the judges' sources, of the loop's, and of all that the loop imports from this package.

    Layout and comments do not count.
    """
    trees: dict[Path, ast.Module] = {}
    waiting = [package / "stream_loop.py"]
    while waiting:
        file = waiting.pop()
        if file not in trees:
            trees[file] = ast.parse(file.read_text(encoding="utf-8"))
            waiting += _imported(trees[file], package)
    for file in (package / "evaluate" / name for name in _JUDGES):
        trees[file] = ast.parse(file.read_text(encoding="utf-8"))
    sources = hashlib.sha256()
    for file in sorted(trees):
        sources.update(ast.dump(trees[file]).encode())
    return sources.hexdigest()[:16]


def _imported(tree: ast.Module, package: Path) -> list[Path]:
    """Return the files of the package that a module imports anything from."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == package.name:
            room = package.joinpath(*(node.module or "").split(".")[1:])
            files = [
                room.with_suffix(".py"),
                room / "__init__.py",
                *(room / f"{alias.name}.py" for alias in node.names),
            ]
            found += [file for file in files if file.is_file()]
    return found


def scores_of(clip: Clip, cell: Cell, base: StreamConfig, version: str, out: Path) -> Scores:
    """Return a cell's scores: from OUT/CLIP if they are there, else from a fit that leaves them there.

    Args:
        clip: two frames or more.
        cell: setting and seed.
        base: what the cell is a variation of.
        version: of the method.
        out: folder.

    Returns:
        Means over the later frames in the held-out view (else the training views): ``psnr``, ``psnr_moving``,
        ``psnr_still`` in dB, ``ssim``, ``motion_error_moving`` and ``_still`` and ``true_motion_moving`` in px,
        ``confidence_iou``, ``motion_3d_error`` in world units, ``_relative_error`` and ``_length_ratio`` of the true
        length, ``_angle`` in degrees, ``num_bytes``; ``mtv`` and ``mtv_input`` (x100), ``psnr_slope`` in dB a frame,
        ``seconds``, the median of a later frame; ``by_frame``, lists of some of them. None where unknown.
    """
    config = cell.config(base)
    kept = out / clip.name / f"{cell}-{_digest(version, clip.digest, asdict(config))}.json"
    if not kept.is_file():
        first = _first_frame(clip, replace(base, seed=cell.seed), version, out)
        write_json(kept, {"cell": asdict(cell), "version": version, "scores": _fit(clip, config, first)})
    return _read(kept)


def scratch_scores(clip: Clip, frame: int, base: StreamConfig, steps: int, version: str, out: Path) -> Scores:
    """Return the picture scores of one frame, fitted from scratch as a first frame is; kept as by `scores_of`.

    Args:
        clip: of the frame.
        frame: its index.
        base: settings; those of the first frame count.
        steps: of the fit, in place of the first frame's.
        version: of the method.
        out: folder.
    """
    config = replace(base, fit=replace(base.fit, first_frame_steps=steps))
    kept = out / clip.name / f"scratch-f{frame}-{steps}-{_digest(version, clip.digest, asdict(config))}.json"
    if not kept.is_file():
        loop = clip.loop(config)
        loop.state = StreamState(frame, None, ())
        with TemporaryDirectory() as folder:
            path = Path(folder) / "stream.morgs"
            with clip.writer(path, config) as writer:
                packet, report = loop.push(clip.images[frame])
                writer.write(packet)
            row = evaluate_stream(path, clip.capture.path)["frames"][0]
        picture = {name: row[name] for name in ("psnr", "psnr_moving", "psnr_still", "ssim")}
        about = {"frame": frame, "steps": steps, "version": version}
        write_json(kept, {**about, "scores": picture | {"seconds": report.seconds}})
    return _read(kept)


def _first_frame(clip: Clip, base: StreamConfig, version: str, out: Path) -> Path:
    """Return the stream that holds the first frame of `base`, fitted if there is none."""
    path = out / clip.name / f"first-s{base.seed}-{_digest(version, clip.digest, asdict(base))}.morgs"
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        packet, _ = clip.loop(base).push(clip.images[0])
        with whole(path, "report_method()") as partial, clip.writer(partial, base) as writer:
            writer.write(packet)
    return path


def _fit(clip: Clip, config: StreamConfig, first: Path) -> Scores:
    """Fit all later frames and return what they are worth."""
    loop, stream = clip.loop(config), open_stream(first)
    (packet,) = stream
    (coded,) = coded_frames([packet])
    loop.resume(coded, clip.images[:1])
    reports: list[FrameReport] = []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "stream.morgs"
        with clip.writer(path, config) as writer:
            writer.write(packet)
            for images in clip.images[1:]:
                packet, report = loop.push(images)
                writer.write(packet)
                reports.append(report)
        return _summary(evaluate_stream(path, clip.capture.path), reports)


def _summary(found: Mapping[str, Any], reports: Sequence[FrameReport]) -> Scores:
    later = found["frames"][1:]
    motion = [row["motion_3d"] for row in later if row["motion_3d"]]
    return {
        **{name: _mean([row[name] for row in later]) for name in _MEANS},
        **{f"motion_3d_{name}": _mean([row[name] for row in motion]) for name in _MOTION_3D},
        "mtv": found["mtv"]["render"],
        "mtv_input": found["mtv"]["input"],
        "psnr_slope": found["psnr_slope"],
        "seconds": float(np.median([report.seconds for report in reports])),
        "by_frame": {name: [row[name] for row in later] for name in _BY_FRAME},
    }


def _read(path: Path) -> Scores:
    try:
        return json.loads(path.read_text(encoding="utf-8"))["scores"]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected a cell's scores, got something else ({error!r}); remove it.") from None


def _digest(*parts: Any) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:12]


def _mean(values: Sequence[float]) -> float:
    """Return the mean of what is known, NaN where nothing is."""
    known = [value for value in values if value == value]
    return float(np.mean(known)) if known else float("nan")
