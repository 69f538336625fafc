"""Where each Gaussian of a stream was in each frame: tracks for NumPy."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from morgs_mi.codec.container import PacketKind
from morgs_mi.codec.packets import CodedFrame, decode
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.files import atomic_path

__all__ = ["Tracks", "follow", "write_tracks"]


@dataclass(frozen=True)
class Tracks:
    """Tracks of N Gaussians through T frames.

    Attributes:
        ids: uint32 [N], ascending: the stream's numbers of the Gaussians.
        frames: int64 [T], the frames' indices.
        positions: float32 [T, N, 3], centres in world units; NaN before birth and after death.
        confidence: float32 [T, N] in [0, 1], NaN likewise, and everywhere where the stream carries none.
    """

    ids: np.ndarray
    frames: np.ndarray
    positions: np.ndarray
    confidence: np.ndarray


def follow(stream: StreamReader, progress: Callable[[int], None] | None = None) -> Tracks:
    """Follow all Gaussians through a stream; 16 bytes of memory per Gaussian and frame.

    Where a keyframe starts a new set of Gaussians, which number from zero, their ids count on behind the earlier ones.

    Args:
        stream: the file.
        progress: called with the number of frames done.

    Raises:
        ValueError: a broken packet, or a stream without a frame.
    """
    numbers, rows, frames = [], [], []
    for first_id, coded in _numbered(stream):
        gaussians = coded.gaussians
        known = gaussians.confidence is not None
        confidence = np.asarray(gaussians.confidence) if known else np.full(len(coded), np.nan, np.float32)
        frames.append(coded.frame)
        numbers.append(coded.ids.astype(np.int64) + first_id)
        rows.append((gaussians.numpy()["means"], confidence))
        if progress is not None:
            progress(len(frames))
    if not frames:
        raise ValueError(f"{stream.path}: at least one frame was expected, got none; the stream has a header alone.")
    ids = np.unique(np.concatenate(numbers))
    positions = np.full((len(frames), len(ids), 3), np.nan, np.float32)
    confidences = np.full((len(frames), len(ids)), np.nan, np.float32)
    for t, (number, (means, confidence)) in enumerate(zip(numbers, rows, strict=True)):
        at = np.searchsorted(ids, number)
        positions[t, at], confidences[t, at] = means, confidence
    return Tracks(ids.astype(np.uint32), np.asarray(frames), positions, confidences)


def write_tracks(path: str | Path, tracks: Tracks) -> None:
    """Write tracks as .npz with the arrays `ids`, `frames`, `positions`, `confidence`; whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    with atomic_path(path, "write_tracks()") as partial, open(partial, "wb") as file:
        np.savez_compressed(
            file, ids=tracks.ids, frames=tracks.frames, positions=tracks.positions, confidence=tracks.confidence
        )


def _numbered(stream: StreamReader) -> Iterator[tuple[int, CodedFrame]]:
    """Yield every frame with what its ids are to be counted from."""
    first_id, coded = 0, None
    for packet in stream:
        if coded is not None and packet.frame == coded.frame:
            continue  # restates the frame for those who start there
        if coded is not None and packet.kind == PacketKind.KEYFRAME:
            first_id += coded.next_id
        coded = decode(coded, packet)
        yield first_id, coded
