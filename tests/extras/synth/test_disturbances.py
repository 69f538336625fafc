"""Disturbances: what is drawn, what is stored, and recordings that show exactly what the truth
states.
"""

from dataclasses import fields, replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.truth import load_tracks, load_truth
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.extras.synth.disturbances import (
    CameraDisturbance,
    Disturbances,
    draw_disturbances,
    load_disturbances,
    save_disturbances,
)
from morgs_mi.extras.synth.path_tracer import PathTracer
from morgs_mi.extras.synth.scene import Light, Object, Rig, Scene, load_scene, translate
from morgs_mi.extras.synth.shapes import box
from morgs_mi.extras.synth.synth_config import SynthConfig
from morgs_mi.extras.synth.synthesize import synthesize
from morgs_mi.io.clip_readers import open_frames
from morgs_mi.testing import assert_close
from tests.extras.synth.frames import FPS

ALL = Disturbances(0.5, 0.4, 0.1)
SIZE = SynthConfig(cameras=2, frames=2, width=64, height=48, spp=4)


def test_draw_disturbances__stays_within_its_bounds_and_leaves_the_reference_alone():
    drawn = draw_disturbances(ALL, 200, seed=1)
    offsets = np.array([d.time_offset for d in drawn])
    assert offsets[0] == 0
    assert -0.5 <= offsets.min() < -0.4 < 0.4 < offsets.max() <= 0.5
    assert 0.08 < np.abs([d.distortion for d in drawn]).max() <= 0.1
    assert {d.rolling_shutter for d in drawn} == {0.4}


@pytest.mark.parametrize("name", [field.name for field in fields(Disturbances)])
def test_draw_disturbances__a_setting_acts_and_changes_nothing_else(name):
    every = draw_disturbances(ALL, 3, 0)
    one = draw_disturbances(Disturbances(**{name: getattr(ALL, name)}), 3, 0)
    nothing = CameraDisturbance(0, 0, 0)
    assert one == tuple(replace(nothing, **{name: getattr(d, name)}) for d in every)
    assert one != (nothing,) * 3


def test_row_times__surround_the_time_of_the_frame():
    camera = CameraDisturbance(0.25, 0.5, 0.0)
    times = camera.row_times(3, 48)
    assert_close(times.mean(), 3.25, atol=1e-12)
    assert_close(np.diff(times), np.full(47, 0.5 / 48), atol=1e-12)


def test_load_disturbances__reads_back_what_was_saved(tmp_path):
    drawn = dict(zip(("cam00", "cam01"), draw_disturbances(ALL, 2, 0), strict=True))
    save_disturbances(tmp_path, drawn)
    assert load_disturbances(tmp_path) == drawn


def test_load_disturbances__names_a_missing_or_broken_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"disturbances\.json"):
        load_disturbances(tmp_path)
    for text in (
        '{"cam00": {}}',
        "[]",
        '{"cam00": {"time_offset": 0, "rolling_shutter": 0, "distortion": 0, "x": 1}}',
    ):
        (tmp_path / "disturbances.json").write_text(text)
        with pytest.raises(
            ValueError, match="expected the disturbances of each camera, got a broken file"
        ):
            load_disturbances(tmp_path)


@pytest.mark.slow
def test_synthesize__shows_a_camera_with_a_time_offset_at_its_own_time(tmp_path):
    """The motion of a camera's truth leads between its own times; tracks are at the reference's
    times.
    """
    clip = synthesize(
        "arm", tmp_path / "clip", replace(SIZE, disturbances=Disturbances(time_offset=2))
    )
    offset = load_disturbances(clip / "truth")["cam01"].time_offset
    assert abs(offset) > 0.2
    scene = load_scene("arm")
    tracer = PathTracer(scene)
    camera = scene.rig.cameras(2, 64, 48)[1]
    tracer.set_time((1 + offset) / FPS)
    seed = int(np.random.SeedSequence([0, 1, 1]).generate_state(1)[0])
    recorded = list(open_frames(clip / "frames/cam01").frames())[1]
    assert_array_equal(recorded, tracer.render(camera, 4, seed))
    depth = camera.project(tracer.surface_points(camera).positions)[1]
    assert_close(load_truth(clip / "truth", "cam01", 1).depth, depth, atol=1e-5)
    tracks = load_tracks(clip / "truth")
    points = tracks.points[tracks.ids == list(scene.objects).index("hand")]
    pose = scene.objects["hand"].pose
    step = pose(1 / FPS) @ np.linalg.inv(pose(0.0))
    assert_close(points[:, 1], points[:, 0] @ step[:3, :3].T + step[:3, 3], atol=1e-6)


def bar_scene(speed):
    """A bright vertical bar that moves along x, in front of nothing, in constant light."""
    bar = Object(
        {"bar": box((0, 0, 0), (0.1, 3, 0.02), {"type": "diffuse", "reflectance": 0.8})},
        lambda t: translate(speed * t, 0, 0),
    )
    rig = Rig(center=(0, 0, 0), distance=4.0, elevation=0.0, spread=(1.0, 1.0))
    sky = Light({"type": "directional", "direction": [0, 0, -1], "irradiance": 2.0})
    return Scene("bar", {"bar": bar}, {"sky": sky}, rig)


@pytest.mark.slow
def test_synthesize__reads_the_rows_of_a_rolling_shutter_at_their_times(tmp_path):
    """A vertical bar is slanted: in every row, its middle is where the bar is at the time of that
    row.
    """
    scene = bar_scene(speed=6.0)
    config = replace(SIZE, width=128, height=64, disturbances=Disturbances(rolling_shutter=0.8))
    clip = synthesize(scene, tmp_path / "clip", config)
    disturbance = load_disturbances(clip / "truth")["cam00"]
    x = 6.0 * disturbance.row_times(1, 64) / FPS
    bar = np.stack([x, np.zeros(64), np.full(64, 0.02)], axis=1)
    expected = scene.rig.cameras(2, 128, 64)[0].project(bar)[0][:, 0]
    assert np.ptp(expected) > 5

    def middle(rows):
        return (rows * (np.arange(128) + 0.5)).sum(axis=1) / rows.sum(axis=1)

    image = list(open_frames(clip / "frames/cam00").frames())[1]
    assert np.abs(middle(image.mean(axis=-1)) - expected).max() < 0.5
    truth = middle(load_truth(clip / "truth", "cam00", 1).mask)
    assert np.ptp(truth) < 1e-9, "the truth is that of one time"
    assert abs(truth[0] - expected.mean()) < 0.7


@pytest.mark.slow
def test_synthesize__undistorted_images_are_those_of_the_pinhole_cameras(tmp_path):
    disturbances = Disturbances(distortion=0.4)
    config = replace(SIZE, width=96, height=72, spp=16, frames=1, disturbances=disturbances)
    clip = synthesize("spheres", tmp_path / "clip", config)
    scene = load_scene("spheres")
    tracer = PathTracer(scene)
    camera = scene.rig.cameras(2, 96, 72)[1]
    expected = tracer.render(camera, 16, 0)
    capture = load_capture(clip)
    recorded, undistorted_image = (
        next(iter(images))
        for images in (open_frames(clip / "frames/cam01").frames(), capture.images(1))
    )
    mask = capture.masks[1]
    similarity = psnr(undistorted_image, expected, mask)
    assert similarity > 28
    assert similarity > psnr(recorded, expected, mask) + 4
    assert_array_equal(
        load_truth(clip / "truth", "cam01", 0).ids, tracer.surface_points(camera).ids
    )
    assert_close(capture.cameras[1].K, camera.K, atol=1e-6)


def test_synthesize__refuses_a_lens_that_folds_its_corners(tmp_path):
    scene = bar_scene(0.0)
    wide = Scene("wide", scene.objects, scene.lights, Rig(center=(0, 0, 0), fov=80, elevation=0))
    with pytest.raises(
        ValueError, match="`distortion` must be small enough for the field of view, got -0"
    ):
        synthesize(
            wide,
            tmp_path / "clip",
            replace(SIZE, cameras=8, disturbances=Disturbances(distortion=0.5)),
        )


def test_synthesize__checks_a_scene_at_all_times_that_are_recorded(tmp_path):
    """A pose that fails before 0 s, when a rolling shutter reads the first rows."""
    late = bar_scene(0.0).objects["bar"].shapes
    scene = Scene("late", {"bar": Object(late, lambda t: translate(1 / (t >= 0), 0, 0))}, {}, Rig())
    with pytest.raises(
        ValueError, match=r"object 'bar': its pose at -0\.0083.* s fails with ZeroDivisionError"
    ):
        synthesize(
            scene,
            tmp_path / "clip",
            replace(SIZE, height=1000, disturbances=Disturbances(rolling_shutter=0.5)),
        )
