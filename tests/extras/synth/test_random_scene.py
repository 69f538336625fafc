"""Random scenes: what the seed draws, without rendering, and one small clip."""

from itertools import combinations

import numpy as np
import pytest

from morgs_mi.extras.synth.synth_config import SynthConfig
from morgs_mi.extras.synth.synthesize import synthesize

# Not tests.scenes.
from scenes.random import draw_scene  # pyright: ignore[reportMissingImports]

NUM_SEEDS = 50
FPS = 30.0
TIMES = np.arange(90) / FPS
SMALL = SynthConfig(frames=2, width=64, height=48, seed=1)


@pytest.fixture(scope="module")
def scenes():
    return [draw_scene(seed) for seed in range(NUM_SEEDS)]


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return synthesize("random", tmp_path_factory.mktemp("synth") / "random", SMALL)


def surface(body, times):
    """Return points of the surface farthest from the object's centre, over time [T, P, 3]."""
    octahedron = body.solid.margin * np.concatenate([np.eye(3), -np.eye(3)])
    points = (body.solid.points[:, None] + octahedron).reshape(-1, 3)
    poses = np.stack([body.pose(time) for time in times])
    return np.einsum("tij,pj->tpi", poses[:, :3, :3], points) + poses[:, None, :3, 3]


@pytest.mark.slow
def test_draw_scene__objects_are_in_the_room_and_in_view_and_never_touch(scenes):
    for scene in scenes:
        cameras = scene.rig.cameras(scene.recording.num_cameras, 320, 240)
        for name, body in scene.bodies.items():
            points = surface(body, TIMES[::3])
            low = points.min(axis=(0, 1))
            high = points.max(axis=(0, 1))
            assert (low > np.array([-scene.half_width, -1e-6, -1.7])).all(), name
            assert (high[:2] < [scene.half_width, 3.2]).all(), name
            assert (low > body.bounds[0] - 0.01).all(), name
            assert (high < body.bounds[1] + 0.01).all(), name
            pixels = [camera.project(surface(body, TIMES[:8]))[0] for camera in cameras]
            views = [((p > 0) & (p < [320, 240])).all() for p in pixels]
            assert views[0]
            assert np.mean(views) >= 0.75
        for a, b in combinations(scene.bodies.values(), 2):
            assert ((a.bounds[0] > b.bounds[1]) | (b.bounds[0] > a.bounds[1])).any()


def test_draw_scene__speed_is_that_of_the_fastest_point_in_the_held_out_view(scenes):
    for scene in scenes[:10]:
        camera = scene.rig.cameras(2, 320, 240)[0]
        for name, body in scene.bodies.items():
            pixels = camera.project(surface(body, TIMES))[0]
            fastest = np.linalg.norm(np.diff(pixels, axis=0), axis=-1).max()
            # A frame covers up to a ninth of an oscillation, over which the mean speed is below the
            # peak.
            assert 0.7 * body.speed <= fastest <= 1.02 * body.speed, name


@pytest.mark.slow
def test_synthesize__writes_the_same_bytes_for_the_same_seed(clip, tmp_path):
    again = synthesize("random", tmp_path / "again", SMALL)
    first, second = (
        {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}
        for root in (clip, again)
    )
    assert first.keys() == second.keys()
    assert [str(file) for file in first if first[file] != second[file]] == []
