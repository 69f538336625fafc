"""Headers of video files, and the times of the frames that they show.

The number of frames in a header, and the packets of a file, include frames that its edit list
hides.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from morgs_mi.io.movie import Movie, read_movie

SAME_TIME = 1e-6
"""Difference in s up to which two times are the same."""

# Files whose packets have no times of presentation.
_WITHOUT_TIMES = (".avi",)
# Deviation from a constant rate that does not count: the exposure's, in frames.
_JITTER = 0.1
# Rounding of Matroska's times, s.
_ROUNDING = 1e-3
# Frames before the end of a clip from which its last frames are decoded.
_LAST = 32


@dataclass(frozen=True)
class VideoHeader:
    """Header of a video file."""

    width: int  #: Of the first frame, in pixels.
    height: int  #: Of the first frame, in pixels.
    #: Number of frames that the file shows if it is complete, 0 if it does not state it.
    num_frames: int
    num_held: int  #: Number of these frames in the file.
    fps: float  #: Frames per second, 0 if it does not state them.
    #: Times of the frames in the file on the clock of OpenCV's decoder, ascending, s [num_held];
    #: None if it does not store them.
    times: np.ndarray | None


def read_header(path: Path) -> VideoHeader:
    """Return the header of a video; its first frame is decoded, and the packets of the others are
    read.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is empty, or OpenCV cannot decode it.
    """
    _check_file(path)
    stream = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        height, width = _first_frame(path, stream).shape[:2]
        num_frames = int(stream.get(cv2.CAP_PROP_FRAME_COUNT))
        frames_before = int(stream.get(cv2.CAP_PROP_PTS))
        fps = stream.get(cv2.CAP_PROP_FPS)
        movie = read_movie(path)
        packets = packet_times(path)
        has_times = path.suffix.lower() not in _WITHOUT_TIMES
        times = _shown(path, stream, movie, packets) if has_times else packets
    finally:
        stream.release()
    if movie is not None and movie.complete:
        num_frames = len(times)  # the header counts hidden frames
    elif has_times:
        num_frames -= len(packets) - len(times)
    if movie is None and has_times:
        # The header has the end of the file, also where the sound begins first.
        num_frames -= frames_before
    if has_times and (np.diff(times) > 0).all():
        return VideoHeader(width, height, num_frames, len(times), fps, times)
    # The decoder skips packets without a time.
    num_held = min(len(times), num_frames or len(times))
    return VideoHeader(width, height, num_frames, num_held, fps, None)


def _check_file(path: Path) -> None:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a video file, found none; check the path.")
    if path.stat().st_size == 0:
        raise ValueError(f"{path}: expected a video, got an empty file; copy or record it again.")


def _first_frame(path: Path, stream: cv2.VideoCapture) -> np.ndarray:
    ok, frame = stream.read()
    if not ok:
        raise ValueError(
            f"{path}: expected a video, got {path.stat().st_size} bytes of which OpenCV "
            "cannot decode one frame: the file is truncated or no video; copy or convert it "
            "again."
        )
    return frame


def seconds(stream: cv2.VideoCapture) -> float:
    """Return the time of the frame or packet that a decoder has just passed."""
    return stream.get(cv2.CAP_PROP_POS_MSEC) / 1000


def clock(times: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Return the positions of frames on a regular clock and its rate, None if the rate of the
    frames is constant.
    """
    if len(times) < 3:
        return None
    positions, period = _positions(times)
    if np.abs(positions - np.arange(len(times))).max() <= _JITTER + _ROUNDING / period:
        return None
    return positions, 1 / period


def _positions(times: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the positions of frames on a regular clock, and its period, s."""
    steps = np.diff(times)
    # Most frames are one period apart, and in step with the clock.
    period = float(steps[steps < 1.5 * np.median(steps)].mean())
    ticks = np.append(0, np.cumsum(np.maximum(1, np.rint(steps / period))))
    return (times - np.median(times - period * ticks)) / period, period


def true_rate(fps: float, frames: float, duration: float) -> float:
    """Return the frame rate `fps` of a header, unless the times of the frames contradict it.

    Args:
        fps: frames per second, 0 if the header does not state them.
        frames: number of frame periods between the first and the last frame.
        duration: time between the two, s.
    """
    # A header may have a rounded rate or a mean over pauses, and the time of a frame may be
    # rounded.
    difference = abs(fps * duration - frames)
    return fps if not duration or difference <= _JITTER + _ROUNDING * fps else frames / duration


def packet_times(path: Path) -> np.ndarray:
    """Return the times of the packets in a video file, s.

    The packets are read but not decoded, 0.2 ms each at 1080x1920. They are in the order of
    decoding, which differs from the order of presentation where frames are predicted from later
    ones.
    """
    return _remaining_times(cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1]))


def _remaining_times(stream: cv2.VideoCapture) -> np.ndarray:
    """Return the times of the frames or packets that follow, s, and release the decoder."""
    times = []
    while stream.grab():
        times.append(seconds(stream))
    stream.release()
    return np.array(times)


def _shown(
    path: Path, stream: cv2.VideoCapture, movie: Movie | None, packets: np.ndarray
) -> np.ndarray:
    """Return the times of the frames that a video shows, ascending, s.

    Args:
        path: the file.
        stream: its decoder, which has passed the first frame.
        movie: its edit list, None if it can have none.
        packets: times of its packets, s.
    """
    parts = () if movie is None else movie.parts
    if len(parts) > 1:
        return _decoded_times(path, 0.0)
    first = seconds(stream)
    times = np.sort(packets + (_clock_difference(stream, packets) if parts else 0.0))
    if (np.diff(times) <= 0).any():
        return times  # a packet without a time repeats another time
    times = times[times >= first - SAME_TIME]
    return times if not parts or not parts[0] else _before(path, first + parts[0], times)


def _before(path: Path, end: float, times: np.ndarray) -> np.ndarray:
    """Return the times of frames of which a video shows those before `end`, s."""
    if len(times) < 2:
        return times
    period = float(np.median(np.diff(times)))
    if times[-1] < end - period / 2:
        return times
    # An end between two frames depends on the start, which the decoder moves to a frame.
    last = _decoded_times(path, end - _LAST * period)
    return times if not len(last) else times[times <= last[-1] + SAME_TIME]


def _clock_difference(stream: cv2.VideoCapture, packets: np.ndarray) -> float:
    """Return the time of a video's first packet for its decoder minus its time among the packets,
    s.

    OpenCV sets the first packet to the time 0 where packets are read without a decoder, and the
    first frame that is shown where they are decoded.
    """
    stream.set(cv2.CAP_PROP_POS_FRAMES, 0)
    stream.set(cv2.CAP_PROP_FORMAT, -1)
    return seconds(stream) - packets[0] if len(packets) and stream.grab() else 0.0


def _decoded_times(path: Path, begin: float) -> np.ndarray:
    """Return the times of the frames of a video after about `begin`, s; all are decoded."""
    stream = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if begin > 0:
        stream.set(cv2.CAP_PROP_POS_MSEC, 1000 * begin)
    return _remaining_times(stream)
