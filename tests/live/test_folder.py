"""Images in a folder that is being filled: complete ones of one number, the newest."""

from __future__ import annotations

import os
import time
from pathlib import Path
from threading import Timer

import cv2
import numpy as np
import pytest

from morgs_mi.live.folder import FolderFeed


def write(folder: Path, camera: str, number: int, suffix: str = ".png", part: float = 1) -> None:
    (folder / camera).mkdir(exist_ok=True)
    data = cv2.imencode(suffix, np.full((40, 60, 3), number, np.uint8))[1].tobytes()
    (folder / camera / f"{number:04d}{suffix}").write_bytes(data[: int(part * len(data))])


def fill(folder: Path, numbers: range, *names: str, suffix: str = ".png") -> Path:
    folder.mkdir(exist_ok=True)
    for number in numbers:
        for name in names:
            write(folder, name, number, suffix)
    return folder


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_FolderFeed__reads_the_newest_number_that_is_complete(tmp_path: Path, suffix: str) -> None:
    feed = FolderFeed(fill(tmp_path, range(5), "cam2", "cam10", suffix=suffix), 1)
    write(tmp_path, "cam10", 4, suffix, part=0.9)
    write(tmp_path, "cam2", 5, suffix)
    (tmp_path / ".cache").mkdir()
    (tmp_path / "cam2" / ".9999.png").write_bytes(b"temporary")
    first = feed.newest()
    assert first is not None
    assert feed.names == ("cam2", "cam10")
    assert first.numbers == (3, 3)
    assert all(np.abs(image.astype(int) - 3).max() <= 1 for image in first.images if image is not None)
    assert (first.skew, first.dropped) == (0, 0)
    fill(tmp_path, range(4, 9), "cam2", "cam10", suffix=suffix)
    second = feed.newest(first)
    assert second is not None
    assert second.numbers == (8, 8)
    assert second.dropped == 4
    assert second.time >= first.time


def test_FolderFeed__begins_when_all_cameras_do(tmp_path: Path) -> None:
    """Of the folders at the time of the second number, because those of a first are made one after the other."""
    feed = FolderFeed(fill(tmp_path, range(1), "a", "b"), 5)
    timer = Timer(0.2, fill, (tmp_path, range(2), "a", "b", "c"))
    timer.start()
    first = feed.newest()
    timer.join()
    assert first is not None
    assert feed.names == ("a", "b", "c")
    assert first.numbers == (0, 0, 0)


def test_FolderFeed__of_given_cameras_ignores_the_others(tmp_path: Path) -> None:
    first = FolderFeed(fill(tmp_path, range(2), "a", "b", "c"), 1, ["c", "a"]).newest()
    assert first is not None
    assert first.numbers == (1, 1)


def test_FolderFeed__leaves_out_a_camera_that_stops_until_it_is_back(tmp_path: Path) -> None:
    feed = FolderFeed(fill(tmp_path, range(2), "a", "b"), 0.2, ["a", "b"])
    first = feed.newest()
    fill(tmp_path, range(2, 5), "a")
    write(tmp_path, "b", 4, part=0.5)
    second = feed.newest(first)
    assert second is not None
    assert [image is not None for image in second.images] == [True, False]
    assert second.numbers == (4, 4)
    assert f"no complete image in {tmp_path / 'b'} for 0.2 s" in feed.problem(1)
    fill(tmp_path, range(5, 6), "a")
    start = time.monotonic()
    third = feed.newest(second)
    assert time.monotonic() - start < 0.15, "it is not waited for again"
    fill(tmp_path, range(6, 7), "a", "b")
    fourth = feed.newest(third)
    assert fourth is not None
    assert fourth.numbers == (6, 6)
    assert feed.newest(fourth) is None


def test_FolderFeed__leaves_out_a_camera_that_stopped_long_before_the_others(tmp_path: Path) -> None:
    """During a fit: its last images have numbers that the others have, too."""
    feed = FolderFeed(fill(tmp_path, range(1), "a", "b"), 0.2, ["a", "b"])
    first = feed.newest()
    fill(tmp_path, range(1, 9), "a")
    fill(tmp_path, range(1, 3), "b")
    for number in range(1, 3):
        for name in ("a", "b"):
            os.utime(tmp_path / name / f"{number:04d}.png", times=(time.time() - 60, time.time() - 60))
    second = feed.newest(first)
    assert second is not None
    assert second.numbers == (8, 8)
    assert [image is not None for image in second.images] == [True, False]


def test_FolderFeed__names_what_it_lacks(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="expected a folder with the images of the cameras, found none"):
        FolderFeed(tmp_path / "nowhere", 1)
    fill(tmp_path, range(3), "left", "right")
    with pytest.raises(ValueError, match=r"images of cam0, cam1 that have .* found folders called left, right; check"):
        FolderFeed(tmp_path, 0.1, ["cam0", "cam1"]).newest()
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"images of the cameras that have .* found folders called nothing"):
        FolderFeed(tmp_path / "empty", 0.1).newest()
