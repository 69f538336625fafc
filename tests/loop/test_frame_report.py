"""The report of a frame: the PSNR of its training views, and what the status names."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from morgs_mi.core.view import View
from morgs_mi.fit.fit_config import LearningRates
from morgs_mi.fit.view import mean_psnr
from morgs_mi.loop.first_frame import fit_gaussians
from morgs_mi.render.render_config import RenderConfig
from morgs_mi.stream_loop import StreamLoop
from tests.quick import quick
from tests.scenes.ball import ball, bytes_of, images_of, opaque_ball, views
from tests.scenes.textured import distance_to_planes

QUICK = quick(num_gaussians=200, first_frame_steps=40, epochs=3, dropout=0.0)
POINTS = ball(200).numpy()["means"], np.full((200, 3), 0.5)


def images(frame=0):
    """Return the images of a ball that moves from frame to frame."""
    truth = opaque_ball()
    means = truth.numpy()["means"] + np.float32([0.1 * frame, 0, 0])
    return bytes_of(images_of(replace(truth, means=means)))


def test_push__reports_the_psnr_of_the_training_views():
    loop = StreamLoop(views(), *POINTS, QUICK)
    reports = [loop.push(images(0))[1]]
    recorded = [View(*view) for view in zip(views(), images(0), strict=True)]
    expected = mean_psnr(loop.gaussians, recorded, RenderConfig())
    assert reports[0].psnr == pytest.approx(expected, abs=1)
    reports += [loop.push(images(frame))[1] for frame in (0, 1)]
    assert [report.status for report in reports] == 3 * ["ok"]
    assert np.isnan(reports[1].psnr), "nothing changes"
    assert reports[2].psnr > 15, "of the pixels that change"
    assert "mse" not in reports[2].losses


def test_push__status_names_a_later_frame_that_diverged():
    rates = {name: 300 * rate for name, rate in asdict(QUICK.fit.rates).items()}
    fit = replace(QUICK.fit, rates=LearningRates(**rates))
    loop = StreamLoop(views(), *POINTS, replace(QUICK, fit=fit))
    first, report = (loop.push(images(frame))[1] for frame in range(2))
    assert first.status == "ok"
    assert f"{report.psnr:.1f} dB, worse than constant images" in report.status


def test_push__seeds_points_where_no_camera_sees_the_given_ones(caplog):
    """Points beside the views ended as a black image."""
    means, colors = POINTS
    loop = StreamLoop(views(), means + np.float32([50, 0, 0]), colors, QUICK)
    _, report = loop.push(images())
    assert report.status == (
        "the cameras see 0 % of the 200 points, which are not used: check their axes and units; "
        "too few points (0): 200 more were initialised from the images"
    )
    assert report.psnr > 15
    warnings = [record.getMessage() for record in caplog.records]
    caplog.clear()
    fit_gaussians(views(), images(), means + np.float32([50, 0, 0]), colors, QUICK)
    assert [record.getMessage() for record in caplog.records] == warnings
    assert warnings[0].startswith("frame 0: the cameras see 0 % of the 200 points")


def test_fit_gaussians__starts_from_points_of_matched_images(textured_capture):
    images = next(textured_capture.frames()).images
    fitted = fit_gaussians(textured_capture.cameras, images, config=quick())
    assert fitted.report.status == "ok", "no random points"
    assert distance_to_planes(fitted.gaussians.numpy()["means"]).mean() < 0.1
