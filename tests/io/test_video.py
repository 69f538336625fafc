"""Videos and folders of images: round trips, order, and messages for broken files."""

import re
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi.io.clip_readers import open_frames
from morgs_mi.io.video import FAR, VideoReader
from morgs_mi.io.video_writer import FFV1, H264, VP9, write_video
from tests.scenes.captures import write_timed_video
from tests.scenes.full_disk import files_end_at

HEIGHT = 32
WIDTH = 48
COUNT = 6


def clip(height=HEIGHT, width=WIDTH, count=COUNT):
    return list(
        np.random.default_rng(0).integers(0, 256, (count, height, width, 3), dtype=np.uint8)
    )


def smooth_clip(count=COUNT, speed=1):
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return [
        np.stack([120 + 80 * np.sin((x + speed * t) / 9), 100 + 2 * y, 90 + x], -1).astype(np.uint8)
        for t in range(count)
    ]


@pytest.mark.parametrize("name", ["cam.mp4", "cam.mkv", "cam"])
def test_write_video__is_lossless_by_default(tmp_path, name):
    write_video(tmp_path / name, clip(), fps=12.5)
    reader = open_frames(tmp_path / name)
    assert (reader.num_frames, reader.width, reader.height) == (COUNT, WIDTH, HEIGHT)
    assert reader.fps == (12.5 if "." in name else None)
    assert reader.num_held == COUNT
    assert_array_equal(list(reader.frames()), clip())
    assert_array_equal(list(reader.frames(2, 5)), clip()[2:5])
    assert [f.name for f in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(("name", "codec"), [("cam.mp4", H264), ("cam.webm", VP9)])
def test_write_video__lossy_codecs_preserve_colours(tmp_path, name, codec):
    write_video(tmp_path / name, smooth_clip(), 30, codec)
    got = np.array(list(VideoReader.open(tmp_path / name).frames()), float)
    # 4:2:0 chroma; BT.709 read as BT.601 gives 33 dB, red and blue exchanged 13 dB.
    assert 10 * np.log10(255**2 / np.mean((got - smooth_clip()) ** 2)) > 36


def long_video(path, codec):
    """Write a clip in which every frame differs, with frames that refer to later ones."""
    options = {"bf": "2", "g": "12"}
    write_timed_video(path, smooth_clip(160, 3), range(0, 6400, 40), codec, options=options)
    return path


@pytest.mark.parametrize("name", ["a.mp4 libx264", "a.mkv mpeg2video", "a.ts mpeg2video"])
def test_pick__searches_the_frames_that_decoding_from_the_start_reaches(tmp_path, name):
    file, codec = name.split()
    reader = VideoReader.open(long_video(tmp_path / file, codec))
    whole = list(reader.frames())
    for start in (*range(98, 125, 2), 159):
        assert_array_equal(list(reader.frames(start, start + 3)), whole[start : start + 3])
    assert 0 < next(reader._numbered(150))[0] <= 150
    late = list(reader.pick([155, 158, 160]))
    assert_array_equal(late[:2], [whole[155], whole[158]])
    assert "it has ended after 160 frames" in str(late[2])


def truncated(path, length):
    path.write_bytes(path.read_bytes()[:length])
    return path


def test_video_reader__yields_the_frames_of_a_truncated_video_and_then_names_the_missing_one(
    tmp_path,
):
    path = tmp_path / "cam.mkv"
    write_video(path, clip(), 30)
    reader = VideoReader.open(truncated(path, path.stat().st_size // 2))
    assert reader.num_frames == COUNT
    frames = []
    with pytest.raises(
        ValueError, match=rf"cam.mkv: frame \d of {COUNT} cannot be decoded.*--frames"
    ):
        frames.extend(reader.frames())
    assert 0 < len(frames) == reader.num_held < COUNT
    assert_array_equal(frames, clip()[: len(frames)])


@pytest.mark.parametrize(
    ("name", "damage", "error", "message"),
    [
        ("cam.mp4", Path.unlink, FileNotFoundError, "cam.mp4: expected a video file, found none"),
        (
            "cam.mp4",
            lambda path: truncated(path, 20),  # within its head
            ValueError,
            r"cam.mp4: expected a video, got \d+ bytes .*\(Invalid data .* truncated",
        ),
        (
            "cam",
            lambda path: [file.unlink() for file in path.iterdir()],
            FileNotFoundError,
            r"cam: expected images \(.png",
        ),
        (
            "cam",
            lambda path: (path / "0002.png").unlink(),
            ValueError,
            "numbered without gaps, got 0001.png followed by 0003.png",
        ),
        (
            "cam",
            lambda path: truncated(path / "0000.png", 20),
            ValueError,
            "0000.png: expected an image, got 20 bytes",
        ),
        (
            "cam",
            lambda path: cv2.imwrite(str(path / "0003.png"), np.zeros((8, 8, 3), np.uint8)),
            ValueError,
            "0003.png: expected 48x32 as in 0000.png, got 8x8",
        ),
    ],
)
def test_open_frames__refuses_bad_input(tmp_path, name, damage, error, message):
    write_video(tmp_path / name, clip(), 30)
    damage(tmp_path / name)
    with pytest.raises(error, match=message):
        list(open_frames(tmp_path / name).frames())


@pytest.mark.parametrize(
    ("name", "codec", "times", "fps", "error"),
    [
        ("cam.mp4", "ffv1", [0, 33, 67, 200, 233, 267], 30, 0),
        ("cam.avi", "mjpeg", [0, 40, 80, 240, 280, 320], 25, 6),
    ],
)
def test_video_reader__has_the_positions_of_a_variable_frame_rate(
    tmp_path, name, codec, times, fps, error
):
    """In AVI files, a recorder writes an empty chunk for each frame that it drops."""
    write_timed_video(tmp_path / name, smooth_clip(), times, codec)
    reader = VideoReader.open(tmp_path / name)
    assert (reader.num_frames, reader.num_held) == (6, 6)
    assert reader.fps == pytest.approx(fps, rel=0.01)
    assert_allclose(reader.positions, [0, 1, 2, 6, 7, 8], atol=0.05)
    for image, expected in zip(reader.frames(), smooth_clip(), strict=True):
        assert np.abs(np.int16(image) - expected).mean() <= error


@pytest.mark.parametrize(
    ("name", "codec", "fps"),
    [
        ("cam.mp4", H264, 29.97),
        ("cam.mkv", FFV1, 24000 / 1001),
        ("cam.mkv", FFV1, 240),
        ("cam.avi", "mpeg4", 29.97),
    ],
)
def test_video_reader__recognises_a_constant_frame_rate(tmp_path, name, codec, fps):
    write_video(tmp_path / name, clip(count=30), fps, codec)
    reader = VideoReader.open(tmp_path / name)
    assert (reader.num_frames, reader.positions) == (30, None)
    assert reader.fps == pytest.approx(fps, rel=1e-3)


KINDS = [
    "a.avi mjpeg",
    "a.m4v libx264",
    "a.mkv libx265",
    "a.mp4 libsvtav1",
    "a.mpg mpeg2video",
    "a.mts libx264",
    "a.ts libx264",
    "a.flv libx264",
    "a.webm libvpx-vp9",
]


@pytest.mark.parametrize("kind", KINDS)
def test_video_reader__reads_the_containers_and_codecs_of_cameras(tmp_path, kind):
    """With frames that refer to later ones where the codec has them."""
    name, codec = kind.split()
    images = [np.full((64, 96, 3), 30 + 12 * t, np.uint8) for t in range(16)]
    write_timed_video(tmp_path / name, images, range(0, 640, 40), codec)
    reader = VideoReader.open(tmp_path / name)
    assert (reader.num_frames, reader.num_held, reader.positions) == (16, 16, None)
    assert reader.fps == pytest.approx(25)
    levels = [frame.mean() for frame in reader.frames()]
    assert_allclose(levels, 30 + 12 * np.arange(16), atol=4)


def test_video_reader__leaves_out_a_broken_frame_and_no_other(tmp_path):
    write_timed_video(tmp_path / "a.avi", smooth_clip(), range(0, 240, 40), "mjpeg")
    data = (tmp_path / "a.avi").read_bytes()
    at = [match.start() for match in re.finditer(b"\xff\xd8\xff", data)]
    (tmp_path / "a.avi").write_bytes(data[: at[2]] + bytes(at[3] - 8 - at[2]) + data[at[3] - 8 :])
    *frames, missing, last = VideoReader.open(tmp_path / "a.avi").pick([0, 1, 2, 5])
    assert "frame 2 of 6 cannot be decoded" in str(missing)
    for image, expected in zip([*frames, last], [0, 1, 5], strict=True):
        assert np.abs(np.int16(image) - smooth_clip()[expected]).mean() < 6


# Rows of matrices that map the pixel (x, y), and what players show.
TURNS = {
    "90": ((0, 1, -1, 0), lambda image: np.rot90(image, -1)),
    "270": ((0, -1, 1, 0), lambda image: np.rot90(image, 1)),
    "mirrored": ((-1, 0, 0, 1), lambda image: image[:, ::-1]),
    "mirrored and turned": ((0, -1, -1, 0), lambda image: np.rot90(image, 2).swapaxes(0, 1)),
}


def displayed(matrix):
    """Return an edit of a stream that gives it a display matrix."""
    a, b, c, d = (round(value * 2**16) for value in matrix)
    return lambda stream: stream.set_display_matrix([a, b, 0, c, d, 0, 0, 0, 2**30])


@pytest.mark.parametrize("turn", TURNS)
def test_video_reader__shows_images_as_players_do(tmp_path, turn):
    matrix, show = TURNS[turn]
    (image,) = clip(count=1)
    write_timed_video(tmp_path / "a.mp4", [image], [0], edit=displayed(matrix))
    reader = VideoReader.open(tmp_path / "a.mp4")
    assert_array_equal(next(reader.frames()), show(image))
    assert (reader.height, reader.width) == show(image).shape[:2]


def test_video_reader__refuses_other_angles(tmp_path):
    root = np.sqrt(0.5)
    edit = displayed((root, root, -root, root))
    write_timed_video(tmp_path / "a.mp4", clip(count=1), [0], edit=edit)
    with pytest.raises(ValueError, match=r"a.mp4: expected a display matrix that .*; convert"):
        VideoReader.open(tmp_path / "a.mp4")


@pytest.mark.parametrize("name", ["a.avi", "a.mp4", "a.mkv", "a.mov"])
def test_video_reader__has_frames_that_refer_to_later_ones_in_order(tmp_path, name):
    """AVI stores the times of decoding alone."""
    count = FAR + 30
    images = [np.full((32, 48, 3), 20, np.uint8) for _ in range(count)]
    for t, image in enumerate(images):
        image[:, :24] += np.uint8(16 * (t // 12))
        image[:, 24:] += np.uint8(16 * (t % 12))
    write_timed_video(tmp_path / name, images, range(0, 40 * count, 40), "libx264")
    reader = VideoReader.open(tmp_path / name)
    assert (reader.num_frames, reader.num_held, reader.positions) == (count, count, None)
    for start in (0, 3, FAR + 5):
        frames = np.array(list(reader.frames(start)), float)
        levels = np.rint((frames.reshape(-1, 32, 2, 24, 3).mean(axis=(1, 3, 4)) - 20) / 16)
        assert_array_equal(levels @ [12, 1], np.arange(start, count))


def test_video_reader__takes_the_first_track_and_names_the_others(tmp_path):
    tracks = {"COLOR": 90, "INFRARED": 30, "DEPTH": 10}
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        for title in tracks:
            stream = container.add_stream("ffv1", rate=25, width=48, height=32, pix_fmt="bgr0")
            stream.metadata["title"] = title
        for stream, value in zip(container.streams.video, tracks.values(), strict=True):
            frame = av.VideoFrame.from_ndarray(np.full((32, 48, 3), value, np.uint8), "rgb24")
            container.mux([*stream.encode(frame), *stream.encode()])
    reader = VideoReader.open(tmp_path / "a.mkv")
    assert [frame[0, 0, 0] for frame in reader.frames()] == [90]
    assert reader.notes == ("the first video track, COLOR, is used, and not INFRARED, DEPTH.",)


def colored(transfer, primaries):
    def edit(stream):
        stream.codec_context.color_trc = transfer
        stream.codec_context.color_primaries = primaries

    return edit


def interlaced(stream):
    stream.codec_context.flags |= av.codec.context.Flags.interlaced_dct
    stream.options = {"x264-params": "tff=1:interlaced=1"}


@pytest.mark.parametrize(
    ("edit", "note"),
    [
        (colored(18, 9), "colours of HLG and BT.2020 are used as those of sRGB"),
        (colored(1, 12), "colours of Display P3"),
        (interlaced, "interlaced: each frame has the rows of two moments"),
        (colored(1, 1), ""),
    ],
)
def test_video_reader__names_properties_that_are_not_used(tmp_path, edit, note):
    write_timed_video(tmp_path / "a.mp4", smooth_clip(), range(0, 240, 40), "libx264", edit=edit)
    notes = VideoReader.open(tmp_path / "a.mp4").notes
    assert [text[: len(note)] for text in notes] == ([note] if note else [])


@pytest.mark.parametrize("text", ["ffconcat version 1.0\nfile 'b.mkv'\n", "#EXTM3U\nb.mkv\n"])
def test_video_reader__opens_no_files_that_a_text_names(tmp_path, text):
    write_video(tmp_path / "b.mkv", clip(), 30)
    (tmp_path / "a.mp4").write_text(text)
    with pytest.raises(ValueError, match=r"a.mp4: expected a video, got \d+ bytes"):
        VideoReader.open(tmp_path / "a.mp4")


def test_video_reader__takes_a_colon_as_part_of_a_path(tmp_path, monkeypatch):
    """In names of recorders, which a program could take for a protocol; written and read."""
    monkeypatch.chdir(tmp_path)
    write_video("12:30:00/a.mkv", clip(), 30)
    assert open_frames("12:30:00/a.mkv").num_frames == COUNT


def test_video_reader__reads_a_video_with_broken_texts(tmp_path):
    write_video(tmp_path / "a.mkv", clip(), 30)
    data = (tmp_path / "a.mkv").read_bytes()
    assert b"ENCODER" in data
    (tmp_path / "a.mkv").write_bytes(data.replace(b"ENCODER", b"ENCO\xc4ER"))
    assert_array_equal(list(VideoReader.open(tmp_path / "a.mkv").frames()), clip())


def test_video_reader__names_an_unknown_codec(tmp_path):
    write_timed_video(tmp_path / "a.mp4", smooth_clip(), range(0, 240, 40), "libx264")
    data = (tmp_path / "a.mp4").read_bytes()
    (tmp_path / "a.mp4").write_bytes(data.replace(b"avc1", b"zzzz"))
    with pytest.raises(ValueError, match="no decoder for its codec"):
        VideoReader.open(tmp_path / "a.mp4")


def test_video_reader__refuses_time_stamps_of_years(tmp_path):
    write_timed_video(tmp_path / "cam.mkv", clip(), [0, 33, 67, 100, 133, 200_000_000])
    with pytest.raises(
        ValueError,
        match=r"cam.mkv: expected 6 frames at .* fps, got times of 2e\+05 s; convert",
    ):
        VideoReader.open(tmp_path / "cam.mkv")


def test_folder_reader__ignores_the_rotation_of_exif(tmp_path):
    jpeg = cv2.imencode(".jpg", np.zeros((16, 32, 3), np.uint8))[1].tobytes()
    # One entry, orientation (0x112) 6: rotated by 90 degrees.
    tiff = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    exif = b"Exif\0\0" + tiff
    (tmp_path / "0.jpg").write_bytes(
        jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:]
    )
    assert cv2.imread(str(tmp_path / "0.jpg")).shape == (32, 16, 3), "OpenCV rotates it by default"
    assert next(open_frames(tmp_path).frames()).shape == (16, 32, 3)


def interrupted():
    yield clip()[0]
    raise KeyboardInterrupt("Ctrl-C")


@pytest.mark.parametrize(
    ("name", "frames", "codec", "error", "message"),
    [
        ("cam.mp4", [], FFV1, ValueError, "at least one frame was expected"),
        ("cam.mp4", clip(31), FFV1, ValueError, "an even width and height of a video, got 48x31"),
        (
            "cam.mp4",
            [clip()[0], clip(30)[0]],
            FFV1,
            ValueError,
            r"frame 1 must be uint8 \[32, 48, 3\] like the first, got uint8 \[30",
        ),
        ("cam.mp4", interrupted(), H264, KeyboardInterrupt, "Ctrl-C"),
        (
            "cam.mp4",
            clip(2, 16386, 1),
            H264,
            ValueError,
            "16384 pixels .* got 16386x2; write small",
        ),
        ("cam.mp4", clip(), "h263x", ValueError, "expected PyAV with the encoder h263x, got one"),
    ],
)
def test_write_video__leaves_nothing_on_failure(tmp_path, name, frames, codec, error, message):
    with pytest.raises(error, match=message):
        write_video(tmp_path / name, frames, 30, codec)
    assert not list(tmp_path.iterdir())


def test_write_video__leaves_the_old_file_on_failure(tmp_path):
    for name, frames, error in (("cam.mp4", [], ValueError), ("cam", clip(), FileExistsError)):
        write_video(tmp_path / name, clip(), 30)
        with pytest.raises(error, match=r"at least one frame|cam: expected a new folder"):
            write_video(tmp_path / name, frames, 30)
        assert open_frames(tmp_path / name).num_frames == COUNT


@pytest.mark.parametrize("room", [0, 100, 3000])
@pytest.mark.parametrize(
    ("name", "codec"),
    [("cam.mp4", FFV1), ("cam.mkv", FFV1), ("cam.mp4", H264), ("cam.webm", VP9), ("cam", FFV1)],
)
def test_write_video__raises_and_leaves_nothing_on_a_full_disk(tmp_path, name, codec, room):
    """At its first byte, in its head and in its images."""
    with pytest.raises(OSError, match=name), files_end_at(room):
        write_video(tmp_path / name, clip(), 30, codec)
    assert not list(tmp_path.iterdir())
