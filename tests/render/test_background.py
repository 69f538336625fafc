"""Backgrounds: a colour of the renderer's settings, and an image of a camera."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import Camera, RenderConfig, StreamLoop, View, fit_gaussians, rasterize
from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.codec.reader import StreamReader
from morgs_mi.io.video_writer import write_video
from morgs_mi.platform.png import PngImage, png_bytes
from morgs_mi.playback.stream_header import render_config
from morgs_mi.render.active_view import ActiveView, ViewGroup
from morgs_mi.render.rasterize import render_view
from morgs_mi.render.region import Region
from morgs_mi.runs.fit_capture import stream_capture
from morgs_mi.testing import IMAGE_ABS, assert_close
from tests.quick import NO_DENSITY, quick
from tests.scenes.ball import opaque_ball
from tests.scenes.cameras import QUAD, look_at_cameras
from tests.scenes.derivatives import backward
from tests.scenes.gaussians import make_scene, to_gaussians

W = 48
H = 33
CAMERA = Camera.look_at((0, 0, -4), (0, 0, 0), (0, -1, 0), 40, W, H)
IMAGE = np.random.default_rng(0).uniform(0, 1, (H, W, 3)).astype(np.float32)
BEHIND = replace(CAMERA, background=IMAGE)
COLOR = (0.1, 0.2, 0.3)


@pytest.fixture(scope="module")
def gaussians():
    return to_gaussians(make_scene(n=30))


def over(gaussians, background):
    """Return the image of CAMERA, composited over a background."""
    image = rasterize(gaussians, CAMERA)
    return np.array(image.color) + (1 - np.array(image.alpha)) * np.float32(background)


def test_rasterize__composites_over_images_and_colours(gaussians):
    expected = over(gaussians, IMAGE)
    assert_close(rasterize(gaussians, BEHIND).color, expected, atol=IMAGE_ABS)
    assert_close(rasterize(gaussians, CAMERA, background=IMAGE).color, expected, atol=IMAGE_ABS)
    config = RenderConfig(background=COLOR)
    colored = over(gaussians, COLOR)
    assert_close(rasterize(gaussians, CAMERA, config=config).color, colored, atol=IMAGE_ABS)
    both = rasterize(gaussians, [BEHIND, CAMERA], config=config).color
    assert_close(both, np.stack([expected, colored]), atol=IMAGE_ABS)
    given = rasterize(gaussians, BEHIND, background=COLOR).color
    assert_close(given, colored, atol=IMAGE_ABS)


def test_rasterize__gradient_of_an_image_behind_is_the_transmittance(gaussians):
    background = mi.TensorXf(IMAGE)
    dr.enable_grad(background)
    image = rasterize(gaussians, CAMERA, ("color", "alpha"), background=background)
    backward(image.color)
    expected = np.repeat(1 - np.array(dr.detach(image.alpha)), 3, axis=2)
    assert_close(dr.grad(background), expected, atol=IMAGE_ABS)


def test_active_views__draw_the_image_behind_their_region(gaussians):
    mask = np.zeros((H, W), bool)
    mask[5:20, 7:30] = True
    region = Region.of(mask)
    view = ActiveView(BEHIND, region=region)
    expected = over(gaussians, IMAGE)
    assert_close(render_view(gaussians, view).color, region.crop(expected), atol=IMAGE_ABS)
    other = ActiveView(replace(CAMERA, background=1 - IMAGE))
    group = ViewGroup([view, other])
    color = np.asarray(group.draw(gaussians).color).reshape(group.region.shape(3))
    images = [expected, over(gaussians, 1 - IMAGE)]
    assert_close(color, group.crop(images), atol=IMAGE_ABS)


def test_camera__resizes_and_refuses_backgrounds():
    bytes_behind = replace(CAMERA, background=np.full((H, W, 3), 255, np.uint8))
    assert_close(bytes_behind.resized(24, 16).background, np.ones((16, 24, 3)))
    with pytest.raises(ValueError, match=r"`background` must be .* \[33, 48, 3\], got float64 \[4"):
        replace(CAMERA, background=np.zeros((4, 4, 3)))
    with pytest.raises(ValueError, match="`background` must have numbers from -32 to 32, 1 for wh"):
        replace(CAMERA, background=np.full((H, W, 3), 1e11))
    with pytest.raises(ValueError, match=r"`background` must be a PNG file of 48x33 .* of 3x2"):
        replace(CAMERA, background=PngImage(png_bytes(np.zeros((2, 3, 3), np.uint8))))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sensors": None}, r"fit_gaussians\(\): `sensors` must be a .*Sequence, got a NoneType"),
        (
            {"background": 3 * (1e30,)},
            "`background` must be a list, each item .* at most 32.0, got",
        ),
        (
            {"sensors": [View(CAMERA, mask=np.ones((2, 3), bool))]},
            r"the mask must be bool \[.*, got .*2, 3",
        ),
    ],
)
def test_fit_gaussians__refuses_absurd_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        fit_gaussians(**{"sensors": [CAMERA], "images": [IMAGE], **arguments})


def test_fit_gaussians__equals_the_loop_over_a_colour_and_over_images():
    ball = opaque_ball()
    cameras = look_at_cameras(QUAD, 90)
    config = quick(num_gaussians=80, first_frame_steps=8, density=NO_DENSITY)
    cloud = ball.numpy()["means"], np.full((400, 3), 0.5)
    behind = np.random.default_rng(0).uniform(0, 1, (4, cameras[0].height, cameras[0].width, 3))
    over_images = [replace(c, background=b) for c, b in zip(cameras, behind, strict=True)]
    over_white = replace(config, render=RenderConfig(background=(1.0, 1.0, 1.0)))
    images = [
        np.uint8(255 * np.clip(np.array(rasterize(ball, c).color), 0, 1) + 0.5) for c in over_images
    ]
    results = []
    for background, views, settings in (
        (mi.Color3f(1), cameras, over_white),
        (behind, over_images, config),
    ):
        loop = StreamLoop(views, *cloud, settings)
        loop.push(images)
        fitted = fit_gaussians(cameras, images, *cloud, config, background=background)
        for name, value in fitted.gaussians.numpy().items():
            assert np.array_equal(value, loop.gaussians.numpy()[name]), name
        results.append(fitted.gaussians.numpy()["sh_coeffs"])
    assert np.abs(results[0] - results[1]).max() > 0.01


def test_fits__without_points_find_the_colour_of_the_borders(caplog):
    """Fits and resumed ones use it, unless there are points or a background is given."""
    cameras = look_at_cameras(QUAD, 60)
    color = (0.2, 0.6, 0.8)
    behind = RenderConfig(background=color)
    images = [
        np.uint8(
            255 * np.clip(np.array(rasterize(opaque_ball(), c, config=behind).color), 0, 1) + 0.5
        )
        for c in cameras
    ]
    fitted = fit_gaussians(cameras, images, config=quick())
    assert_close(fitted.background, color, atol=IMAGE_ABS)
    assert "the colour of the images' borders, (0.2, 0.6, 0.8)" in caplog.messages[0]
    none = np.zeros((0, 3)), np.zeros((0, 3))
    loop, resumed = (StreamLoop(cameras, *none, quick()) for _ in range(2))
    loop.push(images)
    assert loop.setup.config.render == fitted.render
    resumed.resume(loop.state.coded, [images], loop.state.exposures)
    following = [np.roll(image, 3, axis=1) for image in images]
    assert loop.push(following)[0].encoded == resumed.push(following)[0].encoded
    points = opaque_ball().numpy()["means"]
    assert fit_gaussians(cameras, images, points, config=quick()).background is None
    white = (1.0, 1.0, 1.0)
    assert fit_gaussians(cameras, images, config=quick(), background=white).background == white


def test_stream_capture__without_points_stores_the_colour_of_the_borders(tmp_path):
    cameras = look_at_cameras(QUAD, 60, 96, 72)
    behind = RenderConfig(background=(0.2, 0.6, 0.8))
    write_colmap(tmp_path / "clip/sparse", cameras)
    for camera in cameras:
        color = np.clip(np.array(rasterize(opaque_ball(), camera, config=behind).color), 0, 1)
        frames = 3 * [np.uint8(255 * color + 0.5)]
        write_video(tmp_path / f"clip/{camera.name}.mkv", frames, 30)
    capture = load_capture(tmp_path / "clip")
    reports = stream_capture(capture, tmp_path / "fit", quick())
    stream = StreamReader(tmp_path / "fit/stream.morgs")
    assert_close(render_config(stream).background, behind.background, atol=2 / 255)
    resumed = stream_capture(capture, tmp_path / "fit", quick(), resume=True)
    assert len(resumed) == len(reports), "the same settings"
