"""Alignment of a capture's clips in time, and the settings that control how they are read.

An instant t = 0, 1, ... is a frame of the recording. It is shown by frame k of a clip if

    k = o + r t,    with o the clip's offset and r its frame rate divided by the lowest frame rate.
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
# 29.97 and 30 fps count as the same rate: programs write either for the same camera.
_SAME_RATE = 1.01


@dataclass(frozen=True)
class ReadConfig:
    """Handling of clips that do not match; by default they are refused."""

    trim: bool = False
    """Whether to use only the instants that all clips cover, at the lowest of their frame rates."""
    offset: dict[str, int] = field(default_factory=dict)
    """Frame of each listed camera's clip that is simultaneous with frame 0 of the others; negative for a clip that
    started later. Instants that not all clips cover are left out, as with trim."""
    gaps: bool = False
    """Whether images may be missing; a camera is left out of the frames that it lacks."""
    color: Literal["none", "linear", "root-polynomial", "vandermonde"] = "none"
    """Method that matches each camera's colours to those of a reference camera, fitted to points that both see."""
    color_reference: str = ""
    """Name of the reference camera; by default the one that shares most points with the others."""
    exposure: bool = False
    """Whether to remove exposure changes over time: one gain per view and frame restores the brightness that static
    surfaces have in the first frame."""

    @property
    def aligns_clips(self) -> bool:
        """Whether clips of different lengths and frame rates are aligned."""
        return self.trim or bool(self.offset)


@dataclass(frozen=True)
class Timeline:
    """Frames of each clip that show the instants of the recording.

    Attributes:
        frame_indices: per camera the clip's frames in increasing order, int [T].
        fps: instants per second.
        unchanged: whether instant t is frame t of every clip.
    """

    frame_indices: tuple[np.ndarray, ...]
    fps: float
    unchanged: bool


def timeline(
    path: Path,
    names: Sequence[str],
    readers: Sequence[FrameReader],
    config: ReadConfig,
    max_frames: int | None,
    fps: float | None,
) -> Timeline:
    """Return the common timeline of the clips of the capture `path`.

    Args:
        path: the capture folder, for messages.
        names: names of the cameras.
        readers: one clip per camera.
        config: how clips that do not match are read.
        max_frames: number of instants at most.
        fps: true frame rate of all clips, or None for the rates in their headers.

    Raises:
        ValueError: lengths or rates differ and `config` does not resolve it, a clip is cut off, the clips have no
            instant in common, or `config` names an unknown camera.
    """
    if unknown := [name for name in config.offset if name not in names]:
        raise ValueError(f"{path}: `offset` must name cameras of {', '.join(names)}, got {', '.join(unknown)}.")
    if not config.aligns_clips:
        count, rate = _num_frames(path, readers, max_frames, config.gaps), _fps(path, readers, fps)
        return Timeline((np.arange(count),) * len(readers), rate, True)
    clip_fps = [fps or reader.fps for reader in readers]
    lowest = min((rate for rate in clip_fps if rate), default=_DEFAULT_FPS)
    rates = np.array([1.0 if not rate or rate < _SAME_RATE * lowest else rate / lowest for rate in clip_fps])
    offsets = np.array([config.offset.get(name, 0) for name in names], float)
    lengths = np.array([reader.num_frames if config.gaps else _usable_frames(reader, config) for reader in readers])
    first, last = np.ceil(np.max(-offsets / rates)), np.floor(np.min((lengths - 1 - offsets) / rates))
    instants = np.arange(first, last + 1)[:max_frames]
    if not len(instants):
        spans = zip(names, (0 - offsets) / rates / lowest, (lengths - offsets) / rates / lowest, strict=True)
        table = ", ".join(f"{name} {start:.2f} to {stop:.2f} s" for name, start, stop in spans)
        raise ValueError(f"{path}: the clips have no instant in common, {table}; check `offset`.")
    exact = offsets[:, None] + rates[:, None] * instants
    indices = np.rint(exact).astype(int)
    apart = float(np.max(np.abs(indices - exact) / (rates[:, None] * lowest)))
    if apart > 1e-3:
        _LOG.warning("%s: the frame rates differ; images of one instant are up to %.1f ms apart.", path, 1e3 * apart)
    return Timeline(tuple(indices), lowest, bool((offsets + rates * first == 0).all() and (rates == 1).all()))


def _usable_frames(reader: FrameReader, config: ReadConfig) -> int:
    """Return the number of frames that can be read; a truncated clip can be trimmed but not shifted."""
    return reader.num_held if config.trim else _check_complete(reader, reader.num_frames)


def _check_complete(reader: FrameReader, required: int) -> int:
    """Return the clip's number of frames after checking that the first `required` ones can be read."""
    if required > reader.num_held:
        raise ValueError(
            f"{reader.path}: frame {reader.num_held} of {reader.num_frames} cannot be read: the file is truncated or "
            f"broken; copy it again, use the first {reader.num_held} frames (`max_frames`), or leave its camera out of "
            "the later ones (--gaps)."
        )
    return reader.num_frames


def _num_frames(path: Path, readers: Sequence[FrameReader], max_frames: int | None, gaps: bool) -> int:
    lengths = [reader.num_frames for reader in readers]
    if gaps:
        return min(max(lengths), max_frames or max(lengths))
    for reader in readers:
        _check_complete(reader, min(reader.num_frames, max_frames or reader.num_frames))
    shortest = min(lengths)
    if max_frames is not None and max_frames <= shortest:
        return max_frames
    if shortest < max(lengths):
        table = ", ".join(f"{r.path.name} {n}" for r, n in zip(readers, lengths, strict=True))
        raise ValueError(
            f"{path}: all cameras must have the same number of frames, got {table}; use the first frames with "
            f"`max_frames={shortest}`, the instants that all clips cover with --trim, or align the clips with "
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
            f"{path}: all cameras must have the same frame rate, got {table}; use the lowest with --trim, or set the "
            "true one as `fps` in capture.json."
        )
    return rates[0] if rates else _DEFAULT_FPS


def read_settings(path: Path) -> dict[str, Any]:
    """Return the settings ``fps`` and ``test_view`` in a capture's `capture.json`, or {} without such a file.

    Raises:
        ValueError: the file is not a JSON object, or `fps` or `test_view` is not valid.
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
