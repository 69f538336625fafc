"""The feed of the sources that a user names."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from threading import Event

import numpy as np

from morgs_mi.studio.live.cameras import CameraFeed
from morgs_mi.studio.live.live_config import LiveConfig
from morgs_mi.studio.live.playing import ClipClock, is_video, play
from morgs_mi.studio.live.reading import read_camera

Source = int | str | Path
"""A camera of this machine, by OpenCV's index; or a path or URL that FFmpeg opens."""


def open_feed(
    sources: Sequence[Source], config: LiveConfig, names: Sequence[str] | None = None
) -> CameraFeed:
    """Return the feed of one source per camera.

    Args:
        sources: one per camera, in the order of `names`.
        config: settings.
        names: names of the cameras; by default cam0, cam1, ...

    Raises:
        ValueError: there is no source, one occurs twice, their number differs from the number of
            names, or the settings repeat videos and there is none.
    """
    if not sources:
        raise ValueError(
            "open_feed(): `camera` must have a source per camera, got none; name them."
        )
    listed_sources = f"{len(sources)} ({', '.join(map(str, sources))})"
    if len(set(sources)) < len(sources):
        raise ValueError(
            f"open_feed(): `camera` must have different sources, got {listed_sources}; name "
            "each once."
        )
    if names is None:
        names = [f"cam{k}" for k in range(len(sources))]
    if len(names) != len(sources):
        raise ValueError(
            f"open_feed(): `camera` must have a source for each of the {len(names)} calibrated "
            f"cameras ({', '.join(names)}), got {listed_sources}; name them in that order."
        )
    stop = Event()
    videos = [source for source in sources if is_video(source)]
    if config.loop and not videos:
        raise ValueError(
            f"open_feed(): `loop` repeats videos, got none in {listed_sources}; leave it out."
        )
    clock = ClipClock(len(videos))

    def images(source: Source) -> Iterator[np.ndarray | None]:
        if is_video(source):
            return play(source, clock, stop, videos.index(source), config.loop)
        return read_camera(source, stop, config.size)

    end_text = (
        "it has ended; --loop repeats videos" if videos and not config.loop else "it has ended"
    )
    cameras = {name: images(source) for name, source in zip(names, sources, strict=True)}
    warm_up = 0.0 if len(videos) == len(sources) else config.warm_up
    return CameraFeed(cameras, config.timeout, warm_up, stop, end_text)
