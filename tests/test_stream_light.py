"""The loop as the light changes: exposures of cameras, black images, cuts, light above white."""

import dataclasses

import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose

from morgs_mi import rasterize, stream_loop
from morgs_mi.core.color_space import SH_C0, decode_light, encode_light
from morgs_mi.fit.fit_config import ShortFitConfig
from morgs_mi.stream_loop import StreamLoop
from tests.scenes.ball_and_wall import SHORT, cameras, new_loop, recorded, run, scene, with_fit


@pytest.fixture(scope="module")
def clip():
    return recorded()


EXPOSED = with_fit(exposure="on", short_fits=ShortFitConfig(gaussians=600, steps=60, rounds=2))


def brighter(images, gains):
    """Return the images of a frame with a gain per view."""
    bright = np.stack(images[:4]) * np.reshape(gains, (-1, 1, 1, 1))
    return [*np.rint(np.clip(bright, 0, 255)).astype(np.uint8)]


@pytest.fixture(scope="module")
def auto_exposed(clip):
    """A static clip of cameras that differ, and change by up to 10 % in each frame; reports of a
    fit with exposures.
    """
    gains = [(0.9, 1.0, 0.95, 0.85), (0.9, 1.1, 0.95, 0.75), (1.0, 0.9, 0.9, 0.85)]
    frames = [brighter(clip[0], each) for each in gains]
    loop, _, reports = run(frames, EXPOSED)
    return np.array(gains), frames, loop, reports


@pytest.mark.slow
def test_push__reports_the_exposure_of_each_view_over_time(auto_exposed):
    gains, _, _, reports = auto_exposed
    grey = 0.4 * np.ones(3)
    middle = np.array([[np.mean(e(grey)) / 0.4 for e in report.exposures] for report in reports])
    assert_allclose(middle / middle[0], gains / gains[0], atol=0.01)
    assert np.abs(np.log(middle[0])).max() > 0.02, "the cameras differ in the first frame, too"
    assert "The cameras were balanced" in reports[0].validation["exposure"]["sentence"]


@pytest.mark.slow
def test_push__changes_no_static_gaussian_where_only_the_exposure_changes(auto_exposed):
    _, frames, _, reports = auto_exposed
    _, _, without = run(frames, with_fit(EXPOSED, exposure="off"))
    sizes = np.array([[row.num_bytes for row in rows[1:]] for rows in (reports, without)])
    assert sizes[0].max() < 0.1 * sizes[1].min()
    assert without[0].exposures == ()


@pytest.mark.slow
def test_resume__continues_with_the_exposures_of_the_reports(auto_exposed, clip):
    gains, frames, loop, reports = auto_exposed
    following = brighter(clip[1], gains[1])
    _, packet, report = stream_loop.step(loop.setup, loop.state, following)
    resumed = new_loop(EXPOSED)
    resumed.resume(loop.state.coded, frames, reports[0].exposures)
    again, same = resumed.push(following)
    assert again.encoded == packet.encoded
    assert same.exposures == report.exposures


@pytest.mark.slow
def test_push__leaves_a_change_of_light_in_the_scene(clip):
    _, _, reports = run([clip[0], brighter(clip[0], [0.8] * 4)], EXPOSED)
    # All cameras see it: the stream becomes darker, and no exposure changes.
    assert reports[1].exposures == reports[0].exposures
    assert reports[1].num_bytes > 1000


@pytest.mark.slow
def test_push__has_the_same_bytes_with_exposures_where_cameras_are_equal(clip, monkeypatch):
    _, plain, _ = run(clip)
    # Their few short fits would find differences of 1 %.
    monkeypatch.setattr("morgs_mi.fit.balance.LEAST_DIFFERENCE", 0.1)
    _, packets, _ = run(clip, with_fit(EXPOSED, exposure="auto"))
    assert [packet.encoded for packet in packets] == [packet.encoded for packet in plain]


@pytest.mark.slow
def test_push__reports_a_black_first_frame_and_a_cut(clip):
    loop = new_loop(SHORT)
    cut = np.stack(clip[1][:4])[:, ::-1, ::-1, ::-1]
    frames = (np.zeros_like(cut), clip[0][:4], clip[1][:4], np.ascontiguousarray(cut))
    statuses = [loop.push([*images])[1].status for images in frames]
    assert [status.split(";")[0] for status in statuses] == [
        "cam00, cam01, cam02, cam03: the image is black",
        "ok",
        "ok",
        "the images show another scene than in the frame before",
    ]


@pytest.mark.slow
def test_push__light_above_white_is_fitted_and_followed():
    """The wall of the scene shines with 1 to 20 times white; images, points and packets have
    encoded colours.
    """
    shining = []
    for frame in range(2):
        gaussians, moves = scene(frame)
        sh_coeffs = gaussians.numpy()["sh_coeffs"].copy()
        sh_coeffs[~moves] += 1.5 / SH_C0
        shining.append(dataclasses.replace(gaussians, sh_coeffs=sh_coeffs))
    images = [
        [decode_light(np.asarray(rasterize(state, camera).color)) for camera in cameras()]
        for state in shining
    ]
    assert max(image.max() for image in images[0]) > 10
    start = shining[0].numpy()
    colors = np.maximum(start["sh_coeffs"][:, 0] * SH_C0 + 0.5, 0)
    loop = StreamLoop(cameras()[:4], start["means"], colors, SHORT)
    reports = [loop.push([*map(mi.TensorXf, each[:4])])[1] for each in images]
    assert [report.status for report in reports] == ["ok", "ok"]
    assert loop.state.history.display_exposure < -1
    rendered = np.asarray(rasterize(loop.gaussians, cameras()[4]).color)
    truth = encode_light(images[1][4])
    above = truth > 1.2
    # Without the range above white the error would be at least 0.2.
    assert above.mean() > 0.2
    assert np.abs(rendered - truth)[above].mean() < 0.1
