"""Streams judged: pictures rendered from the stream's own Gaussians are the recording."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import decode, keyframe_packet, reemitted_keyframe, residual_packet
from morgs_mi.codec.reader import StreamReader
from morgs_mi.evaluate.evaluate import IMAGE_SCORES, evaluate_stream
from morgs_mi.evaluate.lpips import Lpips
from morgs_mi.io.video_writer import write_video
from morgs_mi.render.rasterize import rasterize
from tests.evaluate.tiny_onnx import squared_difference
from tests.moving_splats import CAMERAS, EXACT, FRAMES, HEIGHT, PIXELS, STEP, WIDTH, moved, write_stream


def test_a_stream_of_the_recording_itself_has_no_error(fitted_clip: Path) -> None:
    result = evaluate_stream(fitted_clip)
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


def test_bytes_are_those_of_the_file(fitted_clip: Path) -> None:
    result = evaluate_stream(fitted_clip / "stream.morgs")
    packets = [row["num_bytes"] for row in result["frames"]]
    assert [row["kind"] for row in result["frames"]] == ["keyframe", "residual", "residual"]
    assert result["bytes"]["file"] == (fitted_clip / "stream.morgs").stat().st_size
    assert result["bytes"]["overhead"] + sum(packets) == result["bytes"]["file"]
    assert result["bytes"]["per_keyframe"] == packets[0]
    assert result["bytes"]["per_residual"] == np.mean(packets[1:])


def test_without_a_held_out_view_the_training_views_are_judged(fitted_clip: Path, tmp_path: Path) -> None:
    write_stream(tmp_path / "s.morgs", {"test_view": None})
    with pytest.raises(ValueError, match="its header names no capture"):
        evaluate_stream(tmp_path / "s.morgs")
    result = evaluate_stream(tmp_path / "s.morgs", fitted_clip / "capture")
    assert not result["held_out"]
    assert {name: score["psnr"] for name, score in result["views"].items()} == {"cam0": np.inf, "cam1": np.inf}
    assert result["frames"][0]["seconds"] is None


def test_a_wrong_motion_is_an_error_where_things_move(fitted_clip: Path, tmp_path: Path) -> None:
    """A stream of keyframes alone carries no motion: none is judged. One that stands still errs by the truth."""
    state = decode(None, keyframe_packet(moved(1), 0, CAMERAS, EXACT))
    with StreamWriter(tmp_path / "s.morgs", CAMERAS, 25, {"test_view": 0}) as writer:
        writer.write(reemitted_keyframe(state))
        writer.write(residual_packet(state, state.gaussians))
        writer.write(keyframe_packet(moved(1), 2, CAMERAS, EXACT))
    result = evaluate_stream(tmp_path / "s.morgs", fitted_clip / "capture")
    assert result["frames"][1]["motion_error_moving"] == pytest.approx(PIXELS)
    assert np.isnan(result["frames"][2]["motion_error"])
    assert result["frames"][0]["psnr"] < result["frames"][1]["psnr"] == np.inf


def test_only_those_who_live_in_both_frames_are_judged_by_their_motion(fitted_clip: Path, tmp_path: Path) -> None:
    """The first splat dies, and one that moves in no true way is born: the others' motion is still exact."""
    state = decode(None, keyframe_packet(moved(0), 0, CAMERAS, EXACT))
    after = moved(1).select([1, 2, 3, 4, 0])
    with StreamWriter(tmp_path / "s.morgs", CAMERAS, 25, {"test_view": 0}) as writer:
        writer.write(reemitted_keyframe(state))
        writer.write(residual_packet(state, after, np.array([1, 2, 3, 4, -1]), CAMERAS, EXACT))
    result = evaluate_stream(tmp_path / "s.morgs", fitted_clip / "capture")["motion_3d"]
    assert 0 < result["num_gaussians"] <= 4
    assert result["relative_error"] < 1e-3


def test_a_downscaled_fit_is_judged_at_its_own_size(fitted_clip: Path, tmp_path: Path) -> None:
    small = load_capture(fitted_clip / "capture", downscale=1.7)
    with StreamWriter(
        tmp_path / "s.morgs", small.cameras, 25, {"test_view": 0, "downscale": small.downscale}
    ) as writer:
        writer.write(keyframe_packet(moved(0), 0))
    # The recording was averaged down, the render was not: near, not equal.
    assert evaluate_stream(tmp_path / "s.morgs", fitted_clip / "capture")["psnr"]["mean"] > 20


def test_every_score_knows_its_regions(fitted_clip: Path) -> None:
    result = evaluate_stream(fitted_clip)
    assert result["regions"] == "true masks"
    for region in ("_moving", "_still"):
        assert result["psnr" + region] == np.inf
        assert result["ssim" + region] == pytest.approx(1)
        assert result["flip" + region] == result["delta_e" + region] == 0
    assert result["mtv"]["render"] == pytest.approx(result["mtv"]["input"])
    assert 0 < result["mtv"]["still_share"] < 1
    assert np.isnan(result["psnr_slope"]), "there is no line through infinite values"


def test_motion_of_splats_on_a_moving_object_is_judged_in_3d(fitted_clip: Path) -> None:
    motion = evaluate_stream(fitted_clip)["motion_3d"]
    # Some of the five may lie behind pixels that none of them covers enough.
    assert 1 <= motion["num_gaussians"] <= 5
    assert motion["true_length"] == pytest.approx(STEP)
    # float32 coordinates near 1 leave 1e-7 of a step of 0.05.
    assert motion["relative_error"] == pytest.approx(0, abs=1e-5)
    assert motion["length_ratio"] == pytest.approx(1, abs=1e-5)
    assert motion["angle"] == pytest.approx(0, abs=1e-2)


def test_confidence_overlaps_with_the_true_mask(fitted_clip: Path, tmp_path: Path) -> None:
    """The clip's own confidence of one half is nowhere above it; that of sure splats is their alpha."""
    assert evaluate_stream(fitted_clip)["confidence_iou"] == 0
    write_stream(tmp_path / "s.morgs", {"test_view": 0}, logit=20)
    alphas = [np.array(rasterize(moved(t), CAMERAS[0]).alpha) for t in range(1, FRAMES)]
    expected = np.mean([(alpha > 0.5).sum() / (alpha > 0).sum() for alpha in alphas])
    found = evaluate_stream(tmp_path / "s.morgs", fitted_clip / "capture")["confidence_iou"]
    assert found == pytest.approx(expected)
    assert found > 0


def test_without_truth_the_recorded_change_parts_the_regions(fitted_clip: Path, tmp_path: Path) -> None:
    shutil.copytree(fitted_clip / "capture", tmp_path / "capture", ignore=shutil.ignore_patterns("truth"))
    result = evaluate_stream(fitted_clip, tmp_path / "capture")
    assert result["regions"] == "recorded change"
    assert result["psnr_moving"] == result["psnr_still"] == np.inf
    assert result["frames"][0]["flip_moving"] != result["frames"][0]["flip_moving"], "no frame before it"
    assert result["motion_3d"] == {}
    assert np.isnan(result["confidence_iou"])


def test_lpips_is_told_where_a_network_is_given(fitted_clip: Path, tmp_path: Path) -> None:
    write_stream(tmp_path / "s.morgs", {"test_view": 0}, shift=1)
    network = squared_difference(tmp_path / "net.onnx", HEIGHT, WIDTH)
    result = evaluate_stream(tmp_path / "s.morgs", fitted_clip / "capture", lpips=Lpips(network))
    # The network's distance is the squared error on a scale twice as wide; the mean over frames is that of errors.
    errors = [4 * 10 ** (-row["psnr_moving"] / 10) for row in result["frames"]]
    assert result["lpips_moving"] == pytest.approx(np.mean(errors), rel=1e-5)
    single = squared_difference(tmp_path / "single.onnx", HEIGHT, WIDTH, spatial=False)
    result = evaluate_stream(tmp_path / "s.morgs", fitted_clip / "capture", lpips=Lpips(single))
    assert result["lpips"] > 0
    assert np.isnan(result["lpips_moving"])


def test_drift_is_the_slope_of_psnr(fitted_clip: Path, tmp_path: Path) -> None:
    write_stream(tmp_path / "s.morgs", {"test_view": 0}, shift=1)
    result = evaluate_stream(tmp_path / "s.morgs", fitted_clip / "capture")
    first, _, last = (row["psnr"] for row in result["frames"])
    assert result["psnr_slope"] == pytest.approx((last - first) / 2)
    scores = {name + region for name in IMAGE_SCORES for region in ("", "_moving", "_still")}
    assert scores <= result["frames"][0].keys()


def test_a_stream_that_does_not_fit_the_capture(fitted_clip: Path, tmp_path: Path) -> None:
    write_colmap(tmp_path / "sparse", CAMERAS[:1])
    write_video(tmp_path / "cam0", [np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * FRAMES, 25)
    with pytest.raises(ValueError, match=r"expected the cameras that .* was fitted to"):
        evaluate_stream(fitted_clip, tmp_path)
    with StreamWriter(tmp_path / "late.morgs", CAMERAS, 25) as writer:
        assert isinstance(StreamReader(tmp_path / "late.morgs"), StreamReader)
        with pytest.raises(ValueError, match="got a header alone"):
            evaluate_stream(tmp_path / "late.morgs", fitted_clip / "capture")
        writer.write(keyframe_packet(moved(0), FRAMES))
    with pytest.raises(ValueError, match="expected consecutive frames out of the 3 of"):
        evaluate_stream(tmp_path / "late.morgs", fitted_clip / "capture")
