"""Random access to the frames of a stream file, which may still grow."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from morgs_mi.codec.container import PacketKind, TruncatedStreamError
from morgs_mi.codec.packets import CodedFrame, frames_near
from morgs_mi.core.files import is_same_file
from morgs_mi.playback.player import PROVISIONAL
from morgs_mi.playback.streams import DRAWN, PlayableStream, open_stream, stream_path

__all__ = ["NO_TRAILS", "FrameCache", "Trails"]

# Number of frames with cached centres: 3 MB each for 200,000 Gaussians.
_CACHED_FRAMES = 64
# Frames that are decoded in search of motion.
_SEARCHED_FRAMES = 32

Trails = tuple[np.ndarray, np.ndarray]
"""Trails of Gaussians as line segments: end points [S, 2, 3] and ages [S], from 0 (the current frame) to 1."""
NO_TRAILS: Trails = (np.zeros((0, 2, 3), np.float32), np.zeros(0))


class FrameCache:
    """Frames of a stream file, which may still be written.

    While the stream has no frame, the provisional first frame beside it is shown, if there is one.

    One frame is decoded at a time: the next one from the current one, any other from the keyframe before it.

    Args:
        path: stream file, or the folder of a fit.
        most_invalid: as for `open_stream`.

    Attributes:
        stream: the file.
        frames: indices of the frames that the file has so far.

    Raises:
        FileNotFoundError, ValueError: as for `open_stream`.
    """

    def __init__(self, path: str | Path, most_invalid: float = DRAWN) -> None:
        self._path, self._most_invalid = stream_path(path), most_invalid
        self._centres: OrderedDict[int, tuple[np.ndarray, np.ndarray]] = OrderedDict()
        self._reopen()
        self.frames: list[int] = []
        self.refresh()

    @property
    def is_provisional(self) -> bool:
        """Whether the frame is a provisional one."""
        return self.stream.path != self._path

    def refresh(self) -> bool:
        """Read the index again; return whether it has changed. A file that was replaced is opened again.

        Raises:
            OSError, ValueError: the file is missing, or has no header yet.
        """
        if (self.is_provisional or not self._entries) and not is_same_file(self._newest(), self._opened):
            self._reopen()
        size = self.stream.path.stat().st_size
        if size < self._size:
            self._reopen()
        entries = self.stream.index()
        if entries[: len(self._entries)] != self._entries:
            self._reopen()
            entries = self.stream.index()
        changed, self._size = entries != self._entries, size
        self._entries = entries
        self.frames = list(dict.fromkeys(frame for _, frame, _ in entries))
        return changed

    def at(self, frame: int) -> CodedFrame:
        """Return a frame.

        Raises:
            ValueError: there is no such frame, or a packet that it depends on is broken.
        """
        if self._current is not None and self._current.frame == frame:
            return self._current
        if self._current is None or not self._keyframe_before(frame) <= self._current.frame < frame:
            self._current, self._upcoming = None, iter(())
        with suppress(ValueError):
            self._advance(frame)
        if self._current is None or self._current.frame != frame:
            # An iterator that has reached the end of the file does not read on after the file has grown.
            self._upcoming = frames_near(self.stream, frame)
            self._advance(frame)
        if self._current is None or self._current.frame != frame:
            raise ValueError(f"{self.stream.path}: expected a frame of the stream, got {frame}.")
        return self._current

    def first_moving(self, frame: int) -> int:
        """Return the first frame from `frame` on in which Gaussians move, out of the next 32; `frame` if none does."""
        start = self.frames.index(frame)
        for index in self.frames[start : start + _SEARCHED_FRAMES]:
            motion = self.at(index).gaussians.motion
            if motion is not None and np.asarray(motion).any():
                return index
        return frame

    def trails(self, frame: int, length: int, count: int = 2000) -> Trails:
        """Return the trails over at most `length` frames of the `count` Gaussians with the longest paths."""
        end = self.frames.index(frame)
        span = self.frames[max(end - length, 0) : end + 1]
        centres = [self._centres_at(index) for index in span]
        ids, now = centres[-1]
        path_lengths = np.zeros(len(ids))
        segments, ages, owners = [], [], []
        after_ids, after = ids, now
        for age, (before_ids, before) in enumerate(centres[-2::-1]):
            both, a, b = np.intersect1d(after_ids, before_ids, assume_unique=True, return_indices=True)
            alive = np.isin(both, ids, assume_unique=True)
            owner, a, b = np.searchsorted(ids, both[alive]), a[alive], b[alive]
            segments.append(np.stack([before[b], after[a]], axis=1))
            ages.append(np.full(len(owner), age / max(length, 1)))
            owners.append(owner)
            np.add.at(path_lengths, owner, np.linalg.norm(after[a] - before[b], axis=1))
            after_ids, after = before_ids, before
        if not segments or not path_lengths.any():
            return NO_TRAILS
        selected = np.zeros(len(ids), bool)
        selected[np.argsort(path_lengths)[-count:]] = True
        shown = (selected & (path_lengths > 0))[np.concatenate(owners)]
        lines, line_ages = np.concatenate(segments)[shown], np.concatenate(ages)[shown]
        moved = (lines[:, 0] != lines[:, 1]).any(axis=1)
        return lines[moved], line_ages[moved]

    def _newest(self) -> Path:
        """Return the path of the stream, or of its provisional first frame while it has none."""
        provisional = self._path.with_name(PROVISIONAL)
        return provisional if provisional.is_file() and not open_stream(self._path).index() else self._path

    def _reopen(self) -> None:
        path = self._newest()
        # The viewer itself says that a frame is provisional.
        self.stream = open_stream(path, self._most_invalid) if path == self._path else PlayableStream(path)
        self._opened = self.stream.path.stat()
        self._current: CodedFrame | None = None
        self._upcoming: Iterator[CodedFrame] = iter(())
        self._entries: list[tuple[int, int, int]] = []
        self._size = 0
        self._centres.clear()

    def _keyframe_before(self, frame: int) -> int:
        """Return the last keyframe from which a frame can be decoded."""
        keyframes = [index for kind, index, _ in self._entries if kind == PacketKind.KEYFRAME and index < frame]
        return keyframes[-1] if keyframes else self.frames[0]

    def _advance(self, frame: int) -> None:
        with suppress(TruncatedStreamError):  # a packet that is still being written
            for coded in self._upcoming:
                self._current = coded
                self._centres[coded.frame] = (coded.ids, coded.gaussians.numpy()["means"])
                self._centres.move_to_end(coded.frame)
                while len(self._centres) > _CACHED_FRAMES:
                    self._centres.popitem(last=False)
                if coded.frame >= frame:
                    return

    def _centres_at(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        if frame not in self._centres:
            current = self._current
            self.at(frame)
            centres = self._centres[frame]
            if current is not None:  # otherwise the frame on display would be decoded again later
                self.at(current.frame)
            return centres
        return self._centres[frame]
