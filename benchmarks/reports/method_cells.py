"""One cell of the report on the method: the scores of a clip that is fitted with one setting and one seed.

All cells of a clip and a seed continue from the same first frame, which depends neither on the preset nor on the number
of epochs. It is fitted once and stored as a stream of one keyframe. A cell's scores are stored as a small JSON file
whose name contains a digest of everything that they depend on: the settings, the images, and the sources of the method
(or a given version). If the file exists, the cell is not fitted again.

Cells may be fitted by workers, side by side (`fit_cells`). Their files are written by this process.
"""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import morgs_mi
from benchmarks.reports.cells import run_cells
from benchmarks.reports.fits import new_loop
from benchmarks.reports.method_results import ScratchRow
from benchmarks.reports.records import from_json
from morgs_mi.capture.capture import Capture
from morgs_mi.cluster.executor import Workers
from morgs_mi.cluster.tasks import Source
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import coded_frames
from morgs_mi.config import StreamConfig, apply_preset
from morgs_mi.core.files import atomic_path, write_json
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.evaluate.results import Evaluation, known_mean
from morgs_mi.playback.player import open_stream
from morgs_mi.stream_loop import FrameReport, StreamLoop, StreamState

__all__ = ["DEFAULT", "Cell", "Clip", "Scores", "fit_cells", "method_version", "scores_of", "scratch_scores"]

# Name of the settings without a preset.
DEFAULT = "default"
# Scores that are averaged over the later frames; `by_frame` has those that are plotted over time.
_MEANS = ("psnr", "psnr_moving", "psnr_still", "ssim", "motion_error_moving", "motion_error_still")
_MEANS += ("true_motion_moving", "confidence_iou")
_BY_FRAME = ("psnr", "psnr_moving", "motion_error_moving")
_MOTION_3D = ("error", "relative_error", "length_ratio", "angle")
_OPEN: dict[str, Clip] = {}  # the clip of a worker's last task
_EVALUATION = ("comparison.py", "evaluate.py", "measures.py", "metrics.py", "motion3d.py", "results.py", "temporal.py")

Scores = dict[str, Any]


@dataclass(frozen=True)
class Cell:
    """A setting and a seed.

    Attributes:
        preset: name of a preset, or ``default``.
        epochs: passes over the views for every later frame; overrides the preset.
        key_views: cameras with optical flow.
        rates: factor on all learning rates of later frames.
        seed: seed of the first frame and of all later ones.
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
        scaled = {name: self.rates * rate for name, rate in asdict(base.fit.rates).items()}
        fit = replace(base.fit, epochs=self.epochs, rates=replace(base.fit.rates, **scaled))
        return replace(base, fit=fit, motion=replace(base.motion, key_views=self.key_views), seed=self.seed)

    def __str__(self) -> str:
        return f"{self.preset}-{self.epochs}e-{self.key_views}k-{self.rates:g}x-s{self.seed}"


@dataclass(frozen=True, eq=False)
class Clip:
    """A capture with its images in memory.

    Attributes:
        capture: the recording.
        images: images by frame and training view, uint8 [H, W, 3].
        digest: digest of the images and the points.
    """

    capture: Capture
    images: tuple[tuple[np.ndarray, ...], ...]
    digest: str

    @classmethod
    def read(cls, capture: Capture) -> Clip:
        """Return a capture with its images decoded."""
        images = tuple(tuple(f.images[v] for v in capture.train_views) for f in capture.frames())
        contents = hashlib.sha256(np.ascontiguousarray(capture.points).tobytes())
        for image in (image for frame in images for image in frame):
            contents.update(np.ascontiguousarray(image).data)
        return cls(capture, images, contents.hexdigest())

    @property
    def name(self) -> str:
        """Name of the capture's folder."""
        return self.capture.path.resolve().name

    def loop(self, config: StreamConfig) -> StreamLoop:
        """Return a loop on the training views, before its first frame."""
        return new_loop(self.capture, config)

    def writer(self, path: Path, config: StreamConfig) -> StreamWriter:
        """Return a writer of a new stream of this clip."""
        about = {"capture": str(self.capture.path.resolve()), "downscale": self.capture.downscale}
        about |= {"test_view": self.capture.test_view, "config": asdict(config)}
        return StreamWriter(path, self.capture.cameras, self.capture.fps, about)


def method_version(package: Path = Path(morgs_mi.__file__).parent) -> str:
    """Return a digest of the sources of the evaluation, of the loop, and of all modules that the loop imports.

    Layout and comments do not count.
    """
    sources, trees = hashlib.sha256(), _sources(package)
    for file in sorted(trees):
        sources.update(ast.dump(trees[file]).encode())
    return sources.hexdigest()[:16]


def _sources(package: Path) -> dict[Path, ast.Module]:
    """Return the syntax trees on which the version of the method depends, by file."""
    trees: dict[Path, ast.Module] = {}
    waiting = [package / "stream_loop.py"]
    while waiting:
        file = waiting.pop()
        if file not in trees:
            trees[file] = ast.parse(file.read_text(encoding="utf-8"))
            waiting += _imported(trees[file], package)
    for file in (package / "evaluate" / name for name in _EVALUATION):
        trees[file] = ast.parse(file.read_text(encoding="utf-8"))
    return trees


def _imported(tree: ast.Module, package: Path) -> list[Path]:
    """Return the files of the package from which a module imports."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == package.name:
            module = package.joinpath(*(node.module or "").split(".")[1:])
            files = [
                module.with_suffix(".py"),
                module / "__init__.py",
                *(module / f"{alias.name}.py" for alias in node.names),
            ]
            found += [file for file in files if file.is_file()]
    return found


def scores_of(clip: Clip, cell: Cell, base: StreamConfig, version: str, out: Path) -> Scores:
    """Return a cell's scores, from OUT/CLIP if they are stored there; otherwise fit the cell and store them.

    Args:
        clip: two frames or more.
        cell: setting and seed.
        base: settings that all cells share.
        version: version of the method.
        out: folder.

    Returns:
        Means over the later frames in the held-out view (or all training views): ``psnr``, ``psnr_moving``,
        ``psnr_still`` in dB, ``ssim``, ``motion_error_moving`` and ``_still`` and ``true_motion_moving`` in px,
        ``confidence_iou``, ``motion_3d_error`` in world units, ``_relative_error`` and ``_length_ratio`` of the true
        length, ``_angle`` in degrees, ``num_bytes``; ``mtv`` and ``mtv_input`` (x100), ``psnr_slope`` in dB per frame,
        ``seconds``, the median of a later frame; ``by_frame``, lists of some of them. None if unknown.
    """
    stored = _file(clip, cell, base, version, out)
    if not stored.is_file():
        first = _first_frame(clip, replace(base, seed=cell.seed), version, out)
        _store(stored, cell, version, _fit(clip, cell.config(base), first))
    return _read(stored)


def fit_cells(
    clip: Clip,
    cells: Sequence[Cell],
    base: StreamConfig,
    version: str,
    out: Path,
    workers: Workers,
    progress: Callable[[int], None],
) -> None:
    """Fit those cells that are not stored on workers, and store them for `scores_of`.

    Args:
        clip: two frames or more, at a path that all workers see.
        cells: cells.
        base: settings that all cells share.
        version: version of the method.
        out: folder.
        workers: from `open_workers`.
        progress: called with the number of cells that are stored.

    Raises:
        OSError: a worker died several times, or the scheduler was lost. The finished cells stay.
    """
    files = {cell: _file(clip, cell, base, version, out) for cell in cells}
    missing = [cell for cell, file in files.items() if not file.is_file()]
    firsts = {seed: _first_frame(clip, replace(base, seed=seed), version, out) for seed in {c.seed for c in missing}}
    source = Source.of(clip.capture)

    def store(cell: Cell, scores: Scores) -> None:
        _store(files[cell], cell, version, scores)
        progress(sum(file.is_file() for file in files.values()))

    args = {cell: (source, cell.config(base), firsts[cell.seed].read_bytes()) for cell in missing}
    run_cells(_fit_on_worker, args, workers, store)


def _fit_on_worker(source: Source, config: StreamConfig, first: bytes) -> Scores:
    """Return the scores of a cell; `first` is the stream with its first frame."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "first.morgs"
        path.write_bytes(first)
        return _fit(_clip_of(source), config, path)


def _clip_of(source: Source) -> Clip:
    """Return a clip, which the worker keeps for the next cell."""
    if (key := repr(source)) not in _OPEN:
        _OPEN.clear()
        _OPEN[key] = Clip.read(source.open())
    return _OPEN[key]


def _file(clip: Clip, cell: Cell, base: StreamConfig, version: str, out: Path) -> Path:
    """Return the file of a cell's scores."""
    return out / clip.name / f"{cell}-{_digest(version, clip.digest, asdict(cell.config(base)))}.json"


def _store(file: Path, cell: Cell, version: str, scores: Scores) -> None:
    write_json(file, {"cell": asdict(cell), "version": version, "scores": scores})


def scratch_scores(clip: Clip, frame: int, base: StreamConfig, steps: int, version: str, out: Path) -> ScratchRow:
    """Return the image scores of one frame that is fitted from scratch like a first frame; stored as by `scores_of`.

    Args:
        clip: clip of the frame.
        frame: index of the frame.
        base: settings; those of the first frame count.
        steps: number of steps, in place of the first frame's.
        version: version of the method.
        out: folder.
    """
    config = replace(base, fit=replace(base.fit, first_frame_steps=steps))
    stored = out / clip.name / f"scratch-f{frame}-{steps}-{_digest(version, clip.digest, asdict(config))}.json"
    if not stored.is_file():
        loop = clip.loop(config)
        loop.state = StreamState(frame)
        with TemporaryDirectory() as folder:
            path = Path(folder) / "stream.morgs"
            with clip.writer(path, config) as writer:
                packet, report = loop.push(clip.images[frame])
                writer.write(packet)
            found = evaluate_stream(path, clip.capture.path).frames[0].scores
        scores = {name: getattr(found, name) for name in ("psnr", "psnr_moving", "psnr_still", "ssim")}
        about = {"frame": frame, "steps": steps, "version": version}
        write_json(stored, {**about, "scores": scores | {"seconds": report.seconds}})
    return from_json(ScratchRow, {"frame": frame, "steps": steps, **_read(stored)})


def _first_frame(clip: Clip, base: StreamConfig, version: str, out: Path) -> Path:
    """Return the path of the stream with the first frame of `base`, which is fitted if it is missing."""
    path = out / clip.name / f"first-s{base.seed}-{_digest(version, clip.digest, asdict(base))}.morgs"
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        packet, _ = clip.loop(base).push(clip.images[0])
        with atomic_path(path, "report_method()") as partial, clip.writer(partial, base) as writer:
            writer.write(packet)
    return path


def _fit(clip: Clip, config: StreamConfig, first: Path) -> Scores:
    """Fit all later frames and return their scores."""
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


def _summary(found: Evaluation, reports: Sequence[FrameReport]) -> Scores:
    later = found.frames[1:]
    motion = [row.motion_3d for row in later if row.motion_3d is not None]
    return {
        **{name: known_mean([getattr(row.scores, name) for row in later]) for name in _MEANS},
        "num_bytes": known_mean([row.num_bytes for row in later]),
        **{f"motion_3d_{name}": known_mean([getattr(scores, name) for scores in motion]) for name in _MOTION_3D},
        "mtv": found.variation.render,
        "mtv_input": found.variation.input,
        "psnr_slope": found.psnr_slope,
        "seconds": float(np.median([report.seconds for report in reports])),
        "by_frame": {name: [getattr(row.scores, name) for row in later] for name in _BY_FRAME},
    }


def _read(path: Path) -> Scores:
    try:
        return json.loads(path.read_text(encoding="utf-8"))["scores"]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected a cell's scores, got another content ({error!r}); remove it.") from None


def _digest(*parts: Any) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:12]
