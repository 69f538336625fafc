"""Points that move with the Gaussians of a stream: binding, rigid motion, deaths, visibility."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import decode, keyframe_packet, residual_packet
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.geometry import covariances
from morgs_mi.studio.measures.point_tracks import bind, seen_in_depth, track_points
from tests.assertions import assert_close
from tests.scenes.changing_splats import splats
from tests.scenes.gaussians import isotropic, make_scene, to_gaussians

EXACT = CodecConfig(quality=1e5)
CAMERA = Camera.look_at((0, 0, -4), (0, 0, 0), (0, -1, 0), 50, 40, 30)
# Residuals of float32 coordinates near 1 are exact to 1e-6, rotations to 1e-5.
EXACT_ABS = 2e-5


def write(
    path: Path, states: list[Gaussians], sources: list[list[int] | None] | None = None
) -> StreamReader:
    """Write a stream of these Gaussians; a source maps a frame's to the previous frame's."""
    packet = keyframe_packet(states[0], 0, [CAMERA], EXACT)
    with StreamWriter(path, [CAMERA], 25) as writer:
        writer.write(packet)
        coded = decode(None, packet)
        for t, state in enumerate(states[1:]):
            source = sources[t] if sources else None
            packet = residual_packet(
                coded, state, None if source is None else np.array(source), [CAMERA], EXACT
            )
            writer.write(packet)
            coded = decode(coded, packet)
    return StreamReader(path)


def turned(gaussians: Gaussians, rotation: Rotation, shift: np.ndarray) -> Gaussians:
    """Return the Gaussians after a rigid motion."""
    raw = gaussians.numpy()
    quats = (rotation * Rotation.from_quat(raw["quats"], scalar_first=True)).as_quat(
        scalar_first=True
    )
    return Gaussians(**{**raw, "means": rotation.apply(raw["means"]) + shift, "quats": quats})


def test_bind__finds_the_largest_responses_of_the_definition() -> None:
    gaussians = to_gaussians(make_scene(n=60))
    points = np.random.default_rng(1).uniform(-1, 1, (20, 3))
    rows, weights = bind(gaussians, points, 4)
    offsets = points[:, None] - gaussians.numpy()["means"]
    distances = np.einsum(
        "pni,nij,pnj->pn", offsets, np.linalg.inv(covariances(gaussians)), offsets
    )
    responses = np.asarray(gaussians.opacities) * np.exp(-0.5 * distances)
    expected = np.argsort(-responses, axis=1)[:, :4]
    np.testing.assert_array_equal(rows, expected)
    largest = np.take_along_axis(responses, expected, 1)
    assert_close(weights, largest / largest.sum(1, keepdims=True), atol=1e-5)


def test_bind__works_far_from_all_gaussians_and_for_flat_ones() -> None:
    gaussians = isotropic(np.array([(0.0, 0, 0), (1, 0, 0)]), 1e-3, 0.9)
    rows, weights = bind(gaussians, np.array([(50.0, 0, 0), (-50, 0, 0)]), 8)
    assert rows.tolist() == [[1, 0], [0, 1]]
    assert_close(weights, np.array([[1, 0], [1, 0]]), atol=1e-12)
    flat = Gaussians.from_activated(
        [(0, 0, 0), (0, 0, 3)],
        [(1, 1, 0), (1, 1, 0)],
        [(1, 0, 0, 0)] * 2,
        [0.9] * 2,
        np.zeros((2, 1, 3)),
    )
    assert bind(flat, np.array([(0.1, 0.1, 0), (0, 0, 2.9)]), 1)[0].tolist() == [[0], [1]]


@pytest.mark.parametrize("num_gaussians", [1, 8])
@pytest.mark.parametrize("query", [0, 1, 2])
def test_track_points__follow_a_rigid_motion_in_both_directions(
    tmp_path: Path, num_gaussians: int, query: int
) -> None:
    """Points between the means move exactly with them, because each Gaussian carries them with its
    rotation too.
    """
    start = splats(30)
    step = Rotation.from_rotvec([0.1, -0.2, 0.3])
    shift = np.array([0.05, 0, -0.02])
    states = [start, turned(start, step, shift)]
    states.append(turned(states[1], step, shift))
    points = [np.random.default_rng(2).uniform(-0.6, 0.6, (7, 3))]
    points.append(step.apply(points[0]) + shift)
    points.append(step.apply(points[1]) + shift)
    tracks = track_points(write(tmp_path / "s.morgs", states), points[query], query, num_gaussians)
    assert tracks.frames.tolist() == [0, 1, 2]
    assert tracks.alive.all()
    assert_close(tracks.points, np.stack(points, 1), atol=EXACT_ABS)
    np.testing.assert_array_equal(tracks.points[:, query], points[query])
    assert_close(tracks.weights.sum(1), 1, atol=1e-12)


def test_track_points__each_query_has_its_own_frame(tmp_path: Path) -> None:
    states = [isotropic(np.array([(0.1 * t, 0, 0), (5, 0.1 * t, 0)]), 0.1, 0.9) for t in range(3)]
    tracks = track_points(write(tmp_path / "s.morgs", states), [(0, 0, 0), (5, 0.25, 0)], [0, 2])
    assert_close(tracks.points[0, :, 0], np.array([0, 0.1, 0.2]), atol=EXACT_ABS)
    assert_close(tracks.points[1, :, 1], np.array([0.05, 0.15, 0.25]), atol=EXACT_ABS)


def test_track_points__a_static_gaussian_nearby_takes_its_share(tmp_path: Path) -> None:
    """The query lies halfway between two equal Gaussians, of which one moves by 1: the blend moves
    by a half.
    """
    states = [isotropic(np.array([(-0.1, 0, 0), (0.1, t, 0)]), 0.1, 0.9) for t in (0.0, 1.0)]
    stream = write(tmp_path / "s.morgs", states)
    assert_close(track_points(stream, [(0, 0, 0)], 0).points[0, 1], (0, 0.5, 0), atol=EXACT_ABS)
    assert_close(
        track_points(stream, [(0.01, 0, 0)], 0, 1).points[0, 1], (0.01, 1, 0), atol=EXACT_ABS
    )


def test_track_points__stay_and_are_marked_where_all_gaussians_have_died(tmp_path: Path) -> None:
    """Gaussian 0 dies in frame 2; the one that is born there is another one. Gaussian 2 is born in
    frame 1.
    """
    means = [
        np.array([(0.0, 0, 0), (5, 0, 0)]),
        np.array([(0.1, 0, 0), (5, 0, 0), (9, 0, 0)]),
        np.array([(5, 0, 0), (9.1, 0, 0), (0.2, 0, 0)]),
        np.array([(5, 0, 0), (9.2, 0, 0), (0.3, 0, 0)]),
    ]
    states = [isotropic(m, 0.1, 0.9) for m in means]
    stream = write(tmp_path / "s.morgs", states, [[0, 1, -1], [1, 2, -1], None])
    tracks = track_points(stream, [(0, 0, 0), (9.1, 0, 0), (0.3, 0, 0)], [0, 2, 3], num_gaussians=1)
    assert tracks.alive.tolist() == [[1, 1, 0, 0], [0, 1, 1, 1], [0, 0, 1, 1]]
    expected = [[0, 0.1, 0.1, 0.1], [9, 9, 9.1, 9.2], [0.2, 0.2, 0.2, 0.3]]
    assert_close(tracks.points[..., 0], np.array(expected), atol=EXACT_ABS)
    assert tracks.ids.tolist() == [[0], [2], [3]]


def test_track_points__a_new_set_of_gaussians_is_not_the_old_one(tmp_path: Path) -> None:
    with StreamWriter(tmp_path / "s.morgs", [CAMERA], 10) as writer:
        for t in range(2):
            writer.write(keyframe_packet(isotropic(np.zeros((1, 3)) + t, 0.1, 0.9), t, [CAMERA]))
    tracks = track_points(StreamReader(tmp_path / "s.morgs"), [(0, 0, 0), (1, 1, 1)], [0, 1])
    assert tracks.alive.tolist() == [[True, False], [False, True]]
    assert tracks.ids[:, 0].tolist() == [0, 1]
    assert (tracks.ids[:, 1:] == -1).all()


def test_track_points__refuses_wrong_arguments(tmp_path: Path) -> None:
    stream = write(tmp_path / "s.morgs", [isotropic(np.zeros((1, 3)), 0.1, 0.9)] * 2)
    for points, frame, count, message in (
        (np.zeros(3), 0, 1, r"`points` must be \[P, 3\] and finite, got \(3,\)"),
        ([(0, 0, np.nan)], 0, 1, "`points` must be .* finite"),
        (
            np.zeros((2, 3)),
            [0],
            1,
            r"`frame` must be an integer or integers \[2\], got int64 \(1,\)",
        ),
        (np.zeros((2, 3)), 0.5, 1, "`frame` must be an integer"),
        (np.zeros((1, 3)), 2, 1, r"`frame` must be a frame of .*s.morgs, got 2"),
        (np.zeros((1, 3)), -1, 1, "`frame` must be a frame of .*, got -1"),
        (np.zeros((1, 3)), 0, 0, "`num_gaussians` must be at least 1, got 0"),
    ):
        with pytest.raises(ValueError, match=message):
            track_points(stream, points, frame, count)
    assert track_points(stream, np.zeros((0, 3)), 0).points.shape == (0, 2, 3)


def test_seen_in_depth__compares_with_the_rendered_surface() -> None:
    """A wall at a depth of 4 covers the left half of the image."""
    wall = np.arange(40) + 0 * np.arange(30)[:, None] < 20
    points = np.array(
        [(-1, 0, 0), (-1, 0, -1), (-1, 0, 0.05), (-1, 0, 1), (1, 0, 1), (9, 0, 0), (0, 0, -9)]
    )
    # On it, in front of it, behind it by 1 % and by 25 %, beside it, outside the image, behind the
    # camera.
    mask = seen_in_depth(np.where(wall, 4.0, 0), wall.astype(float), CAMERA, points)
    assert mask.tolist() == [True, True, True, False, True, False, False]
