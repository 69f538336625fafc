"""Tracks of a stream's Gaussians: the position of each one in each frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from morgs_mi.codec.frame_source import FrameSource
from morgs_mi.core.files import atomic_path
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.playback.export.formats import TRACKS, choose_format


@dataclass(frozen=True)
class Tracks:
    """Tracks of N Gaussians through T frames.

    Attributes:
        ids: uint32 [N], the Gaussians' ids in the stream, ascending.
        frames: int64 [T], indices of the frames.
        positions: float32 [T, N, 3], centres in world units; NaN before birth and after death.
        confidence: float32 [T, N] in [0, 1]; NaN before birth, after death, and throughout if the
            stream stores none.
    """

    ids: np.ndarray
    frames: np.ndarray
    positions: np.ndarray
    confidence: np.ndarray


def extract_tracks(stream: FrameSource, progress: Callable[[int], None] | None = None) -> Tracks:
    """Return the tracks of all Gaussians of a stream; they take 16 bytes of memory per Gaussian and
    frame.

    Where a keyframe starts a new set of Gaussians with ids from 0, these ids continue after the
    earlier ones.

    Args:
        stream: the file.
        progress: called with the number of frames done.

    Raises:
        ValueError: a broken packet, or a stream without a frame.
    """
    frames = []
    ids_of_frames = []
    means = []
    confidence = []
    for state in stream.states():
        frames.append(state.frame)
        ids_of_frames.append(state.lasting_ids)
        means.append(state.gaussians.numpy()["means"])
        confidence.append(_confidence(state.gaussians))
        if progress is not None:
            progress(len(frames))
    if not frames:
        raise ValueError(
            f"{stream.path}: at least one frame was expected, got none; the stream has only a "
            "header."
        )
    ids = np.unique(np.concatenate(ids_of_frames))
    return Tracks(
        ids.astype(np.uint32),
        np.asarray(frames),
        _by_id(ids, ids_of_frames, means),
        _by_id(ids, ids_of_frames, confidence),
    )


def _confidence(gaussians: Gaussians) -> np.ndarray:
    """Return the confidence of each Gaussian [N], NaN if there is none."""
    if gaussians.confidence is None:
        return np.full(len(gaussians), np.nan, np.float32)
    return np.asarray(gaussians.confidence)


def _by_id(
    ids: np.ndarray, ids_of_frames: Sequence[np.ndarray], values: Sequence[np.ndarray]
) -> np.ndarray:
    """Return the values of T frames for all N ids, float32 [T, N, ...]; NaN where a frame has no
    such Gaussian.
    """
    result = np.full((len(values), len(ids), *values[0].shape[1:]), np.nan, np.float32)
    for t, (present, rows) in enumerate(zip(ids_of_frames, values, strict=True)):
        result[t, np.searchsorted(ids, present)] = rows
    return result


def write_tracks(path: str | Path, tracks: Tracks) -> None:
    """Write tracks as .npz with the arrays `ids`, `frames`, `positions`, `confidence`; the file is
    written atomically.

    Raises:
        ValueError: `path` does not end in .npz.
        OSError: the file cannot be written.
    """
    choose_format(TRACKS, path)
    with atomic_path(path, "write_tracks()") as partial, open(partial, "wb") as file:
        np.savez_compressed(
            file,
            ids=tracks.ids,
            frames=tracks.frames,
            positions=tracks.positions,
            confidence=tracks.confidence,
        )
