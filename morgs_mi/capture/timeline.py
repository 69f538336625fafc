"""How the clips of a capture are put together: on one clock, of one colour, with or without gaps.

An instant t = 0, 1, ... is a frame of the recording; a clip's frame k shows it if

    k = o + r t,    with o the clip's offset and r its frame rate over the lowest.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from morgs_mi.io.video import FrameReader

__all__ = ["ReadConfig", "Timeline", "read_settings", "timeline"]

_LOG = logging.getLogger(__name__)
_DEFAULT_FPS = 30.0
# 29.97 and 30 are one camera written by two programs.
_SAME_RATE = 1.01


@dataclass(frozen=True)
class ReadConfig:
    """What to do with clips that do not fit each other; by default they are refused."""

    trim: bool = False
    """Take the instants that all clips hold, at the lowest of their frame rates."""
    offset: dict[str, int] = field(default_factory=dict)
    """By camera: which frame of its clip shows the instant that frame 0 of the others shows. Negative for a clip that
    began later. What not all clips hold is left out, as with trim."""
    gaps: bool = False
    """Go on where pictures are missing: a camera is left out of the frames that it lacks."""
    color: Literal["none", "linear", "root-polynomial", "vandermonde"] = "none"
    """Correct each camera's colours towards a reference camera's on the points that they have in common."""
    color_reference: str = ""
    """That camera's name; by default the one that has most in common with the others."""
    exposure: bool = False
    """Undo changes of a camera's exposure over time: one gain per view and frame brings what stands still back to its
    brightness in the first frame."""

    @property
    def one_clock(self) -> bool:
        """Whether it is told how clips of other lengths and rates fit together."""
        return self.trim or bool(self.offset)


@dataclass(frozen=True)
class Timeline:
    """Which frame of each clip shows which instant.

    Attributes:
        picks: per camera the clip's frames, int [T], rising.
        fps: instants per second.
        plain: whether every clip is shown from its first frame on, one after the other.
    """

    picks: tuple[np.ndarray, ...]
    fps: float
    plain: bool


def timeline(
    path: Path,
    names: Sequence[str],
    readers: Sequence[FrameReader],
    config: ReadConfig,
    max_frames: int | None,
    fps: float | None,
) -> Timeline:
    """Put the clips of the capture `path` on one clock.

    Args:
        path: for messages.
        names: the cameras'.
        readers: their clips.
        config: what to do where these differ.
        max_frames: at most this many instants.
        fps: true frame rate of all clips; None: what they say.

    Raises:
        ValueError: lengths or rates differ and nothing is said about it, a clip is cut off, the clips have no instant
            in common, or `config` names an unknown camera.
    """
    if unknown := [name for name in config.offset if name not in names]:
        raise ValueError(f"{path}: `offset` must name cameras of {', '.join(names)}, got {', '.join(unknown)}.")
    if not config.one_clock:
        count, rate = _num_frames(path, readers, max_frames, config.gaps), _fps(path, readers, fps)
        return Timeline((np.arange(count),) * len(readers), rate, True)
    own = [fps or reader.fps for reader in readers]
    lowest = min((rate for rate in own if rate), default=_DEFAULT_FPS)
    rates = np.array([1.0 if not rate or rate < _SAME_RATE * lowest else rate / lowest for rate in own])
    offsets = np.array([config.offset.get(name, 0) for name in names], float)
    lengths = np.array([reader.num_frames if config.gaps else _held(reader, config) for reader in readers])
    first, last = np.ceil(np.max(-offsets / rates)), np.floor(np.min((lengths - 1 - offsets) / rates))
    instants = np.arange(first, last + 1)[:max_frames]
    if not len(instants):
        spans = zip(names, (0 - offsets) / rates / lowest, (lengths - offsets) / rates / lowest, strict=True)
        table = ", ".join(f"{name} {start:.2f} to {stop:.2f} s" for name, start, stop in spans)
        raise ValueError(f"{path}: the clips have no instant in common, {table}; check `offset`.")
    exact = offsets[:, None] + rates[:, None] * instants
    picks = np.rint(exact).astype(int)
    apart = float(np.max(np.abs(picks - exact) / (rates[:, None] * lowest)))
    if apart > 1e-3:
        _LOG.warning("%s: of clips with other frame rates pictures up to %.1f ms apart are taken.", path, 1e3 * apart)
    return Timeline(tuple(picks), lowest, bool((offsets + rates * first == 0).all() and (rates == 1).all()))


def _held(reader: FrameReader, config: ReadConfig) -> int:
    """Return how many frames a clip holds; what was cut off can be trimmed away, not shifted into."""
    return reader.num_held if config.trim else _whole(reader, reader.num_frames)


def _whole(reader: FrameReader, wanted: int) -> int:
    """Return the number of frames of a clip that holds those `wanted`."""
    if wanted > reader.num_held:
        raise ValueError(
            f"{reader.path}: frame {reader.num_held} of {reader.num_frames} cannot be read: the file is truncated or "
            f"broken; copy it again, use the first {reader.num_held} frames (max_frames), or go on without its camera "
            "from there (--gaps)."
        )
    return reader.num_frames


def _num_frames(path: Path, readers: Sequence[FrameReader], max_frames: int | None, gaps: bool) -> int:
    lengths = [reader.num_frames for reader in readers]
    if gaps:
        return min(max(lengths), max_frames or max(lengths))
    for reader in readers:
        _whole(reader, min(reader.num_frames, max_frames or reader.num_frames))
    shortest = min(lengths)
    if max_frames is not None and max_frames <= shortest:
        return max_frames
    if shortest < max(lengths):
        table = ", ".join(f"{r.path.name} {n}" for r, n in zip(readers, lengths, strict=True))
        raise ValueError(
            f"{path}: all cameras must have the same number of frames, got {table}; use the first frames with "
            f"max_frames={shortest} (--frames), what all have with --trim, or say which frames belong together with "
            "--offset."
        )
    return shortest


def _fps(path: Path, readers: Sequence[FrameReader], given: float | None) -> float:
    if given is not None:
        return given
    rates = [reader.fps for reader in readers if reader.fps]
    if rates and max(rates) > _SAME_RATE * min(rates):
        table = ", ".join(f"{r.path.name} {r.fps:g}" for r in readers if r.fps)
        raise ValueError(
            f"{path}: all cameras must have the same frame rate, got {table}; take the lowest with --trim, or give the "
            "true one as `fps` in capture.json."
        )
    return rates[0] if rates else _DEFAULT_FPS


def read_settings(path: Path) -> dict[str, Any]:
    """Read a capture's own `capture.json`, which may give ``fps`` and ``test_view``; empty where there is none.

    Raises:
        ValueError: it is no JSON object, or what it gives is no frame rate and no index.
    """
    if not path.exists():
        return {}
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: expected JSON, got a broken file ({error}); correct it.") from None
    if not isinstance(settings, dict):
        raise ValueError(f"{path}: expected a JSON object, got {type(settings).__name__}; correct it.")
    fps, view = settings.get("fps"), settings.get("test_view")
    if fps is not None and not (isinstance(fps, int | float) and fps > 0):
        raise ValueError(f"{path}: `fps` must be a positive number, got {fps!r}; correct it.")
    if view is not None and type(view) is not int:
        raise ValueError(f"{path}: `test_view` must be a camera's index or null, got {view!r}; correct it.")
    return settings
