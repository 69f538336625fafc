"""Objects with moving vertices: their textures, and ground truth that must agree with itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.truth import load_tracks, load_truth
from morgs_mi.synth.path_tracer import PathTracer
from morgs_mi.synth.scene import Deformed, DeformingObject, Mesh, Scene, check_scene
from morgs_mi.synth.synth_config import SynthConfig
from morgs_mi.synth.synthesize import synthesize
from morgs_mi.synth.textures import lights, room
from tests.assertions import assert_close
from tests.synth.frames import FPS, psnr, render_frame

# Upper left, upper right, lower left, lower right; linear RGB.
COLORS = np.float32([[(0.7, 0.02, 0.02), (0.02, 0.7, 0.02)], [(0.02, 0.02, 0.7), (0.7, 0.7, 0.02)]])
CLIP_FPS = 8
TILE = np.array([(-1.4, 0.2, 0.4), (-0.6, 0.2, 0.4), (-1.4, 1.0, 0.4), (-0.6, 1.0, 0.4)])
TILE_FACES = np.array([(0, 1, 2), (1, 3, 2)])
TILE_UVS = np.array([(0, 1), (1, 1), (0, 0), (1, 0)])


def diffuse(reflectance: dict[str, Any]) -> dict[str, Any]:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}


def colored() -> dict[str, Any]:
    """Return a material with `COLORS` in the quarters of its texture."""
    bitmap = mi.Bitmap(np.kron(COLORS, np.ones((8, 8, 1), np.float32)))
    return diffuse({"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"})


def column() -> DeformingObject:
    """Return a square column with rings at y = 0, 0.7 and 1.4, which bends in the xy plane; its foot stays."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * 0.28
    rings = [(corners[side], corners[(side + 1) % 4], height) for side in range(4) for height in (0, 0.7, 1.4)]
    points = np.array([(x, height, z) for *pair, height in rings for x, z in pair])
    normals = np.repeat([(0, 0, -1), (1, 0, 0), (0, 0, 1), (-1, 0, 0)], 6, axis=0).astype(float)
    quads = [6 * side + 2 * ring + np.array([(0, 2, 1), (1, 2, 3)]) for side in range(4) for ring in range(2)]
    uvs = np.stack([np.tile([0.0, 1.0], 12), 1 - points[:, 1] / 1.4], axis=1)

    def shape(time: float) -> Deformed:
        turns = Rotation.from_rotvec(np.outer(0.65 * time * points[:, 1], (0, 0, 1)))
        return Deformed(turns.apply(points), turns.apply(normals))

    return DeformingObject({"mesh": Mesh(np.concatenate(quads), colored(), uvs, smooth=True)}, shape)


def tile() -> DeformingObject:
    """Return a still tile."""
    return DeformingObject({"mesh": Mesh(TILE_FACES, colored(), TILE_UVS)}, lambda time: Deformed(TILE))


def plate() -> DeformingObject:
    """Return a plate that moves as a whole."""
    blue = diffuse({"type": "rgb", "value": [0.2, 0.4, 0.6]})
    return DeformingObject({"mesh": Mesh(TILE_FACES, blue)}, lambda t: Deformed(TILE + np.array([2 - 0.8 * t, 0, 0])))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene("bending", {**room(0), "column": column(), "tile": tile(), "plate": plate()}, lights())


@pytest.fixture(scope="module")
def clip(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene from 3 cameras, 3 frames of 64x48 at 8 frames per second: it moves by several pixels."""
    config = SynthConfig(cameras=3, frames=3, width=64, height=48, spp=4, fps=CLIP_FPS)
    return synthesize(scene, tmp_path_factory.mktemp("bending") / "clip", config)


def test_path_tracer__textures_of_a_mesh_are_upright() -> None:
    """The corners of the tile have the colours of the corners of its image."""
    scene = Scene("tile", {"tile": tile()}, lights())
    corners = TILE[[2, 3, 0, 1]]
    inner = 0.7 * corners + 0.3 * corners.mean(axis=0)
    camera = scene.rig.cameras(2, 320, 240)[0]
    image = PathTracer(scene).render(camera, 4, 0)
    x, y = np.floor(camera.project(inner)[0]).astype(int).T
    for color, expected in zip(image[y, x].astype(float), COLORS.reshape(-1, 3), strict=True):
        assert np.corrcoef(color, expected)[0, 1] > 0.9, (color, expected)


def test_compute_ground_truth__motion_of_a_deforming_surface_warps_its_previous_image(scene: Scene) -> None:
    """The texture follows the surface, so the motion map takes the previous image to the current one."""
    tracer = PathTracer(scene)
    camera = scene.rig.cameras(3, 320, 240)[0]
    (before, truth_before), (now, truth) = (render_frame(tracer, camera, frame) for frame in (14, 15))
    grid = np.stack(np.meshgrid(np.arange(320), np.arange(240)), axis=-1).astype(np.float32)
    index = list(scene.objects).index("column")
    source = np.clip(np.rint(grid - truth.motion).astype(int), 0, [319, 239])
    same = (truth.ids == index) & (truth_before.ids[source[..., 1], source[..., 0]] == index)
    same = cv2.erode(same.astype(np.uint8), np.ones((5, 5))) > 0
    assert same.sum() > 1000

    def score(motion: np.ndarray) -> float:
        return psnr(cv2.remap(before, grid - motion, None, cv2.INTER_CUBIC)[same], now[same])

    assert score(truth.motion) > score(0 * truth.motion) + 3
    assert score(truth.motion) > score(-truth.motion) + 3
    assert score(truth.motion) > score(truth.motion + np.float32([0.5, 0.5])) + 1


def test_synthesize__tracks_of_a_deforming_object_agree_with_its_flow_and_depth(clip: Path) -> None:
    tracks, compared = load_tracks(clip / "truth"), 0
    for camera in load_capture(clip).cameras:
        for frame in (1, 2):
            truth = load_truth(clip / "truth", camera.name, frame)
            now, depth = camera.project(tracks.points[:, frame])
            before, _ = camera.project(tracks.points[:, frame - 1])
            col, row = np.floor(now).astype(int).T
            centred = (np.abs(now - np.floor(now) - 0.5).max(axis=1) < 1e-3) & (col >= 0) & (col < 64)
            centred &= (row >= 0) & (row < 48) & (tracks.ids >= 4)
            col, row = col[centred], row[centred]
            same = np.abs(depth[centred] - truth.depth[row, col]) < 1e-4
            assert_close((now - before)[centred][same], truth.motion[row, col][same], atol=2e-3)
            compared += int(same.sum())
    assert compared > 150


def test_synthesize__depth_of_a_deforming_object_lies_on_its_triangles(scene: Scene, clip: Path) -> None:
    """Independent of rays and barycentric coordinates: the unprojected points are in the plane of some triangle."""
    frame, item = 2, column()
    for camera in load_capture(clip).cameras:
        truth = load_truth(clip / "truth", camera.name, frame)
        row, col = np.nonzero(truth.ids == list(scene.objects).index("column"))
        points = camera.unproject(np.stack([col, row], axis=-1) + 0.5, truth.depth[row, col])
        a, b, c = item.shape(frame / CLIP_FPS).vertices[item.meshes["mesh"].faces].transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        distance = np.abs(((points[:, None] - a) * normal).sum(-1)).min(axis=1)
        assert len(points) > 30
        assert distance.max() < 1e-4


def test_synthesize__masks_are_where_the_surface_moves(scene: Scene, clip: Path) -> None:
    truth, names = load_truth(clip / "truth", "cam00", 1), list(scene.objects)
    assert truth.mask[truth.ids == names.index("plate")].all()
    assert truth.mask[truth.ids == names.index("column")].any()
    assert not truth.mask[truth.ids == names.index("tile")].any()
    assert not truth.mask[truth.ids < names.index("column")].any()
    assert (truth.motion[~truth.mask] == 0).all()


TRIANGLE = {"mesh": Mesh(np.array([[0, 1, 2]]), {"type": "diffuse"})}
SMOOTH = {"mesh": Mesh(np.array([[0, 1, 2]]), {"type": "diffuse"}, smooth=True)}


@pytest.mark.parametrize(
    ("meshes", "shape", "message"),
    [
        (
            TRIANGLE,
            lambda t: Deformed(np.eye(3)[:2]),
            r"its vertices at 0 s must be finite \[V, 3\] with V of at least 3, got the shape \(2, 3\)",
        ),
        (TRIANGLE, lambda t: Deformed(np.eye(3) / t), "its vertices at 0 s must be finite .*, got NaN or infinity"),
        (TRIANGLE, lambda t: 1 / 0, "its shape at 0 s fails with ZeroDivisionError: division by zero; correct"),
        (SMOOTH, lambda t: Deformed(np.eye(3)), r"its normals at 0 s must be \(3, 3\) for smooth meshes, got None"),
    ],
)
@pytest.mark.filterwarnings("ignore:divide by zero", "ignore:invalid value")
def test_check_scene__refuses_wrong_shapes(meshes: dict, shape, message: str) -> None:
    wrong = Scene("mine", {"a": DeformingObject(meshes, shape)}, lights())
    with pytest.raises(ValueError, match=f"^scene 'mine', object 'a': {message}"):
        check_scene(wrong, [0.0, 1 / FPS])
