"""Random scenes: what the seed draws, without rendering, and one small clip."""

from __future__ import annotations

import json
from itertools import combinations

import numpy as np
import pytest

from morgs_mi.capture.truth import load_truth
from morgs_mi.studio.synth.synth_config import SynthConfig
from morgs_mi.studio.synth.synthesize import synthesize

# Not tests.scenes.
from scenes.random import MOTIONS, Body, RandomScene, draw_scene  # pyright: ignore[reportMissingImports]
from tests.assertions import assert_close

NUM_SEEDS = 50
FPS = 30.0
TIMES = np.arange(90) / FPS
SMALL = SynthConfig(frames=2, width=64, height=48, seed=1)


@pytest.fixture(scope="module")
def scenes() -> list[RandomScene]:
    return [draw_scene(seed) for seed in range(NUM_SEEDS)]


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return synthesize("random", tmp_path_factory.mktemp("synth") / "random", SMALL)


def moving(scene: RandomScene) -> list[Body]:
    return [body for body in scene.bodies.values() if body.motion != "static"]


def thin_and_fast(scene: RandomScene) -> bool:
    return any(body.solid.kind == "rod" and body.speed >= 7 for body in moving(scene))


def surface(body: Body, times: np.ndarray) -> np.ndarray:
    """Return points of the surface farthest from the object's centre, over time [T, P, 3]."""
    octahedron = body.solid.margin * np.concatenate([np.eye(3), -np.eye(3)])
    points = (body.solid.points[:, None] + octahedron).reshape(-1, 3)
    poses = np.stack([body.pose(time) for time in times])
    return np.einsum("tij,pj->tpi", poses[:, :3, :3], points) + poses[:, None, :3, 3]


@pytest.mark.slow
def test_draw_scene__differs_between_seeds(scenes):
    assert len({scene.rig for scene in scenes}) == NUM_SEEDS
    assert len({tuple(scene.bodies) for scene in scenes}) > 0.9 * NUM_SEEDS


@pytest.mark.slow
def test_draw_scene__objects_stay_in_the_room(scenes):
    for scene in scenes:
        for name, body in scene.bodies.items():
            points = surface(body, TIMES[::3])
            low = points.min(axis=(0, 1))
            high = points.max(axis=(0, 1))
            assert low[1] > -1e-6, name
            assert high[1] < 3.2, name
            assert np.abs([low[0], high[0]]).max() < scene.half_width, name
            assert low[2] > -1.7, name
            assert (low > body.bounds[0] - 0.01).all(), name
            assert (high < body.bounds[1] + 0.01).all(), name


@pytest.mark.slow
def test_draw_scene__objects_never_touch(scenes):
    for scene in scenes:
        for a, b in combinations(scene.bodies.values(), 2):
            assert ((a.bounds[0] > b.bounds[1]) | (b.bounds[0] > a.bounds[1])).any()


@pytest.mark.slow
def test_draw_scene__held_out_view_and_most_others_see_every_object(scenes):
    for scene in scenes:
        cameras = scene.rig.cameras(scene.recording.num_cameras, 320, 240)
        for body in scene.bodies.values():
            points = surface(body, TIMES[:8])
            views = [
                ((p > 0) & (p < [320, 240])).all()
                for p in (camera.project(points)[0] for camera in cameras)
            ]
            assert views[0]
            assert np.mean(views) >= 0.75


def test_draw_scene__speed_is_that_of_the_fastest_point_in_the_held_out_view(scenes):
    for scene in scenes[:10]:
        camera = scene.rig.cameras(2, 320, 240)[0]
        for name, body in scene.bodies.items():
            pixels = camera.project(surface(body, TIMES))[0]
            fastest = np.linalg.norm(np.diff(pixels, axis=0), axis=-1).max()
            # A frame covers up to a ninth of an oscillation, over which the mean speed is below the
            # peak.
            assert 0.7 * body.speed <= fastest <= 1.02 * body.speed, name


def test_draw_scene__draws_all_parameters_from_their_ranges(scenes):
    for scene in scenes:
        assert 4 <= scene.recording.num_cameras <= 16
        assert scene.recording.spp in (4, 16, 49)
        assert scene.recording.noise == 0 or 0.003 <= scene.recording.noise <= 0.02
        assert 14 <= scene.rig.spread[0] <= 36
        assert 2 <= len(moving(scene)) <= 5
        assert len(moving(scene)) < len(scene.bodies) <= 10
        assert all(2 <= body.speed <= 12 for body in moving(scene))
    bodies = [body for scene in scenes for body in scene.bodies.values()]
    assert {body.motion for body in bodies} == {*MOTIONS, "static"}
    kinds = {"ball", "box", "plate", "column", "dumbbell", "cross", "rod", "pendulum"}
    assert {body.solid.kind for body in bodies} == kinds
    # About half of the scenes have sensor noise, a swinging lamp, and a thin, fast rod.
    for count in (
        sum(scene.recording.noise > 0 for scene in scenes),
        sum(scene.swing > 0 for scene in scenes),
        sum(map(thin_and_fast, scenes)),
    ):
        assert 0.25 * NUM_SEEDS < count < 0.85 * NUM_SEEDS
    assert any(map(thin_and_fast, scenes[:3]))
    assert any(map(thin_and_fast, scenes[3:9]))


@pytest.mark.slow
def test_build__objects_are_where_they_were_drawn_and_static_ones_do_not_move(clip):
    scene = draw_scene(1)
    names = json.loads((clip / "capture.json").read_text())["objects"]
    assert names[4:] == list(scene.bodies)
    camera = scene.rig.cameras(scene.recording.num_cameras, 64, 48)[0]
    truth = load_truth(clip / "truth", "cam00", 1)
    pixels = np.stack(np.meshgrid(np.arange(64), np.arange(48)), axis=-1) + 0.5
    for name, body in scene.bodies.items():
        mask = truth.ids == names.index(name)
        points = camera.unproject(pixels[mask], truth.depth[mask])
        assert len(points) > 3
        assert (points > body.bounds[0] - 0.01).all()
        assert (points < body.bounds[1] + 0.01).all()
        assert (truth.mask[mask] == (body.motion != "static")).all()


@pytest.mark.slow
def test_synthesize__records_a_random_scene_as_its_seed_determines(clip):
    settings = json.loads((clip / "capture.json").read_text())
    recording = draw_scene(1).recording
    assert [settings[name] for name in ("scene", "num_cameras", "spp")] == [
        "random",
        recording.num_cameras,
        recording.spp,
    ]
    assert_close(settings["noise"], recording.noise, rtol=1e-9)


@pytest.mark.slow
def test_synthesize__writes_the_same_bytes_for_the_same_seed(clip, tmp_path):
    again = synthesize("random", tmp_path / "again", SMALL)
    files = sorted(path.relative_to(clip) for path in clip.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(again) for path in again.rglob("*") if path.is_file())
    assert [
        str(file) for file in files if (clip / file).read_bytes() != (again / file).read_bytes()
    ] == []
