"""Camera paths: interpolation of key views, orbits, paths through the rig, JSON files."""

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi.core.camera import Camera
from morgs_mi.core.rig import up_direction
from morgs_mi.playback.export.paths import CameraPath, focus, load_path, orbit, through_cameras
from morgs_mi.testing import assert_close
from tests.scenes.cameras import circle, look_at_cameras
from tests.scenes.changing_splats import rig

TARGET = np.array([0, 0, 0.2])
VIEWMAT = rig()[0].viewmat.tolist()


def ring(count):
    origins = circle(2 * np.pi * np.arange(count) / count, 3, 1)
    return tuple(look_at_cameras(origins, 45, target=(0, 0, 0.2), up=(0, 0, 1)))


def test_camera_path__interpolates_its_keys_smoothly():
    wide = replace(rig()[2], K=np.array([[30.0, 0, 31], [0, 33, 25], [0, 0, 1]]))
    path = CameraPath(np.array([0, 1, 2.5]), (*rig()[:2], wide))
    for time, key in zip(path.times, path.keys, strict=True):
        assert_close(path.at(time).viewmat, key.viewmat, atol=1e-9)
        assert_close(path.at(time).K, key.K, atol=1e-9)
    assert_array_equal(path.at(9).viewmat, path.at(2.5).viewmat)
    # No kinks: the steps to both sides of a key differ by the acceleration times their square.
    left, middle, right = (path.at(1 + h).position for h in (-1e-4, 0, 1e-4))
    assert_close(right - middle, middle - left, atol=1e-7)


def test_through_cameras__visits_the_nearest_next_at_constant_speed():
    cameras = rig()
    path = through_cameras((cameras[0], cameras[2], cameras[1]), 2)
    assert [key.name for key in path.keys] == ["left", "middle", "right"]
    assert_allclose(path.times, [0, 1, 2])


def test_through_cameras__names_the_path_for_a_single_camera():
    with pytest.raises(ValueError, match=r"expected two cameras or more; use the path `orbit`"):
        through_cameras(rig()[:1])


def test_orbit__has_a_constant_distance_and_looks_at_the_centre():
    path = orbit(ring(8), TARGET, seconds=4)
    # No gap of 90 degrees: a full turn.
    assert_close(path.at(0).position, path.at(4).position, atol=1e-9)
    for time in np.linspace(0, 4, 30):
        camera = path.at(time)
        pixel, depth = camera.project(TARGET)
        # Splines through keys 10 degrees apart: less than a hundredth of a pixel at this focal
        # length.
        assert np.linalg.norm((pixel - camera.K[:2, 2]) / np.diag(camera.K)[:2]) < 1e-4
        assert depth > 0
        assert np.linalg.norm(camera.position - TARGET) == pytest.approx(np.hypot(3, 0.8), rel=1e-4)


def test_orbit__of_a_frontal_rig_is_as_wide_as_the_rig():
    path = orbit(rig(), TARGET, seconds=1)
    a, b = (path.at(time).position - TARGET for time in (0, 1))
    # Around the rig's mean up, which is tilted from z by the 11 degrees by which the cameras look
    # down.
    x, y = (rig()[k].position - TARGET for k in (0, 2))
    assert np.arccos(a @ b / (a @ a)) == pytest.approx(np.arccos(x @ y / (x @ x)), abs=0.02)


def test_focus__is_the_intersection_of_the_axes_or_the_median_of_the_gaussians():
    means = np.random.default_rng(0).normal(size=(99, 3))
    assert_close(focus(ring(8), means), TARGET, atol=0.02)
    parallel = [Camera.look_at((x, -4, 0), (x, 0, 0), (0, 0, 1), 45, 64, 48) for x in (-1, 1)]
    assert focus(parallel, means + np.array([0, 2, 0]))[1] == pytest.approx(
        np.median(means[:, 1]) + 2
    )


def test_load_path__reads_matrices_sizes_and_angles(tmp_path):
    keys = [{"time": t, "viewmat": camera.viewmat.tolist()} for t, camera in enumerate(rig())]
    keys[2]["fov_x"] = 60
    (tmp_path / "path.json").write_text(json.dumps({"width": 128, "height": 96, "keys": keys}))
    path = load_path(tmp_path / "path.json", rig()[0])
    for key, camera in zip(path.keys, rig(), strict=True):
        assert_close(key.viewmat, camera.viewmat, atol=1e-12)
    assert_close(path.keys[1].K, rig()[0].resized(128, 96).K, atol=1e-9)
    assert path.keys[2].K[0, 0] == pytest.approx(64 / np.tan(np.pi / 6))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[", "expected JSON, got a broken file"),
        (
            '{"keys": [{"time": 0, "width": 1e999}]}',
            "cannot convert float infinity",
        ),
        (
            '{"cameras": []}',
            "a list `keys` of views, got {'cameras': []} (KeyError: 'keys'); write a `time` and",
        ),
        (
            '[{"id": 0, "img_name": "a"}]',
            "a list `keys` of views, got [{'id': 0, 'img_name': 'a'}] (TypeError",
        ),
        (f'{{"keys": [{{"time": 0, "viewmat": {VIEWMAT}}}]}}', "two key views of one size"),
        ('{"keys": []}', "two key views of one size"),
        (f'{{"keys": [{{"viewmat": {VIEWMAT}}}]}}', "key 0: expected a JSON object"),
        (
            '{"keys": [{"time": 0, "camera": "left"}]}',
            "(KeyError: 'viewmat'); write a `time` and a `viewmat` for each of the `keys`.",
        ),
        (
            '{"keys": [{"time": 0, "viewmat": [[1, 0], [0, 1]]}]}',
            "`viewmat`: the pose must be a matrix",
        ),
        (
            f'{{"viewmat": {VIEWMAT}, "keys": [{{"time": 1}}, {{"time": 0}}]}}',
            "`times` that increase from 0, got 2 views",
        ),
    ],
)
def test_load_path__reports_broken_json(tmp_path, text, message):
    (tmp_path / "path.json").write_text(text)
    with pytest.raises(ValueError, match=r"path\.json: ") as caught:
        load_path(tmp_path / "path.json", rig()[0])
    assert message in str(caught.value)


def test_orbit__rejects_a_camera_directly_above():
    top = Camera.look_at((0, 0, 5), (0, 0, 0), (0, 1, 0), 45, 64, 48, "top")
    rig = (top, *ring(4))
    with pytest.raises(ValueError, match="'top' must stand beside the scene"):
        orbit(rig, top.position - 5 * up_direction(rig))
