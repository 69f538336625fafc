"""Live fits of a clip that is played at real speed: frames are dropped, and the stream shows those
that are not.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.png import png_bytes
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.evaluate.metrics import psnr_of
from morgs_mi.playback.streams import open_stream
from morgs_mi.runs.fit_capture import stream_capture
from morgs_mi.studio.live.fit_live import fit_live
from morgs_mi.studio.live.live_config import LiveConfig
from tests.scenes.full_disk import files_end_at
from tests.scenes.live_clip import (
    CONFIG,
    FPS,
    NAMES,
    clips,
    filling,
    in_background,
    piping,
    write_calibration,
    write_loop,
)


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """The calibration of the cameras."""
    return write_calibration(tmp_path / "rig")


@pytest.fixture
def images(tmp_path: Path) -> Path:
    """An empty folder."""
    (tmp_path / "images").mkdir()
    return tmp_path / "images"


def packets(path: Path) -> list[bytes]:
    return [packet.encoded for packet in StreamReader(path / "stream.morgs")]


@pytest.mark.slow
def test_fit_live__follows_a_folder_that_is_filled(tmp_path: Path, rig: Path, images: Path) -> None:
    out = tmp_path / "out"
    grown = []
    with in_background(filling(images)):
        live = LiveConfig(rig, downscale=4, frames=4)
        rows = fit_live(
            [images], out, live, CONFIG, lambda *_: grown.append(open_stream(out).index()[-1][1])
        )
    assert grown == [0, 1, 2, 3], "the stream can be read while it grows"
    assert [row.frame for row in rows] == [0, 1, 2, 3]
    for previous_row, row in pairwise(rows):
        assert row.time > previous_row.time
        assert row.latency >= 0
        assert not row.problems
    assert sum(row.dropped for row in rows) > 0, "the fit is slower than the clip"
    assert counts_what_is_dropped(
        [row.dropped for row in rows], list(load_capture(out / "capture").images(2)), clips()[2]
    )
    report = json.loads((out / "report.json").read_text())
    assert [row["dropped"] for row in report["live"]] == [row.dropped for row in rows]
    assert open_stream(out).closed()
    # The live fit equals the fit of a recording of its frames, to the bit.
    capture = load_capture(out / "capture", 4)
    assert capture.num_frames == 4
    stream_capture(capture, tmp_path / "again", CONFIG)
    assert packets(out) == packets(tmp_path / "again")
    scores = evaluate_stream(out)
    assert scores.complete
    for row, frame in zip(scores.frames, capture.frames(), strict=True):
        assert row.scores.psnr > np.mean([grey_psnr(image) for image in frame.images]) + 4


def counts_what_is_dropped(dropped: list[int], recorded: list[Any], clip: list[np.ndarray]) -> bool:
    """Return whether recorded images are a looped clip's, from any frame on, without the dropped
    ones.
    """
    numbers = np.cumsum([0, *(count + 1 for count in dropped[1:])])
    return any(
        all(
            np.array_equal(image, clip[(begin + n) % len(clip)])
            for n, image in zip(numbers, recorded, strict=True)
        )
        for begin in range(len(clip))
    )


def grey_psnr(image: np.ndarray) -> float:
    values = image / 255
    return psnr_of(((values - values.mean((0, 1))) ** 2).mean())


@pytest.mark.slow
def test_fit_live__reads_videos_through_pipes(tmp_path: Path, rig: Path) -> None:
    # Long enough for a slow machine; the pipes are closed when the fit ends.
    repeats = 120
    pipes = [tmp_path / f"pipe{k}" for k in range(len(NAMES))]
    with ExitStack() as playing:
        for pipe, clip in zip(pipes, clips(), strict=True):
            os.mkfifo(pipe)
            data = write_loop(tmp_path / "clip.mkv", clip, repeats)
            playing.enter_context(in_background(piping(pipe, data, repeats * len(clip) / FPS)))
        rows = fit_live(pipes, tmp_path / "out", LiveConfig(rig, downscale=2, frames=4), CONFIG)
    assert len(rows) == 4
    assert sum(row.dropped for row in rows) > 0, "the fit is slower than the clip"
    assert sum(row.dropped + 1 for row in rows) <= repeats * len(clips()[0])
    assert max(row.skew for row in rows) <= 0.5
    assert not any(row.problems for row in rows)
    assert evaluate_stream(tmp_path / "out").num_frames == 4


def write(
    images: Path, number: int, names: Sequence[str] = NAMES, **sizes: tuple[int, int]
) -> None:
    """Write an image of each camera, at the sizes that are given and otherwise the recorded one."""
    for name, clip in zip(NAMES, clips(), strict=True):
        if name in names:
            file = images / name / f"{number:04d}.png"
            file.parent.mkdir(exist_ok=True)
            file.write_bytes(png_bytes(cv2.resize(clip[number], sizes.get(name, (200, 150)))))


@pytest.mark.slow
def test_fit_live__leaves_out_a_camera_that_stops(
    tmp_path: Path, rig: Path, images: Path, caplog
) -> None:
    write(images, 0)
    live = LiveConfig(rig, downscale=4, frames=3, timeout=0.5)
    others = ("cam0", "cam2", "cam3")
    rows = fit_live(
        [images],
        tmp_path / "out",
        live,
        CONFIG,
        lambda row, _: write(images, row.frame + 1, names=others),
    )
    assert [bool(row.problems) for row in rows] == [False, True, True]
    assert [record.message for record in caplog.records if "left out" in record.message] == [
        f"frame 1: cam1 is left out: no complete image in {images / 'cam1'} for 0.5 s"
    ]
    views = evaluate_stream(tmp_path / "out").frames[1].views
    assert [np.isnan(views[name].psnr) for name in NAMES] == [False, True, False, False]


@pytest.mark.slow
def test_fit_live__needs_no_images_of_a_camera_that_is_left_out(
    tmp_path: Path, rig: Path, images: Path
) -> None:
    with in_background(filling(images)):
        fit_live(
            [images],
            tmp_path / "out",
            LiveConfig(rig, without=("cam1",), downscale=4, frames=1),
            CONFIG,
        )
    assert load_capture(tmp_path / "out" / "capture").names == ("cam0", "cam2", "cam3")
    assert not (tmp_path / "out" / "capture" / "cam1").exists()


@pytest.mark.slow
def test_fit_live__leaves_out_images_of_another_size(
    tmp_path: Path, rig: Path, images: Path
) -> None:
    write(images, 0)
    live = LiveConfig(rig, downscale=4, frames=2, timeout=5)
    _, row = fit_live(
        [images], tmp_path / "out", live, CONFIG, lambda *_: write(images, 1, cam2=(100, 75))
    )
    assert row.problems == ("cam2: expected an image of 200x150, got 100x75",)
    assert not (tmp_path / "out" / "capture" / "cam2" / "0001.png").exists()


@pytest.mark.slow
def test_fit_live__calibrates_the_cameras_once(tmp_path: Path, images: Path) -> None:
    with in_background(filling(images)):
        rows = fit_live([images], tmp_path / "out", LiveConfig(seconds=1, record=False), CONFIG)
    assert len(rows) >= 2
    assert rows[-1].time <= rows[0].latency + 1
    capture = load_capture(tmp_path / "out" / "capture")
    assert capture.names == NAMES
    assert capture.num_frames == 1, "only the first frame is recorded"


@pytest.mark.slow
def test_fit_live__ends_with_a_whole_stream_when_it_is_interrupted(
    tmp_path: Path, rig: Path, images: Path
) -> None:
    def interrupt(row, report) -> None:
        if row.frame == 1:
            raise KeyboardInterrupt

    with in_background(filling(images)):
        rows = fit_live([images], tmp_path / "out", LiveConfig(rig, downscale=2), CONFIG, interrupt)
        assert [row.frame for row in rows] == [0, 1]
        assert open_stream(tmp_path / "out").closed()
        assert len(packets(tmp_path / "out")) == 2

        def interrupt_first(stage: str, done: int, total: int) -> None:
            if stage == "First frame" and done:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            fit_live(
                [images],
                tmp_path / "first",
                LiveConfig(rig, downscale=2),
                CONFIG,
                on_stage=interrupt_first,
            )


@pytest.mark.slow
def test_fit_live__ends_with_a_reason(tmp_path: Path, rig: Path, images: Path, caplog) -> None:
    """Without further images, and with an error when the folder of the images is removed."""
    write(images, 0)
    live = LiveConfig(rig, downscale=4, timeout=0.2)
    assert len(fit_live([images], tmp_path / "out", live, CONFIG)) == 1
    (message,) = (
        record.message
        for record in caplog.records
        if record.name == "morgs_mi.studio.live.fit_live"
    )
    assert message == f"the fit ends after frame 0: no complete new images in {images} for 0.2 s"
    with pytest.raises(FileNotFoundError, match="but the folder was removed") as failed:
        fit_live([images], tmp_path / "gone", live, CONFIG, lambda *_: shutil.rmtree(images))
    assert failed.value.__notes__ == [f"{tmp_path / 'gone' / 'stream.morgs'} ends with frame 0."]
    assert open_stream(tmp_path / "gone").closed()
    assert len(packets(tmp_path / "gone")) == 1


def other_size(images: Path) -> None:
    for name in NAMES:
        size = (120, 90) if name != "cam2" else (90, 90)
        for number in range(2):
            file = images / name / f"{number:04d}.png"
            file.parent.mkdir(exist_ok=True)
            cv2.imwrite(str(file), np.zeros((*size[::-1], 3), np.uint8))


def other_names(images: Path) -> None:
    other_size(images)
    (images / "cam3").rename(images / "camera3")


FAULTS = [
    (lambda images: None, [], "`camera` must have a source per camera, or a folder, got none"),
    (lambda images: None, ["a", "a"], r"must have different sources, got 2 \(a, a\)"),
    (
        lambda images: None,
        ["images", "b"],
        "must be one folder with the images of all cameras, or one source per",
    ),
    (
        lambda images: None,
        [61, 62],
        r"each of the 4 calibrated cameras \(cam0, cam1, cam2, cam3\), got 2 \(61, 62\)",
    ),
    (lambda images: None, [60, 61, 62, 63], "cannot open the source 6.; check that it exists"),
    (
        lambda images: None,
        ["images"],
        "expected images of cam0, cam1, cam2, cam3 .* found folders called nothing",
    ),
    (
        other_size,
        ["images"],
        "expected 200x150, the calibrated size of cam2, or a scaled version of it, got 90x90",
    ),
    (
        other_names,
        ["images"],
        "expected images of cam0, .* found folders called cam0, cam1, cam2, camera3",
    ),
]


@pytest.mark.parametrize(("spoil", "sources", "message"), FAULTS)
def test_fit_live__names_what_is_wrong(
    tmp_path: Path, rig: Path, images: Path, spoil, sources, message: str
) -> None:
    spoil(images)
    sources = [images if source == "images" else source for source in sources]
    with pytest.raises((ValueError, OSError), match=message):
        fit_live(sources, tmp_path / "out", LiveConfig(rig, timeout=0.2), CONFIG)
    assert not (tmp_path / "out").exists()


def test_fit_live__refuses_an_output_among_the_images(
    tmp_path: Path, rig: Path, images: Path
) -> None:
    write(images, 0)
    for out in (images, images / "out", images / "cam0" / "out"):
        with pytest.raises(
            ValueError, match=f"expected a folder outside of {images}, into which another program"
        ):
            fit_live([images], out, LiveConfig(rig, timeout=0.2), CONFIG)
    assert sorted(file.name for file in images.iterdir()) == list(NAMES)


def test_fit_live__keeps_images_that_cannot_be_calibrated(tmp_path: Path, images: Path) -> None:
    other_size(images)
    with pytest.raises(
        ValueError, match="expected at least 100 features in every view, got 0 in cam"
    ) as failed:
        fit_live([images], tmp_path / "out", LiveConfig(timeout=0.2), CONFIG)
    assert (
        f"The images are in {tmp_path / 'out' / 'capture'}: calibrate them with"
        in failed.value.__notes__[0]
    )
    assert (tmp_path / "out" / "capture" / "cam0" / "0000.png").exists()


def test_fit_live__can_be_started_again_after_a_full_disk(
    tmp_path: Path, rig: Path, images: Path
) -> None:
    write(images, 0)
    largest, least = (
        end(file.stat().st_size for file in images.rglob("*.png")) for end in (max, min)
    )
    assert (rig / "sparse" / "0" / "points3D.txt").stat().st_size > largest
    live = LiveConfig(rig, timeout=0.2)
    full = "check that its folder is writable and the disk has room"
    for limit in (largest, least - 1):  # the calibration does not fit, then not even the images
        with pytest.raises(OSError, match=full), files_end_at(limit):
            fit_live([images], tmp_path / "out", live, CONFIG)
        assert not (tmp_path / "out").exists()


def test_fit_live__does_not_replace_an_earlier_capture(
    tmp_path: Path, rig: Path, images: Path
) -> None:
    (tmp_path / "out" / "capture").mkdir(parents=True)
    with pytest.raises(FileExistsError, match="got that of an earlier fit; choose another folder"):
        fit_live([images], tmp_path / "out", LiveConfig(rig), CONFIG)
    with pytest.raises(
        FileNotFoundError, match="expected a calibrated capture of the cameras, found none"
    ):
        fit_live([images], tmp_path / "new", LiveConfig(tmp_path / "nowhere"), CONFIG)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"without": ("cam0",)},
            r"`without` must name cameras of a calibration, got cam0 and no calibration",
        ),
        (
            {"calibration": Path("RIG"), "without": ("cam7",)},
            "`without` must name cameras of cam0, cam1, .*, got cam7",
        ),
        ({"downscale": 0.5}, "`downscale` must be at least 1, got 0.5"),
        ({"frames": 0}, "`frames` must be at least 1, got 0"),
        ({"seconds": 0.0}, "`seconds` must be above 0, got 0.0"),
        ({"fps": -1.0}, "`fps` must be above 0, got -1.0"),
        ({"warm_up": -1.0}, "`warm_up` must be at least 0, got -1.0"),
        ({"timeout": 0.0}, "`timeout` must be above 0, got 0.0"),
    ],
)
def test_fit_live__refuses_settings_out_of_range(
    tmp_path: Path, rig: Path, changes: dict[str, Any], message: str
) -> None:
    changes = {name: rig if value == Path("RIG") else value for name, value in changes.items()}
    with pytest.raises(ValueError, match=message):
        fit_live([0], tmp_path / "out", LiveConfig(**changes))
