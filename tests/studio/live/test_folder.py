"""Images in a folder that is being filled: complete ones of one number, the newest."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path
from threading import Timer

import cv2
import numpy as np
import pytest

from morgs_mi.studio.live import folder as module
from morgs_mi.studio.live.folder import FolderFeed


def write(folder: Path, camera: str, number: int, suffix: str = ".png", part: float = 1) -> None:
    (folder / camera).mkdir(exist_ok=True)
    data = cv2.imencode(suffix, np.full((40, 60, 3), number % 256, np.uint8))[1].tobytes()
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
    assert all(
        np.abs(image.astype(int) - 3).max() <= 1 for image in first.images if image is not None
    )
    assert (first.skew, first.dropped) == (0, 0)
    fill(tmp_path, range(4, 9), "cam2", "cam10", suffix=suffix)
    second = feed.newest(first)
    assert second is not None
    assert second.numbers == (8, 8)
    assert second.dropped == 4
    assert second.time >= first.time


def test_FolderFeed__begins_when_all_cameras_do(tmp_path: Path) -> None:
    """The folders count at the time of the second number: the first images' folders are made one
    after the other.
    """
    feed = FolderFeed(fill(tmp_path, range(1), "a", "b"), 5)
    timer = Timer(0.2, fill, (tmp_path, range(2), "a", "b", "c"))
    timer.start()
    first = feed.newest()
    timer.join()
    assert first is not None
    assert feed.names == ("a", "b", "c")
    assert first.numbers == (0, 0, 0)


def test_FolderFeed__waits_for_a_camera_that_begins_while_the_folders_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(tmp_path, range(1), "a", "b")
    files_of = module.files_of_camera

    def files_meanwhile(folder: Path, limit: int) -> dict[int, Path]:
        if not (tmp_path / "c").exists():
            fill(tmp_path, range(1), "c")
            fill(tmp_path, range(1, 2), "a", "b", "c")
        return files_of(folder, limit)

    monkeypatch.setattr(module, "files_of_camera", files_meanwhile)
    first = FolderFeed(tmp_path, 5).newest()
    assert first is not None
    assert len(first.images) == 3


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


def test_FolderFeed__leaves_out_a_camera_that_stopped_long_before_the_others(
    tmp_path: Path,
) -> None:
    """During a fit: its last images have numbers that the others have, too."""
    feed = FolderFeed(fill(tmp_path, range(1), "a", "b"), 0.2, ["a", "b"])
    first = feed.newest()
    fill(tmp_path, range(1, 9), "a")
    fill(tmp_path, range(1, 3), "b")
    for number in range(1, 3):
        for name in ("a", "b"):
            os.utime(
                tmp_path / name / f"{number:04d}.png", times=(time.time() - 60, time.time() - 60)
            )
    second = feed.newest(first)
    assert second is not None
    assert second.numbers == (8, 8)
    assert [image is not None for image in second.images] == [True, False]


FAR = 10**30


@pytest.fixture
def short_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PAUSE", 0.2)


def test_FolderFeed__goes_on_after_a_number_far_ahead(tmp_path: Path, short_pause: None) -> None:
    feed = FolderFeed(fill(tmp_path, range(2), "a", "b"), 2, ["a", "b"])
    first = feed.newest()
    fill(tmp_path, range(FAR, FAR + 1), "a", "b")
    second = feed.newest(first)
    assert second is not None
    assert second.numbers == (FAR, FAR)
    assert second.dropped == 0, "images, not numbers"
    time.sleep(0.3)
    fill(tmp_path, range(2, 6), "a", "b")
    third = feed.newest(second)
    assert third is not None
    assert third.numbers == (5, 5)
    assert third.dropped == 3
    fill(tmp_path, range(6, 7), "a", "b")
    start = time.monotonic()
    fourth = feed.newest(third)
    assert fourth is not None
    assert fourth.numbers == (6, 6), "not the one far ahead again"
    assert time.monotonic() - start < 0.15, "without a pause"


def test_FolderFeed__goes_on_when_numbers_begin_again(
    tmp_path: Path, short_pause: None, caplog
) -> None:
    """In place of the first images, and in a folder that was cleared."""
    feed = FolderFeed(fill(tmp_path, range(9), "a", "b"), 2, ["a", "b"])
    bundle = feed.newest()
    for numbers in (range(3), range(2)):
        time.sleep(0.3)
        if numbers == range(2):
            shutil.rmtree(tmp_path / "a")
            shutil.rmtree(tmp_path / "b")
        fill(tmp_path, numbers, "a", "b")
        bundle = feed.newest(bundle)
        assert bundle is not None
        assert bundle.numbers == (numbers[-1], numbers[-1])
        assert bundle.dropped == numbers[-1]
    fill(tmp_path, range(2, 4), "a", "b")
    bundle = feed.newest(bundle)
    assert bundle is not None
    assert bundle.numbers == (3, 3)
    assert bundle.dropped == 1
    assert [record.message for record in caplog.records] == [
        f"{tmp_path}: the numbers go on with 2 after 8"
    ]


def test_FolderFeed__reads_no_image_twice(tmp_path: Path, short_pause: None) -> None:
    """Of a disk with another clock, and of a program that writes the images of a moment in any
    order.
    """
    ahead = time.time() + 3600
    feed = FolderFeed(fill(tmp_path, range(3), "a", "b"), 0.7, ["a", "b"])
    for file in tmp_path.rglob("*.png"):
        os.utime(file, times=(ahead, ahead))
    first = feed.newest()
    assert first is not None
    assert first.numbers == (2, 2)
    for name in ("a", "b"):
        write(tmp_path, name, 1)
        os.utime(tmp_path / name / "0001.png", times=(ahead + 0.1, ahead + 0.1))
    assert feed.newest(first) is None
    assert feed.ended() == f"no complete new images in {tmp_path} for 0.7 s"


def test_FolderFeed__that_is_removed_is_an_error(tmp_path: Path) -> None:
    feed = FolderFeed(fill(tmp_path / "images", range(2), "a", "b"), 0.1, ["a", "b"])
    first = feed.newest()
    shutil.rmtree(tmp_path / "images")
    for bundle in (first, None):
        with pytest.raises(
            FileNotFoundError,
            match="images: expected the images of the cameras, but the folder was",
        ):
            feed.newest(bundle)


def test_FolderFeed__begins_with_the_only_number(tmp_path: Path, caplog) -> None:
    """Without given cameras, when no second number has come in time; a folder without images is
    named.
    """
    fill(tmp_path, range(1), "a", "b")
    (tmp_path / "c").mkdir()
    feed = FolderFeed(tmp_path, 0.2)
    first = feed.newest()
    assert first is not None
    assert feed.names == ("a", "b")
    assert [record.message for record in caplog.records] == [
        f"c is left out: no image in {tmp_path}"
    ]


LACKS = [
    (lambda _: None, "found folders called nothing, but no image of a, b; check the path"),
    (
        lambda folder: fill(folder, range(3), "left", "b"),
        "found folders called b, left, but no image of a; check",
    ),
    (
        lambda folder: (fill(folder, range(3), "b"), (folder / "a").mkdir()),
        "called a, b, but no image of a; check",
    ),
    (
        lambda folder: (fill(folder, range(3), "a"), fill(folder, range(5, 9), "b")),
        "found folders called a, b, with 0 to 2 of a, 5 to 8 of b; check",
    ),
    (
        lambda folder: (fill(folder, range(1), "a"), write(folder, "b", 0, part=0.5)),
        "found folders called a, b, but no complete image 0 of b; check",
    ),
]


@pytest.mark.parametrize(("write_images", "message"), LACKS)
def test_FolderFeed__names_the_camera_that_lacks_images(
    tmp_path: Path, write_images, message: str
) -> None:
    write_images(tmp_path)
    with pytest.raises(
        ValueError,
        match=f"images of a, b that have the same number, such as CAM/0000.png, .*{message}",
    ):
        FolderFeed(tmp_path, 0.1, ["a", "b"]).newest()


def test_FolderFeed__names_what_it_lacks(tmp_path: Path) -> None:
    with pytest.raises(
        FileNotFoundError, match="expected a folder with the images of the cameras, found none"
    ):
        FolderFeed(tmp_path / "nowhere", 1)
    with pytest.raises(
        ValueError, match=r"images of the cameras that have .* found folders called nothing; check"
    ):
        FolderFeed(tmp_path, 0.1).newest()


def stamp(folder: Path, **clocks: float) -> None:
    """Write camera CAM's new images as a machine whose clock is ahead by `clocks[CAM]` seconds."""
    for name, ahead in clocks.items():
        for file in (folder / name).iterdir():
            if abs(file.stat().st_mtime - time.time()) < 60:
                time_of_file = file.stat().st_mtime + ahead
                os.utime(file, times=(time_of_file, time_of_file))


CLOCKS = [{"a": -300, "b": -300}, {"a": 300, "b": 300}, {"a": -300, "b": 0}, {"a": 300, "b": -4000}]


@pytest.mark.parametrize("clocks", CLOCKS)
def test_FolderFeed__has_times_of_this_machine_whatever_the_clocks_of_the_files(
    tmp_path: Path, clocks
) -> None:
    start = time.monotonic()
    feed = FolderFeed(fill(tmp_path, range(2), "a", "b"), 2, ["a", "b"])
    stamp(tmp_path, **clocks)
    bundle = feed.newest()
    for number in (2, 3):
        time.sleep(0.2)
        fill(tmp_path, range(number, number + 1), "a", "b")
        stamp(tmp_path, **clocks)
        written = time.monotonic()
        time.sleep(0.2)  # a fit
        bundle = feed.newest(bundle)
        assert bundle is not None
        assert bundle.numbers == (number, number)
        assert start < bundle.time <= time.monotonic()
    # The time by which the first images were found late is known from the later ones.
    assert bundle is not None
    assert bundle.time == pytest.approx(written, abs=0.25)


def test_FolderFeed__has_no_times_before_the_last_bundle_if_a_clock_is_set_back(
    tmp_path: Path,
) -> None:
    feed = FolderFeed(fill(tmp_path, range(2), "a", "b"), 2, ["a", "b"])
    first = feed.newest()
    assert first is not None
    fill(tmp_path, range(2, 3), "a", "b")
    stamp(tmp_path, a=-500, b=-500)
    second = feed.newest(first)
    assert second is not None
    assert first.time <= second.time <= time.monotonic()


def test_FolderFeed__has_the_time_at_which_it_finds_images_that_were_copied_with_old_times(
    tmp_path: Path,
) -> None:
    feed = FolderFeed(fill(tmp_path, range(1), "a", "b"), 2, ["a", "b"])

    def copy(number: int) -> None:
        fill(tmp_path / "other", range(number, number + 1), "a", "b")
        for name in ("a", "b"):
            os.utime(tmp_path / "other" / name / f"{number:04d}.png", times=(1e9, 1e9))
            (tmp_path / "other" / name / f"{number:04d}.png").rename(
                tmp_path / name / f"{number:04d}.png"
            )

    copy(0)
    first = feed.newest()
    timer = Timer(0.4, copy, (1,))
    timer.start()
    second = feed.newest(first)
    assert second is not None
    assert second.time == pytest.approx(time.monotonic(), abs=0.15)


@pytest.mark.parametrize("clocks", CLOCKS)
def test_FolderFeed__goes_on_when_numbers_begin_again_whatever_the_clocks(
    tmp_path: Path, short_pause, clocks
) -> None:
    feed = FolderFeed(fill(tmp_path, range(9), "a", "b"), 2, ["a", "b"])
    stamp(tmp_path, **clocks)
    first = feed.newest()
    time.sleep(0.3)
    fill(tmp_path, range(3), "a", "b")
    stamp(tmp_path, **clocks)
    second = feed.newest(first)
    assert second is not None
    assert second.numbers == (2, 2)
    assert all(image is not None for image in second.images)
