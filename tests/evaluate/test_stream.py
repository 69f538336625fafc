"""Streams played and judged: pictures rendered from the stream's own Gaussians are the recording."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from morgs_mi.capture import Camera, load_capture, write_colmap, write_video
from morgs_mi.capture.truth import Truth, save_truth
from morgs_mi.codec.container import Packet, StreamReader, StreamWriter
from morgs_mi.codec.gaussians import decode_gaussians, keyframe_packet, residual_packet
from morgs_mi.evaluate.judge import evaluate_stream
from morgs_mi.evaluate.pictures import as_picture
from morgs_mi.evaluate.stream import (
    channel_picture,
    find_camera,
    open_stream,
    render_stream,
    truth_on,
)
from morgs_mi.gaussians.gaussians import Gaussians
from morgs_mi.render.rasterize import rasterize

WIDTH, HEIGHT, DISTANCE, STEP, FRAMES = 40, 30, 4.0, 0.05, 3
CAMERAS = [
    Camera.look_at((0, 0, -DISTANCE), (0, 0, 0), (0, -1, 0), 50, WIDTH, HEIGHT, "cam0"),
    Camera.look_at((0.5, 0, -DISTANCE), (0.5, 0, 0), (0, -1, 0), 50, WIDTH, HEIGHT, "cam1"),
]
# Pixels per frame of a step along x in a plane that is parallel to both images.
PIXELS = CAMERAS[0].K[0, 0] * STEP / DISTANCE


def moved(frame: int, confidence: bool = True) -> Gaussians:
    """Five splats in the plane z = 0 that have gone `frame` steps along x."""
    rng = np.random.default_rng(0)
    means = np.float32(rng.uniform(-1, 1, (5, 3)) * (1, 1, 0) + (frame * STEP, 0, 0))
    sh = np.float32(rng.uniform(-1, 1.5, (5, 1, 3)))
    more = {"logit_confidence": np.zeros(5, np.float32)} if confidence else {}
    return Gaussians.from_activated(means, np.full((5, 3), 0.2), np.tile([1, 0, 0, 0], (5, 1)), [0.9] * 5, sh, **more)


def stream(path: Path, metadata: dict, confidence: bool = True) -> list[Packet]:
    """Write the splats' stream and return its packets."""
    first = keyframe_packet(moved(0, confidence), 0)
    state, packets = decode_gaussians(None, first), [first]
    for frame in range(1, FRAMES):
        packets.append(residual_packet(state, moved(frame, confidence), frame))
        state = decode_gaussians(state, packets[-1])
    with StreamWriter(path, CAMERAS, 25, metadata) as writer:
        for packet in packets:
            writer.write(packet)
    return packets


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording, its truth and its stream; every picture is the stream's own."""
    folder = tmp_path_factory.mktemp("clip")
    write_colmap(folder / "capture" / "sparse", CAMERAS)
    for camera in CAMERAS:
        images = [rasterize(moved(t), camera) for t in range(FRAMES)]
        write_video(folder / "capture" / camera.name, [as_picture(np.array(i.color)) for i in images], 25)
        for t, image in enumerate(images):
            seen = np.array(image.alpha)[..., 0] > 0
            motion = seen[..., None] * np.float32([PIXELS, 0]) * (t > 0)
            empty = np.zeros((HEIGHT, WIDTH), np.int32)
            save_truth(folder / "capture" / "truth", camera.name, t, Truth(motion, empty, empty, seen))
    about = {"capture": str(folder / "capture"), "downscale": 1, "test_view": 0}
    stream(folder / "stream.morgs", about)
    rows = [{"frame": t, "seconds": 3.0 - t} for t in range(FRAMES)]
    (folder / "report.json").write_text(json.dumps({"frames": rows}))
    return folder


def test_a_stream_of_the_recording_itself_has_no_error(clip: Path) -> None:
    result = evaluate_stream(clip)
    assert result["held_out"]
    assert list(result["views"]) == ["cam0"]
    assert result["psnr"] == {"mean": np.inf, "first": np.inf, "last": np.inf}
    assert result["ssim"]["mean"] == pytest.approx(1)
    # Residuals of float32 coordinates near 1 leave a displacement of 0.05 good to 1e-7: 1e-6 px.
    assert result["motion_error"] == pytest.approx(0, abs=1e-5)
    assert result["motion_error_still"] == 0
    assert result["true_motion_moving"] == pytest.approx(PIXELS)
    assert np.isnan(result["frames"][0]["motion_error"]), "the first frame moves from nowhere"
    assert (result["seconds"]["first"], result["seconds"]["per_later_frame"]) == (3.0, 1.5)


def test_bytes_are_those_of_the_file(clip: Path) -> None:
    result = evaluate_stream(clip / "stream.morgs")
    packets = [row["num_bytes"] for row in result["frames"]]
    assert [row["kind"] for row in result["frames"]] == ["keyframe", "residual", "residual"]
    assert result["bytes"]["file"] == (clip / "stream.morgs").stat().st_size
    assert result["bytes"]["header"] + sum(packets) == result["bytes"]["file"]
    assert result["bytes"]["per_keyframe"] == packets[0]
    assert result["bytes"]["per_residual"] == np.mean(packets[1:])


def test_without_a_held_out_view_the_training_views_are_judged(clip: Path, tmp_path: Path) -> None:
    stream(tmp_path / "s.morgs", {"test_view": None})
    with pytest.raises(ValueError, match="its header names no capture"):
        evaluate_stream(tmp_path / "s.morgs")
    result = evaluate_stream(tmp_path / "s.morgs", clip / "capture")
    assert not result["held_out"]
    assert {name: score["psnr"] for name, score in result["views"].items()} == {"cam0": np.inf, "cam1": np.inf}
    assert result["frames"][0]["seconds"] is None


def test_a_wrong_motion_is_an_error_where_things_move(clip: Path, tmp_path: Path) -> None:
    """A stream of keyframes alone carries no motion: none is judged. One that stands still errs by the truth."""
    state = decode_gaussians(None, keyframe_packet(moved(1), 0))
    with StreamWriter(tmp_path / "s.morgs", CAMERAS, 25, {"test_view": 0}) as writer:
        writer.write(keyframe_packet(state, 0))
        writer.write(residual_packet(state, state, 1))
        writer.write(keyframe_packet(state, 2))
    result = evaluate_stream(tmp_path / "s.morgs", clip / "capture")
    assert result["frames"][1]["motion_error_moving"] == pytest.approx(PIXELS)
    assert np.isnan(result["frames"][2]["motion_error"])
    assert result["frames"][0]["psnr"] < result["frames"][1]["psnr"] == np.inf


def test_truth_on_a_coarser_grid(clip: Path) -> None:
    small = load_capture(clip / "capture", downscale=2)
    full, half = (truth_on(small, c, 1) for c in (CAMERAS[0], small.cameras[0]))
    assert full is not None
    assert half is not None
    np.testing.assert_array_equal(half.mask, full.mask[1::2, 1::2])
    np.testing.assert_allclose(half.motion, full.motion[1::2, 1::2] / 2)
    assert truth_on(small, CAMERAS[0], FRAMES) is None


def test_a_downscaled_fit_is_judged_at_its_own_size(clip: Path, tmp_path: Path) -> None:
    small = load_capture(clip / "capture", downscale=1.7)
    with StreamWriter(
        tmp_path / "s.morgs", small.cameras, 25, {"test_view": 0, "downscale": small.downscale}
    ) as writer:
        writer.write(keyframe_packet(moved(0), 0))
    # The recording was averaged down, the render was not: near, not equal.
    assert evaluate_stream(tmp_path / "s.morgs", clip / "capture")["psnr"]["mean"] > 20


def test_every_carried_channel_is_rendered(clip: Path, tmp_path: Path) -> None:
    reader = open_stream(clip)
    frames = list(render_stream(reader, find_camera(reader, 1)))
    assert [index for index, _ in frames] == list(range(FRAMES))
    shapes = {name: image.shape for name, image in frames[0][1].items()}
    assert shapes == {n: (HEIGHT, WIDTH, k) for n, k in (("color", 3), ("motion", 2), ("depth", 1), ("confidence", 1))}
    assert all(channel_picture(n, i).shape == (HEIGHT, WIDTH, 3) for n, i in frames[0][1].items())
    stream(tmp_path / "s.morgs", {}, confidence=False)
    assert "confidence" not in next(render_stream(open_stream(tmp_path / "s.morgs"), CAMERAS[0]))[1]


@pytest.mark.parametrize(("camera", "name"), [(1, "cam1"), ("1", "cam1"), ("cam0", "cam0")])
def test_cameras_by_index_and_name(clip: Path, camera: int | str, name: str) -> None:
    assert find_camera(open_stream(clip), camera).name == name


@pytest.mark.parametrize("camera", [2, -1, "7", "-1", "cam7", ""])
def test_cameras_that_are_not_there(clip: Path, camera: int | str) -> None:
    with pytest.raises(ValueError, match=r"index in 0..1 or one of cam0, cam1, got"):
        find_camera(open_stream(clip), camera)


def test_a_stream_that_does_not_fit_the_capture(clip: Path, tmp_path: Path) -> None:
    write_colmap(tmp_path / "sparse", CAMERAS[:1])
    write_video(tmp_path / "cam0", [np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * FRAMES, 25)
    with pytest.raises(ValueError, match=r"expected the cameras that .* was fitted to"):
        evaluate_stream(clip, tmp_path)
    with StreamWriter(tmp_path / "late.morgs", CAMERAS, 25) as writer:
        assert isinstance(StreamReader(tmp_path / "late.morgs"), StreamReader)
        with pytest.raises(ValueError, match="got a header alone"):
            evaluate_stream(tmp_path / "late.morgs", clip / "capture")
        writer.write(keyframe_packet(moved(0), FRAMES))
    with pytest.raises(ValueError, match="expected consecutive frames out of the 3 of"):
        evaluate_stream(tmp_path / "late.morgs", clip / "capture")
