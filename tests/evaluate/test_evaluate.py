"""Evaluation of streams of recordings that were rendered from the same Gaussians."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.fingerprint import image_fingerprints
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.cli.main import main
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import decode, keyframe_packet, reemitted_keyframe, residual_packet
from morgs_mi.core.color_space import SH_C0, TRANSFER, decode_light, display_image
from morgs_mi.evaluate.comparison import nearest_views
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.evaluate.lpips import Lpips
from morgs_mi.evaluate.measures import REGIONS
from morgs_mi.evaluate.metrics import psnr, psnr_mu
from morgs_mi.evaluate.tables import evaluation_summary
from morgs_mi.io.exr import write_exr
from morgs_mi.io.video_writer import write_video
from morgs_mi.render.rasterize import rasterize
from tests.scenes.cameras import arc, look_at_cameras
from tests.scenes.moving_splats import (
    CAMERAS,
    EXACT,
    FRAMES,
    HEIGHT,
    PIXELS,
    WIDTH,
    moved,
    write_stream,
)
from tests.scenes.tiny_network import squared_difference


def evaluated(clip, tmp_path, *packets):
    """Return the evaluation of a stream of packets, with the first view held out."""
    with StreamWriter(tmp_path / "s.morgs", CAMERAS, 25, {"test_view": 0}) as writer:
        for packet in packets:
            writer.write(packet)
    return evaluate_stream(tmp_path / "s.morgs", clip / "capture")


def test_evaluate_stream__finds_no_error_in_the_stream_of_the_recording(fitted_clip):
    result = evaluate_stream(fitted_clip)
    assert result.held_out
    assert list(result.views) == ["cam0"]
    assert [row.scores.psnr for row in (result, result.frames[0], result.frames[-1])] == [
        np.inf
    ] * 3
    # Residuals of float32 coordinates near 1 store a displacement of 0.05 to 1e-7: 1e-6 px.
    assert result.scores.motion_error == pytest.approx(0, abs=1e-5)
    assert result.scores.motion_error_still == 0
    assert result.scores.true_motion_moving == pytest.approx(PIXELS)
    assert np.isnan(result.frames[0].scores.motion_error), "the first frame has no motion"
    assert (result.seconds.first, result.seconds.per_later_frame) == (3.0, 1.5)
    assert result.regions == "true masks"
    assert result.scores.psnr_moving == result.scores.psnr_still == np.inf
    assert result.scores.ssim_moving == result.scores.ssim_still == pytest.approx(1)
    assert result.scores.delta_e_moving == result.scores.delta_e_still == 0
    assert result.variation.render == pytest.approx(result.variation.input)
    assert 0 < result.variation.still_share < 1
    assert np.isnan(result.psnr_slope), "there is no line through infinite values"


def test_evaluate_stream__names_frames_that_were_fitted_without_images(fitted_clip, capsys):
    report = fitted_clip / "report.json"
    text = report.read_text()
    rows = json.loads(text)["frames"]
    rows[1]["missing_views"] = ["cam1"]
    report.write_text(json.dumps({"frames": rows}))
    try:
        assert main(["eval", str(fitted_clip)]) == 0
    finally:
        report.write_text(text)
    assert "frames 1 were fitted without any image" in capsys.readouterr().err


def test_evaluate_stream__refuses_another_take_with_the_same_first_frame(fitted_clip):
    report = fitted_clip / "report.json"
    text = report.read_text()
    frames = load_capture(fitted_clip / "capture").partial_frames()
    rows = json.loads(text)["frames"]
    for row, frame in zip(rows, frames, strict=True):
        row["fingerprints"] = list(image_fingerprints(frame.images))
    try:
        report.write_text(json.dumps({"frames": rows}))
        evaluate_stream(fitted_clip)
        # One image was missing in the fit, another one was a different image.
        rows[2]["fingerprints"] = ["", "00000000"]
        report.write_text(json.dumps({"frames": rows}))
        with pytest.raises(ValueError, match=r"got other images in frame 2; .*--any-recording"):
            evaluate_stream(fitted_clip)
        evaluate_stream(fitted_clip, any_recording=True)
    finally:
        report.write_text(text)


def test_evaluate_stream__uses_all_training_views_without_a_held_out_view(fitted_clip, tmp_path):
    write_stream(tmp_path / "s.morgs", {"test_view": None})
    with pytest.raises(FileNotFoundError, match="expected the path of its capture"):
        evaluate_stream(tmp_path / "s.morgs")
    result = evaluate_stream(tmp_path / "s.morgs", fitted_clip / "capture")
    assert not result.held_out
    assert {name: scores.psnr for name, scores in result.views.items()} == {
        "cam0": np.inf,
        "cam1": np.inf,
    }
    assert result.frames[0].seconds is None


def test_evaluate_stream__reports_a_wrong_motion_in_the_moving_region(fitted_clip, tmp_path):
    """A keyframe has no motion error. The error of zero motion is the true motion."""
    state = decode(None, keyframe_packet(moved(1), 0, CAMERAS, EXACT))
    still = residual_packet(state, state.gaussians)
    again = keyframe_packet(moved(1), 2, CAMERAS, EXACT)
    result = evaluated(fitted_clip, tmp_path, reemitted_keyframe(state), still, again)
    scores = [row.scores for row in result.frames]
    assert scores[1].motion_error_moving == pytest.approx(PIXELS)
    assert np.isnan(scores[2].motion_error)
    assert scores[0].psnr < scores[1].psnr == np.inf


def test_evaluate_stream__compares_3d_motion_of_gaussians_in_both_frames_only(
    fitted_clip, tmp_path
):
    """The first splat is removed and one with a wrong motion is added: the motion of the others is
    still exact.
    """
    state = decode(None, keyframe_packet(moved(0), 0, CAMERAS, EXACT))
    moved_gaussians = moved(1).select([1, 2, 3, 4, 0])
    rows = np.array([1, 2, 3, 4, -1])
    change = residual_packet(state, moved_gaussians, rows, CAMERAS, EXACT)
    result = evaluated(fitted_clip, tmp_path, reemitted_keyframe(state), change).motion_3d
    assert 0 < result.num_gaussians <= 4
    assert result.relative_error < 1e-3


@pytest.mark.usefixtures("small_images")
def test_evaluate_stream__uses_the_size_of_a_downscaled_fit(fitted_clip, tmp_path):
    small = load_capture(fitted_clip / "capture", downscale=1.7)
    with StreamWriter(
        tmp_path / "s.morgs", small.cameras, 25, {"test_view": 0, "downscale": small.downscale}
    ) as writer:
        writer.write(keyframe_packet(moved(0), 0))
    # The recording was averaged down, the rendering was not: similar, not equal.
    assert evaluate_stream(tmp_path / "s.morgs", fitted_clip / "capture").scores.psnr > 20


def test_evaluate_stream__scores_the_held_out_view_with_matched_colours_too(fitted_clip, tmp_path):
    bright = moved(0).sh_coeffs + 0.5 / SH_C0
    darker = replace(moved(0), sh_coeffs=0.9 * bright - 0.5 / SH_C0)
    result = evaluated(fitted_clip, tmp_path, keyframe_packet(darker, 0, CAMERAS, EXACT))
    assert result.scores.psnr_matched > result.scores.psnr + 10
    assert f"{result.scores.psnr_matched:.2f} dB after the gain and bias" in " ".join(
        evaluation_summary(result)
    )


def test_evaluate_stream__copies_the_nearest_training_view_in_place_of_a_held_out_one(
    fitted_clip, tmp_path
):
    result = evaluate_stream(fitted_clip)
    frames = load_capture(fitted_clip / "capture").frames()
    floors = [psnr(frame.images[1], frame.images[0]) for frame in frames]
    assert [row.scores.psnr_nearest for row in result.frames] == pytest.approx(floors)
    write_stream(tmp_path / "s.morgs", {"test_view": None})
    result = evaluate_stream(tmp_path / "s.morgs", fitted_clip / "capture")
    assert np.isnan(result.scores.psnr_nearest)


def test_nearest_views__have_the_least_angle_from_the_scene():
    cameras = look_at_cameras(arc(np.deg2rad((0, 40, 50, 90)), 4), 40)
    rig = SimpleNamespace(points=np.zeros((1, 3)), train_views=(0, 1, 3), test_views=(2,))
    assert nearest_views(rig, cameras) == {2: 1}


def test_evaluate_stream__reports_the_overlap_of_confidence_and_true_mask(fitted_clip, tmp_path):
    """The clip's confidence of 0.5 is never above the threshold; a confidence of 1 is rendered as
    the alpha.
    """
    assert evaluate_stream(fitted_clip).scores.confidence_iou == 0
    write_stream(tmp_path / "s.morgs", {"test_view": 0}, logit=20)
    alphas = [np.array(rasterize(moved(t), CAMERAS[0]).alpha) for t in range(1, FRAMES)]
    expected = np.mean([(alpha > 0.5).sum() / (alpha > 0).sum() for alpha in alphas])
    overlap = evaluate_stream(tmp_path / "s.morgs", fitted_clip / "capture").scores.confidence_iou
    assert overlap == pytest.approx(expected)
    assert overlap > 0


def test_evaluate_stream__uses_the_recorded_change_as_regions_without_truth(fitted_clip, tmp_path):
    shutil.copytree(
        fitted_clip / "capture", tmp_path / "capture", ignore=shutil.ignore_patterns("truth")
    )
    result = evaluate_stream(fitted_clip, tmp_path / "capture")
    assert result.regions == "recorded change"
    assert result.scores.psnr_moving == result.scores.psnr_still == np.inf
    assert np.isnan(result.frames[0].scores.delta_e_moving), "no frame before it"
    assert np.isnan(result.motion_3d.num_gaussians)
    assert np.isnan(result.scores.confidence_iou)


def test_evaluate_stream__reports_lpips_if_a_network_is_given(fitted_clip, tmp_path):
    write_stream(tmp_path / "s.morgs", {"test_view": 0}, shift=1)
    network = squared_difference(tmp_path / "net.onnx", HEIGHT, WIDTH)
    result = evaluate_stream(tmp_path / "s.morgs", fitted_clip / "capture", lpips=Lpips(network))
    # The network's distance is the squared error on a scale twice as wide; the mean over frames is
    # a mean of errors.
    errors = [4 * 10 ** (-row.scores.psnr_moving / 10) for row in result.frames]
    assert result.scores.lpips_moving == pytest.approx(np.mean(errors), rel=1e-5)


def test_evaluation__as_dict_holds_scores_drift_and_bytes(fitted_clip, tmp_path):
    file = tmp_path / "s.morgs"
    write_stream(file, {"test_view": 0}, shift=1)
    result = evaluate_stream(file, fitted_clip / "capture")
    report = result.as_dict()
    scores = {name + region for name in ("psnr", "ssim", "delta_e", "lpips") for region in REGIONS}
    assert scores <= report["frames"][1].keys() & report.keys()
    first, _, last = (row["psnr"] for row in report["frames"])
    assert report["psnr"] == {"mean": result.scores.psnr, "first": first, "last": last}
    assert result.psnr_slope == pytest.approx((last - first) / 2)
    assert (report["num_frames"], report["complete"], report["held_out"]) == (FRAMES, True, True)
    key, *changes = (row["num_bytes"] for row in report["frames"])
    sizes = report["bytes"]
    assert sizes["file"] == sizes["overhead"] + key + sum(changes) == file.stat().st_size
    assert (sizes["per_keyframe"], sizes["per_residual"]) == (key, np.mean(changes))


def test_evaluate_stream__refuses_a_stream_of_another_capture(fitted_clip, tmp_path):
    write_colmap(tmp_path / "sparse", CAMERAS[:1])
    write_video(tmp_path / "cam0", [np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * FRAMES, 25)
    message = "expected the recording that .* was fitted to, got the cameras"
    with pytest.raises(ValueError, match=message):
        evaluate_stream(fitted_clip, tmp_path)
    with StreamWriter(tmp_path / "late.morgs", CAMERAS, 25) as writer:
        for frames in (r"\[\]", r"\[3\]"):
            with pytest.raises(ValueError, match=rf"got \d frames, not all of {frames}"):
                evaluate_stream(tmp_path / "late.morgs", fitted_clip / "capture")
            writer.write(keyframe_packet(moved(0), FRAMES))


def test_evaluate_stream__compares_the_light_of_an_hdr_recording(tmp_path):
    write_colmap(tmp_path / "capture" / "sparse", CAMERAS)
    for camera in CAMERAS:
        (tmp_path / "capture" / camera.name).mkdir()
        for t in range(FRAMES):
            light = 2 * decode_light(np.array(rasterize(moved(t), camera).color))
            planes = {name: light[..., k] for k, name in enumerate("RGB")}
            write_exr(tmp_path / "capture" / camera.name / f"{t:04d}.exr", planes)
    transfer = {"name": TRANSFER, "display_exposure": -1}
    write_stream(tmp_path / "s.morgs", {"test_view": 0, "transfer": transfer})
    scores = evaluate_stream(tmp_path / "s.morgs", tmp_path / "capture").scores
    color = np.array(rasterize(moved(0), CAMERAS[0]).color)
    light, truth = (gain * decode_light(color) for gain in (1, 2))
    assert truth.max() > 1
    assert scores.psnr_mu == pytest.approx(psnr_mu(light, truth), abs=0.5)
    shown = psnr(display_image(light, -1), display_image(truth, -1))
    assert scores.psnr == pytest.approx(shown, abs=0.5)
