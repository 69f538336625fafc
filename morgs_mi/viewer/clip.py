"""A stream's frames in any order, for somebody who plays, jumps and waits for more."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from morgs_mi.codec.container import PacketKind, TruncatedStreamError
from morgs_mi.codec.packets import CodedFrame, coded_frames
from morgs_mi.playback.player import open_stream

__all__ = ["Clip", "Trails"]

# Frames of which the centres are kept: 3 MB each for 200,000 Gaussians.
_KEPT = 64

# Trails of Gaussians as line segments: places [S, 2, 3] and how old each is, [S], 0 now to 1.
Trails = tuple[np.ndarray, np.ndarray]


class Clip:
    """Frames of a stream file, which may still be written.

    One frame is decoded at a time: the next from the one before, any other from the keyframe before it.

    Args:
        path: the file, or the folder of a fit.

    Raises:
        FileNotFoundError, ValueError: as `open_stream`.
    """

    def __init__(self, path: str | Path) -> None:
        self.stream = open_stream(path)
        self._places: OrderedDict[int, tuple[np.ndarray, np.ndarray]] = OrderedDict()
        self._coded: CodedFrame | None = None
        self._ahead: Iterator[CodedFrame] = iter(())
        self._entries: list[tuple[int, int, int]] = []
        self._size = 0
        self.frames: list[int] = []
        self.refresh()

    def refresh(self) -> bool:
        """Look whether the file has grown; return whether it has. A file that was begun anew is read anew.

        Raises:
            OSError, ValueError: it is gone, or has no header yet.
        """
        size = self.stream.path.stat().st_size
        if size < self._size:
            self._begin_anew()
        entries = self.stream.index()
        if entries[: len(self._entries)] != self._entries:
            self._begin_anew()
            entries = self.stream.index()
        grown, self._size = entries != self._entries, size
        self._entries = entries
        self.frames = list(dict.fromkeys(frame for _, frame, _ in entries))
        return grown

    def at(self, frame: int) -> CodedFrame:
        """Return a frame.

        Raises:
            ValueError: there is no such frame, or a packet on the way to it is broken.
        """
        if self._coded is not None and self._coded.frame == frame:
            return self._coded
        if self._coded is None or not self._keyframe_before(frame) <= self._coded.frame < frame:
            self._coded, self._ahead = None, iter(())
        self._advance(frame)
        if self._coded is None or self._coded.frame != frame:
            # An iterator that met the end of the file earlier does not look again.
            self._ahead = coded_frames(self.stream.near(frame))
            self._advance(frame)
        if self._coded is None or self._coded.frame != frame:
            raise ValueError(f"{self.stream.path}: expected a frame of the stream, got {frame}.")
        return self._coded

    def trails(self, frame: int, length: int, count: int = 2000) -> Trails:
        """Return where the `count` farthest movers of a frame came from, over at most `length` frames."""
        until = self.frames.index(frame)
        spans = self.frames[max(until - length, 0) : until + 1]
        steps = [self._places_at(one) for one in spans]
        ids, now = steps[-1]
        path = np.zeros(len(ids))
        segments, ages, owners = [], [], []
        after_ids, after = ids, now
        for age, (before_ids, before) in enumerate(steps[-2::-1]):
            both, a, b = np.intersect1d(after_ids, before_ids, assume_unique=True, return_indices=True)
            alive = np.isin(both, ids, assume_unique=True)
            owner, a, b = np.searchsorted(ids, both[alive]), a[alive], b[alive]
            segments.append(np.stack([before[b], after[a]], axis=1))
            ages.append(np.full(len(owner), age / max(length, 1)))
            owners.append(owner)
            np.add.at(path, owner, np.linalg.norm(after[a] - before[b], axis=1))
            after_ids, after = before_ids, before
        if not segments or not path.any():
            return np.zeros((0, 2, 3), np.float32), np.zeros(0)
        chosen = np.zeros(len(ids), bool)
        chosen[np.argsort(path)[-count:]] = True
        shown = (chosen & (path > 0))[np.concatenate(owners)]
        lines, ages = np.concatenate(segments)[shown], np.concatenate(ages)[shown]
        moved = (lines[:, 0] != lines[:, 1]).any(axis=1)
        return lines[moved], ages[moved]

    def _begin_anew(self) -> None:
        self.stream = open_stream(self.stream.path)
        self._coded, self._ahead, self._entries = None, iter(()), []
        self._places.clear()

    def _keyframe_before(self, frame: int) -> int:
        """Return the last keyframe that a frame can be entered from."""
        known = [at for kind, at, _ in self._entries if kind == PacketKind.KEYFRAME and at < frame]
        return known[-1] if known else self.frames[0]

    def _advance(self, frame: int) -> None:
        with suppress(TruncatedStreamError):  # a packet that is still written
            for coded in self._ahead:
                self._coded = coded
                self._places[coded.frame] = (coded.ids, coded.gaussians.numpy()["means"])
                self._places.move_to_end(coded.frame)
                while len(self._places) > _KEPT:
                    self._places.popitem(last=False)
                if coded.frame >= frame:
                    return

    def _places_at(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        if frame not in self._places:
            current = self._coded
            self.at(frame)
            found = self._places[frame]
            if current is not None:  # what is shown now must not be decoded again
                self.at(current.frame)
            return found
        return self._places[frame]
