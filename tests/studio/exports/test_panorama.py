"""Panoramas against closed forms of one Gaussian, at the poles, at the seam and for both eyes; what
commands write.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from morgs_mi import cli
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import SH_C0
from morgs_mi.io.ply import write_ply
from morgs_mi.render.rasterize import rasterize
from morgs_mi.studio.exports.panorama import levelled, panorama
from tests.assertions import assert_close
from tests.scenes.changing_splats import rig, splats
from tests.scenes.gaussians import isotropic

WIDTH = 64
HEIGHT = 32
DISTANCE = 3.0
SIZE = 0.7
OPACITY = 0.9
WHITE = 0.5 / SH_C0  # the coefficient of white
# The axes of the world.
CAMERA = Camera.look_at((0.3, -0.2, 0.1), (0.3, -0.2, 1.1), (0, -1, 0), 60, 48, 36)


def directions(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Return the direction of each pixel [height, width, 3], x right, y down, z forward."""
    longitude = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    latitude = np.pi * (0.5 - (np.arange(height)[:, None] + 0.5) / height)
    x = np.cos(latitude) * np.sin(longitude)
    z = np.cos(latitude) * np.cos(longitude)
    return np.stack([x, np.broadcast_to(-np.sin(latitude), x.shape), z], axis=-1)


def ball_at(direction: np.ndarray, size: float = SIZE):
    """Return a white Gaussian in a direction of the camera."""
    return isotropic(
        [CAMERA.position + DISTANCE * np.asarray(direction)], size, OPACITY, (WHITE,) * 3
    )


def expected(direction: np.ndarray) -> np.ndarray:
    """Return the alpha of `ball_at` on each pixel's ray: opacity exp(-p^2 / 2), p the distance over
    the size.
    """
    rays = directions()
    p = DISTANCE * np.linalg.norm(np.cross(rays, direction), axis=-1) / SIZE
    alpha = OPACITY * np.exp(-0.5 * p**2) * (rays @ direction > 0)
    return np.where(alpha < 1 / 255, 0, alpha)


@pytest.mark.parametrize(
    "direction",
    [(0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1), (1, 0, 0), (0.6, -0.64, -0.48)],
    ids=["zenith", "nadir", "seam", "middle", "right", "oblique"],
)
def test_panorama__of_one_gaussian_is_its_closed_form_everywhere(direction):
    image = panorama(ball_at(direction), CAMERA, WIDTH, samples=1)
    alpha = expected(np.array(direction))
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert alpha.max() > 0.8
    cut = np.abs(alpha - 1 / 255) < 1e-3  # rounding decides
    assert_close(image[~cut], np.repeat(alpha[..., None], 3, axis=-1)[~cut], atol=2e-5)


def test_panorama__has_no_seam_and_is_the_same_at_all_longitudes_of_a_pole():
    image = panorama(ball_at((0, 0, -1)), CAMERA, WIDTH)
    assert_close(image, image[:, ::-1], atol=2e-5)
    assert image[HEIGHT // 2, 0].min() > 0.8
    image = panorama(ball_at((0, -1, 0)), CAMERA, WIDTH)
    assert_close(image, np.broadcast_to(image[:, :1], image.shape), atol=2e-5)
    assert image[0].min() > 0.8


@pytest.mark.parametrize("longitude", [0.0, 1.0, 3.0])
def test_panorama__of_two_eyes_has_the_disparity_of_the_distance(longitude):
    distance = 0.4
    width = 512
    middle = np.array([np.sin(longitude), 0, np.cos(longitude)])
    image = panorama(ball_at(middle, 0.05), CAMERA, width, distance, samples=1)
    assert image.shape == (width, width, 3)
    angles = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    disparities = []
    for eye in (image[: width // 2], image[width // 2 :]):
        weights = eye[..., 0].sum(axis=0)
        assert weights.max() > 0.5
        disparities.append(np.angle(np.sum(weights * np.exp(1j * angles))))
    # The ray of an eye starts beside the centre: sin of the angle between both rays is (b / 2) /
    # distance.
    shift = np.arcsin(0.5 * distance / DISTANCE)
    assert_close(
        np.angle(np.exp(1j * (np.array(disparities) - longitude))), [shift, -shift], atol=1e-3
    )


def test_panorama__shows_in_its_middle_what_the_camera_sees():
    scene = splats(300)
    camera = rig()[1]
    image = panorama(scene, levelled(camera, np.array([0.0, 0, 1])), 512, samples=1)
    level = levelled(camera, np.array([0.0, 0, 1]))
    view = Camera(np.array([[256, 0, 32], [0, 256, 24], [0, 0, 1.0]]), level.viewmat, 64, 48)
    picture = np.array(rasterize(scene, view).color)
    x, y = np.meshgrid((np.arange(64) - 31.5) / 256, (np.arange(48) - 23.5) / 256)
    u = (np.arctan2(x, 1) / (2 * np.pi) + 0.5) * 512 - 0.5
    v = (0.5 - np.arctan2(-y, np.hypot(x, 1)) / np.pi) * 256 - 0.5
    warped = cv2.remap(image, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
    assert picture.max() > 0.3
    assert np.abs(warped - picture).mean() < 0.02


@pytest.mark.parametrize(
    "target", [(0, 0, -5), (0, 1, -5), (3, 1, 0)], ids=["down", "nearly down", "level"]
)
def test_levelled__looks_to_the_same_side(target):
    camera = Camera.look_at((0, 0, 0), target, (0, 1, 0.1), 60, 48, 36)
    level = levelled(camera, np.array([0.0, 0, 1]))
    _, down, ahead = level.viewmat[:3, :3]
    assert_close(down, [0, 0, -1], atol=1e-12)
    assert_close(level.position, camera.position, atol=1e-12)
    _, top, forward = camera.viewmat[:3, :3]
    assert ahead @ (forward if target[0] else -top) > 0.9


def test_panorama__of_no_gaussians_is_black():
    assert not panorama(splats(0), CAMERA, 8, 0.1).any()


def test_render__writes_panoramas(tmp_path: Path):
    write_ply(tmp_path / "scene.ply", splats())
    base = [
        "render",
        str(tmp_path / "scene.ply"),
        "--projection",
        "equirectangular",
        "--width",
        "64",
    ]
    assert cli.main([*base, str(tmp_path / "a.png"), "--camera", "left"]) == 0
    assert cli.main([*base, str(tmp_path / "b.png"), "--stereo", "0.1"]) == 0
    shapes = [cv2.imread(str(tmp_path / name)).shape for name in ("a.png", "b.png")]
    assert shapes == [(32, 64, 3), (64, 64, 3)]
    keys = '{"keys": [{"time": 0, "camera": "left"}, {"time": 0.1, "camera": "back-left"}]}'
    (tmp_path / "path.json").write_text(keys)
    assert cli.main([*base, str(tmp_path / "c.mp4"), "--path", str(tmp_path / "path.json")]) == 0
    assert cv2.VideoCapture(str(tmp_path / "c.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 3
