"""What no scene needs: every branch of the method on trial.

    python -m benchmarks.reports.needed --recordings SETS --json out.json

`benchmarks.reports.branches` lists the branches and switches them off from outside, and
`benchmarks.reports.trial_rule` has the rule: groups first, then single branches, on cheap sets
first. A fit without branches that act on later frames alone continues the first frame of the
default with the same seed.

The JSON is written after every fit. Fits in it are not made again, so the run can be ended at any
time; it takes days for all sets. Random scenes are made where they are missing; recordings that are
not there are left out.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import date
from functools import cache
from itertools import chain, islice
from pathlib import Path
from typing import Any
from zlib import crc32

import mitsuba as mi
import numpy as np
import tyro

import morgs_mi
from benchmarks.reports.branches import BRANCHES, Branch, groups, switched
from benchmarks.reports.fits import synthetic
from benchmarks.reports.plots import markdown, plus_minus
from benchmarks.reports.study import rounded
from benchmarks.reports.trial_rule import (
    MEASURES,
    SEEDS,
    Trial,
    next_fit,
    numbers,
    trials_of,
    verdict,
)
from benchmarks.speed.output import Output, commit
from morgs_mi import StreamLoop, rasterize
from morgs_mi.capture.capture import Capture, PartialFrame, load_capture
from morgs_mi.evaluate.metrics import endpoint_error, psnr, recorded_change
from morgs_mi.evaluate.results import known_mean
from morgs_mi.extras.synth.synth_config import SynthConfig
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.platform.bounded import read_json
from morgs_mi.platform.checks import quantity
from morgs_mi.platform.config import apply_values
from morgs_mi.platform.environment import machine, versions
from morgs_mi.platform.files import write_json
from morgs_mi.platform.progress import Progress
from morgs_mi.playback.stream_header import truth_for_camera
from morgs_mi.playback.visualise import to_uint8
from morgs_mi.runs.fit_capture import push_frame, with_border, with_points

RESULTS = Path(__file__).parents[1] / "results"
PACKAGE = Path(morgs_mi.__file__).parent
# Modules whose content makes fits comparable.
CODE = ("method", "fit", "loop", "stream_loop.py", "gaussian_integrator.py")
# Small fits, for sets that are cheap.
_SMALL = {"num_gaussians": 3000, "first_frame_steps": 400, "epochs": 3}
# Masks in the last of four frames, as in every fifth one of a recording.
_MASKS = {"mask_interval": 3}
_CLIP = SynthConfig(cameras=9, frames=4, width=160, height=120)


@dataclass(frozen=True)
class Recording:
    """A set of the trial."""

    frames: int  #: Number of frames that are fitted.
    downscale: float = 1
    hold_out: Any = "auto"
    settings: Mapping[str, Any] = field(default_factory=dict)  #: Of `StreamConfig`.
    seed: int | None = None  #: Of a random scene; None: a recording.

    @property
    def groups(self) -> list[list[str]]:
        """The names of the branches that act on it, group by group; those last that act on the
        first frame, whose fits take longest.
        """
        members = [[b for b in BRANCHES if b.group == group and b.switches] for group in groups()]
        members.sort(key=lambda group: any(branch.in_first for branch in group))
        return [[branch.name for branch in group if acts_on(branch, self)] for group in members]


def acts_on(branch: Branch, recording: Recording) -> bool:
    """Return whether a branch acts on a set: most act on later frames alone."""
    return branch.in_first or recording.frames > 1


_CHEAP = {"fit": _SMALL, "motion": _MASKS}
_RECORDED = {"fit": {"epochs": 2}, "motion": _MASKS}
# First frames of recordings in less than two minutes.
_STILL = {"fit": {"num_gaussians": 20_000, "first_frame_steps": 800}}
RECORDINGS = {
    "demo": Recording(4, 2, settings=_CHEAP),
    "random-41": Recording(4, settings=_CHEAP, seed=41),
    "random-42": Recording(4, settings=_CHEAP, seed=42),
    "random-28": Recording(4, settings=_CHEAP, seed=28),
    "random-7": Recording(4, settings=_CHEAP, seed=7),
    "demo-12": Recording(12, 2, settings={"fit": _SMALL}),
    "basketball": Recording(4, hold_out=(0, 10, 15, 30), settings=_RECORDED),
    "walk4": Recording(3, 4, (1,), {"motion": {"mask_interval": 2}}),
    "flame_steak": Recording(1, 2, settings=_STILL),
    "meet_room": Recording(1, 2, ("cam_0",), _STILL),
    "fern": Recording(1, 2, (0, 8, 16), _STILL),
}
"""Sets by name, the cheap ones first."""


@dataclass(frozen=True)
class Options(Output):
    """Try what the method is without each of its branches."""

    json: Path | None = RESULTS / "what_is_needed.json"
    """JSON file of the fits, which continues."""
    recordings: Path = Path("sets")
    """Folder of the recordings, which have the names of the sets."""
    clips: Path = Path("out/needed")
    """Folder of the random scenes, which are made where they are missing."""
    sets: tuple[str, ...] = tuple(RECORDINGS)
    """Names of the sets."""
    most: int | None = None
    """Largest number of fits that are made; None: all."""
    any_commit: bool = False
    """Whether fits of the JSON count that other code of the method made."""

    def run(self) -> None:
        """Make the fits, and print the table."""
        mi.set_variant("llvm_ad_rgb")
        captures = {}
        for name in self.sets:
            recording = RECORDINGS[name]
            with suppress(FileNotFoundError):
                captures[name] = capture_of(name, recording, self.recordings, self.clips)
        missing = ", ".join(name for name in self.sets if name not in captures)
        print(f"sets: {', '.join(captures)}; not there: {missing or 'none'}", flush=True)
        opened = cache(lambda name: Opened(RECORDINGS[name], captures[name]))
        rows = run_trial(
            self.json,
            {name: RECORDINGS[name].groups for name in captures},
            lambda name, off, seed: measure(opened(name), off, seed),
            self.most,
            self.any_commit,
        )
        print(branches_table(rows))


def capture_of(name: str, recording: Recording, recordings: Path, clips: Path) -> Capture:
    """Return the capture of a set.

    Raises:
        FileNotFoundError: the recording is not there.
    """
    if recording.seed is not None:
        return synthetic("random", clips / name, replace(_CLIP, seed=recording.seed))
    return load_capture(recordings / name, recording.downscale, recording.hold_out)


def code_hash(package: Path = PACKAGE) -> str:
    """Return a hash of the modules of the method: fits of equal ones are comparable."""
    paths = chain.from_iterable(
        sorted(place.rglob("*.py")) if place.is_dir() else [place]
        for place in (package / name for name in CODE)
    )
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()[:12]


Fit = Callable[[str, Sequence[str], int], Mapping[str, Any]]


def run_trial(
    path: Path | None,
    place_groups: Mapping[str, Sequence[Sequence[str]]],
    fit: Fit,
    most: int | None = None,
    any_commit: bool = False,
) -> list[Mapping[str, Any]]:
    """Make the fits that are missing, and return all rows that count.

    Args:
        path: JSON file, written after every fit; None: none.
        place_groups: as for `next_fit`.
        fit: (set, branches that are off, seed) -> scores.
        most: largest number of fits that are made; None: all.
        any_commit: whether fits of other code count.
    """
    code = code_hash()
    rows = list(read_json(path)["fits"]) if path is not None and path.exists() else []
    others = [] if any_commit else [row for row in rows if row["code"] != code]
    rows = rows if any_commit else [row for row in rows if row["code"] == code]
    pending = iter(lambda: next_pair(rows, place_groups, code), None)
    for place, off, seed in islice(pending, most):
        scores = rounded(fit(place, off, seed))
        row = {"set": place, "off": list(off), "seed": seed, "code": code, **scores}
        rows.append(row)
        print(f"{place}, seed {seed}, without {', '.join(off) or 'nothing'}: {scores}", flush=True)
        if path is not None:
            document = {"fits": [*others, *rows], "code": None if any_commit else code}
            document["commit"] = commit()
            document |= {"date": date.today().isoformat(), "machine": machine()}
            write_json(path, document | {"versions": versions()})
    return rows


def next_pair(
    rows: Sequence[Mapping[str, Any]],
    place_groups: Mapping[str, Sequence[Sequence[str]]],
    code: str,
) -> tuple[str, tuple[str, ...], int] | None:
    """Return the fit to make next: of `next_fit`, or of the default by the same code before it."""
    fit = next_fit(rows, place_groups)
    if fit is None:
        return None
    place = fit[0]
    made = [
        row["seed"] for row in rows if (row["set"], row["code"], row["off"]) == (place, code, [])
    ]
    missing = [seed for seed in SEEDS if seed not in made]
    return (place, (), missing[0]) if missing else fit


def rows_of(document: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the rows that count of a JSON of `run_trial`: of the code that made the last ones."""
    return [row for row in document["fits"] if document["code"] in (None, row["code"])]


class Opened:
    """A set with its images in memory, and the first frames of its default."""

    def __init__(self, recording: Recording, capture: Capture) -> None:
        self.frames = [*capture.partial_frames(0, recording.frames)]
        config = apply_values(StreamConfig(), recording.settings)
        self.config = with_border(capture, self.frames[0], config)
        self.capture = with_points(capture, 0, Progress())
        self._first_frames: dict[int, tuple[StreamLoop, dict[str, Any]]] = {}

    def first_frame(self, seed: int) -> tuple[StreamLoop, dict[str, Any]]:
        """Return a loop after the default's first frame, and the scores of that frame."""
        if seed not in self._first_frames:
            loop = StreamLoop.of(self.capture, replace(self.config, seed=seed))
            self._first_frames[seed] = loop, self.pushed(loop, self.frames[0])
        return self._first_frames[seed]

    def pushed(
        self, loop: StreamLoop, frame: PartialFrame, last: PartialFrame | None = None
    ) -> dict[str, Any]:
        """Fit the next frame of a loop, and return its scores; `last` is the frame before."""
        wall = time.perf_counter()
        cpu = time.process_time()
        packet, report = push_frame(loop, frame)
        scores = {
            "seconds": time.perf_counter() - wall,
            "cpu_s": time.process_time() - cpu,
            "bytes": packet.num_bytes,
            "crc": crc32(packet.encoded),
            "steps": report.steps,
            "pixels": report.active.get("pixels", 1.0),
        }
        return scores | scores_of(loop, self.capture, frame, last)


def measure(opened: Opened, off: Sequence[str], seed: int) -> dict[str, Any]:
    """Fit a set without some branches, and return the scores of its held-out views.

    Args:
        opened: the set.
        off: names of the branches.
        seed: of the fit.
    """
    branches = [branch for branch in BRANCHES if branch.name in off]
    capture = opened.capture
    first, *later_frames = opened.frames
    start, first_scores = opened.first_frame(seed)
    config = replace(opened.config, seed=seed)
    with switched(branches, config, capture.cameras[0].width) as switched_config:
        loop = StreamLoop.of(capture, switched_config)
        if any(branch.in_first for branch in branches):
            first_scores = opened.pushed(loop, first)
        else:
            assert start.state.coded is not None
            loop.resume(start.state.coded, [first.comparable], start.state.exposures)
        pairs = zip(later_frames, opened.frames, strict=False)
        rows = [opened.pushed(loop, frame, last) for frame, last in pairs]
    return summary([first_scores, *rows])


def scores_of(
    loop: StreamLoop, capture: Capture, frame: PartialFrame, last: PartialFrame | None
) -> dict[str, float]:
    """Return the mean scores of the held-out views of a frame; `last` is the frame before."""
    assert loop.gaussians is not None
    render = loop.setup.config.render  # with the background that the fit has found
    views = []
    for v in capture.test_views:
        view = frame.views[v]
        if not view.has_image:
            continue
        camera = view.camera
        image = view.image
        maps = rasterize(loop.gaussians, camera, ("color", "motion"), config=render)
        rendered = to_uint8(np.asarray(maps.color))
        scores = {"psnr": psnr(rendered, image, view.mask)}
        last_image = None if last is None else last.images[v]
        truth = truth_for_camera(capture, camera, frame.index)
        if last_image is not None:
            moving = recorded_change(last_image, image) if truth is None else truth.mask
            scores["psnr_moving"] = psnr(rendered, image, moving)
            if truth is not None:
                motion = np.asarray(maps["motion"])
                scores["motion_error"] = endpoint_error(motion, truth.motion, moving)
        views.append(scores)
    names = ("psnr", "psnr_moving", "motion_error")
    return {name: known_mean([scores.get(name, np.nan) for scores in views]) for name in names}


def summary(frames: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Return the scores of a fit, given the scores of its frames in order.

    Seconds are the least of the later frames, because the first fit of a kind compiles its kernels.
    """
    first, *later_frames = frames
    means = {
        name: known_mean([frame[name] for frame in later_frames])
        for name in ("psnr", "psnr_moving", "motion_error", "bytes", "steps", "pixels")
    }
    clocks = {
        name: min([frame[name] for frame in later_frames or frames])
        for name in ("seconds", "cpu_s")
    }
    return {
        "psnr_first": first["psnr"],
        "psnr_later": means.pop("psnr"),
        "psnr": known_mean([frame["psnr"] for frame in frames]),
        **means,
        "bytes": means["bytes"] if later_frames else first["bytes"],
        **clocks,
        "first_s": first["seconds"],
        "first_cpu_s": first["cpu_s"],
        "stream": [frame["crc"] for frame in frames],
        "load": os.getloadavg()[0],
    }


def branches_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the branches of each group by their verdicts, with the losses that keep them."""
    trials = trials_of(rows)
    cells: dict[tuple[str, str], list[str]] = {}
    for branch in BRANCHES:
        places = [name for name, recording in RECORDINGS.items() if acts_on(branch, recording)]
        word, place, trial = verdict(trials, branch.name, places)
        word = word.partition(" on ")[0] if branch.switches else "gone"
        loss = "" if word in ("not needed", "gone") else reason(place, trial).partition(",")[0]
        name = f"{branch.name} ({loss})" if loss else branch.name
        cells.setdefault((branch.group, word), []).append(name)
    lines = [(group, word, "; ".join(names)) for (group, word), names in cells.items()]
    return markdown(("group", "verdict", "branches (largest loss without one)"), lines, left=3)


def reason(place: str, trial: Trial | None) -> str:
    """Return the loss that decides as a cell of a table."""
    if trial is None or trial.state == "no effect":
        return ""
    loss = trial.loss
    change = f"{loss.change:+.2f} {loss.measure.title}"
    if loss.measure.is_relative:
        change = f"{100 * loss.change:+.1f} % {loss.measure.title}"
    others = f" with {quantity(trial.count - 1, 'other')}" if trial.count > 1 else ""
    return f"{place}{others}: {change}, {quantity(trial.seeds, 'seed')}"


def sets_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the number of fits of each set, and the scores of its default over the seeds, by the
    last code that fitted it.
    """
    lines = []
    for name, recording in RECORDINGS.items():
        fits = [row for row in rows if row["set"] == name]
        defaults = [row for row in fits if not row["off"] and row["code"] == fits[-1]["code"]]
        tried = {branch for row in fits if len(row["off"]) == 1 for branch in row["off"]}
        cells = []
        for measure in MEASURES:
            scores = numbers(defaults, measure.name)
            factor = 1e-3 if measure.name == "bytes" else 1
            digits = 3 if measure.name == "motion_error" else 2
            is_known = len(scores) > 0 and np.isfinite(scores).all()
            cells.append(
                plus_minus([factor * score for score in scores], digits) if is_known else "-"
            )
        counts = f"{recording.frames}", f"{len(fits)}", f"{len(tried)}"
        lines.append((name, *counts, *cells))
    titles = "set", "frames", "fits", "branches alone", "first, dB", "later, dB"
    return markdown((*titles, "moving, dB", "motion error, px", "kB"), lines)


if __name__ == "__main__":
    tyro.cli(Options).run()
