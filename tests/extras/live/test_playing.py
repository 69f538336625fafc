"""Videos that are played side by side, at their speed and at one time."""

import time
from pathlib import Path
from threading import Event, Thread

import numpy as np
import pytest

from morgs_mi.extras.live import sources as module
from morgs_mi.extras.live.live_config import LiveConfig
from morgs_mi.extras.live.sources import ClipClock, is_video, open_feed, play
from morgs_mi.io.video import VideoReader
from morgs_mi.io.video_writer import write_video
from tests.io.test_frame_times import clip as numbered_clip
from tests.io.test_frame_times import number
from tests.scenes.captures import write_timed_video
from tests.scenes.edit_lists import show_parts


def clip(path, count, fps=50):
    """Write a video of grey images, each ten levels brighter than the one before."""
    write_video(path, [np.full((16, 16, 3), 10 * k, np.uint8) for k in range(count)], fps)
    return path


def played(paths):
    """Return the time and the number [n, 2] of the images of each clip."""
    clock = ClipClock(len(paths))
    rows = [[] for _ in paths]
    start = time.monotonic()

    def read(k):
        for image in play(paths[k], clock, Event(), k):
            rows[k].append((time.monotonic() - start, int(image[0, 0, 0]) // 10))

    threads = [Thread(target=read, args=(k,), daemon=True) for k in range(len(paths))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    return [np.array(each) for each in rows]


def test_play__plays_a_clip_once_at_its_own_speed(tmp_path):
    (rows,) = played([clip(tmp_path / "a.mkv", 6, fps=20)])
    times, numbers = rows.T
    assert numbers.tolist() == [0, 1, 2, 3, 4, 5]
    assert times[-1] - times[0] >= 5 / 20 - 0.01
    # Not all at once; on a busy machine a late image is followed by the next one.
    assert np.count_nonzero(np.diff(times) > 0.02) >= 3


def test_play__waits_for_a_clip_that_is_decoded_slowly(monkeypatch):
    def timed(path):
        for k in range(20):
            time.sleep(0.02 * (path.name == "slow"))
            yield np.full((2, 2, 3), 10 * k, np.uint8), k / 100, 1 / 100

    monkeypatch.setattr(module, "timed_images", timed)
    slow, fast = played([Path("slow"), Path("fast")])
    assert slow[:, 1].tolist() == fast[:, 1].tolist() == [*range(20)]
    assert (fast[2:, 0] > slow[:-2, 0]).all()
    assert (slow[2:, 0] > fast[:-2, 0]).all()


def test_play__ends_when_it_is_closed(tmp_path):
    """Also while it waits for another clip, which has not begun."""
    closed = Event()
    reader = Thread(
        target=list,
        args=(play(clip(tmp_path / "a.mkv", 3), ClipClock(2), closed),),
        daemon=True,
    )
    reader.start()
    time.sleep(0.2)
    assert reader.is_alive()
    closed.set()
    reader.join(1)
    assert not reader.is_alive()


def test_play__refuses_what_has_no_image(tmp_path):
    (tmp_path / "text.mkv").write_text("no video")
    with pytest.raises(ValueError, match=r"text.mkv: expected a video, got 8 bytes"):
        next(play(tmp_path / "text.mkv", ClipClock(), Event()))


def test_is_video__is_not_the_description_of_a_stream(tmp_path):
    paths = [tmp_path / name for name in ("clip.mp4", "cam.sdp")]
    for path in paths:
        path.touch()
    sources = (*paths, tmp_path, tmp_path / "nowhere.mp4", 0)
    assert [is_video(source) for source in sources] == [True, False, False, False, False]


def test_open_feed__of_videos_begins_with_their_first_images_and_ends_with_them(tmp_path):
    feed = open_feed([clip(tmp_path / f"{k}.mkv", 10) for k in range(2)], LiveConfig(timeout=1))
    try:
        frame_set = first = feed.newest()
        assert max(first.numbers.values()) < 8, "without a time to adjust the exposure"
        while frame_set is not None:
            frame_set = feed.newest(frame_set)
        assert feed.ended() == "cam0, cam1: it has ended"
    finally:
        feed.close()


def test_play__shows_the_frames_of_the_reader(tmp_path):
    write_timed_video(tmp_path / "a.mp4", numbered_clip(20), range(0, 200, 10), "libx264")
    show_parts(tmp_path / "a.mp4", [(0.05, 0.08)])
    played = [number(image) for image in play(tmp_path / "a.mp4", ClipClock(), Event())]
    assert (
        played
        == [number(image) for image in VideoReader.open(tmp_path / "a.mp4").frames()]
        == list(range(5, 13))
    )
