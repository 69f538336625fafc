"""An animated glTF model in the room: its place, its textures, and ground truth that must agree with itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.truth import load_tracks, load_truth
from morgs_mi.io.gltf import read_gltf
from morgs_mi.synth.gltf_scene import gltf_scene
from morgs_mi.synth.path_tracer import PathTracer
from morgs_mi.synth.scene import Deformed, DeformingObject, Mesh, Scene, check_scene
from morgs_mi.synth.synth_config import SynthConfig
from morgs_mi.synth.synthesize import synthesize
from morgs_mi.synth.textures import lights
from tests.assertions import assert_close
from tests.scenes.animated_gltf import COLORS, model, write_glb
from tests.synth.frames import FPS, psnr, render_frame

NAMES = ["column", "tile", "floor_2"]  # the last differs from the floor of the room


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return gltf_scene(write_glb(tmp_path_factory.mktemp("gltf") / "model.glb"))


@pytest.fixture(scope="module")
def bending(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The model from 3 cameras, 3 frames of 64x48 at 8 frames per second: it moves by several pixels."""
    folder = tmp_path_factory.mktemp("gltf")
    config = SynthConfig(cameras=3, frames=3, width=64, height=48, spp=4, fps=8, animation="bend")
    return synthesize(write_glb(folder / "model.glb"), folder / "clip", config)


def moving_objects(scene: Scene) -> dict[str, DeformingObject]:
    return {name: item for name, item in scene.objects.items() if isinstance(item, DeformingObject)}


def test_gltf_scene__stands_on_the_floor_inside_the_room(scene: Scene) -> None:
    assert list(moving_objects(scene)) == NAMES
    check_scene(scene, [0.0])
    shapes = [item.shape(t).vertices for item in moving_objects(scene).values() for t in np.linspace(0, 1, 48)[:-1]]
    points = np.concatenate(shapes)
    assert abs(points[:, 1].min()) < 0.02
    assert (np.abs(points[:, 0]) < 1.5).all()
    assert (np.abs(points[:, 2] - 0.2) < 1.3).all()
    assert points[:, 1].max() < 1.8
    assert np.ptp(points, axis=0).max() > 1.4


def test_gltf_scene__repeats_the_animation(scene: Scene) -> None:
    for item in moving_objects(scene).values():
        assert_close(item.shape(-0.75).vertices, item.shape(0.25).vertices, atol=1e-12)
        assert_close(item.shape(3.25).vertices, item.shape(0.25).vertices, atol=1e-12)


def test_gltf_scene__names_the_animations_of_the_file(tmp_path: Path) -> None:
    path = write_glb(tmp_path / "model.glb")
    with pytest.raises(ValueError, match=f"`animation` must be one of 'bend', 'rest' of {path}, got 'walk'"):
        gltf_scene(path, "walk")
    with pytest.raises(ValueError, match="`animation` is for glTF files, got another scene"):
        synthesize("spheres", tmp_path / "clip", SynthConfig(animation="walk"))


@pytest.mark.parametrize(
    ("entry", "value", "message"),
    [
        ("animations", [], "expected an animation, got none; export the model with its animation"),
        ("scenes", [{"nodes": [1]}], "expected a mesh in the scene, got none"),
    ],
)
def test_gltf_scene__refuses_a_model_without_mesh_or_animation(
    tmp_path: Path, entry: str, value: object, message: str
) -> None:
    b = model()
    b.document[entry] = value
    path = write_glb(tmp_path / "model.glb", b)
    with pytest.raises(ValueError, match=f"^{path}: {message}"):
        gltf_scene(path)


def test_gltf_scene__textures_are_upright(scene: Scene) -> None:
    """The corners of the still tile, seen from the front, have the colours of the corners of its image."""
    tile = moving_objects(scene)["tile"]
    corners = tile.shape(0.0).vertices[[2, 3, 0, 1]]  # upper left, upper right, lower left, lower right
    inner = 0.7 * corners + 0.3 * corners.mean(axis=0)
    tracer = PathTracer(replace(scene, objects={"tile": tile}))
    camera = scene.rig.cameras(2, 320, 240)[0]
    image = tracer.render(camera, 4, 0)
    x, y = np.floor(camera.project(inner)[0]).astype(int).T
    found = image[y, x].astype(float)
    for color, expected in zip(found, COLORS.reshape(-1, 3).astype(float), strict=True):
        assert np.corrcoef(color, expected)[0, 1] > 0.9, (found, expected)


def test_compute_ground_truth__motion_of_a_deforming_surface_warps_its_previous_image(scene: Scene) -> None:
    """The texture follows the surface, so the motion map takes the previous image to the current one."""
    tracer = PathTracer(scene)
    camera = scene.rig.cameras(3, 320, 240)[0]
    (before, truth_before), (now, truth) = (render_frame(tracer, camera, frame) for frame in (14, 15))
    grid = np.stack(np.meshgrid(np.arange(320), np.arange(240)), axis=-1).astype(np.float32)
    own = list(scene.objects).index("column")
    source = np.clip(np.rint(grid - truth.motion).astype(int), 0, [319, 239])
    same = (truth.ids == own) & (truth_before.ids[source[..., 1], source[..., 0]] == own)
    same = cv2.erode(same.astype(np.uint8), np.ones((5, 5))) > 0
    assert same.sum() > 1000

    def score(motion: np.ndarray) -> float:
        return psnr(cv2.remap(before, grid - motion, None, cv2.INTER_CUBIC)[same], now[same])

    assert score(truth.motion) > score(0 * truth.motion) + 3
    assert score(truth.motion) > score(-truth.motion) + 3
    assert score(truth.motion) > score(truth.motion + np.float32([0.5, 0.5])) + 1


def test_synthesize__tracks_of_a_deforming_model_agree_with_its_flow_and_depth(bending: Path) -> None:
    tracks, cameras = load_tracks(bending / "truth"), load_capture(bending).cameras
    compared = 0
    for camera in cameras:
        for frame in (1, 2):
            truth = load_truth(bending / "truth", camera.name, frame)
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


def test_synthesize__depth_of_a_deforming_model_lies_on_its_triangles(bending: Path) -> None:
    """Independent of rays and barycentric coordinates: the unprojected points are in the plane of some triangle."""
    scene = gltf_scene(bending.parent / "model.glb")
    objects, frame = list(scene.objects), 2
    for camera in load_capture(bending).cameras:
        truth = load_truth(bending / "truth", camera.name, frame)
        row, col = np.nonzero(truth.ids == objects.index("column"))
        points = camera.unproject(np.stack([col, row], axis=-1) + 0.5, truth.depth[row, col])
        column = moving_objects(scene)["column"]
        a, b, c = column.shape(frame / 8).vertices[column.meshes["mesh0"].faces].transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        distance = np.abs(((points[:, None] - a) * normal).sum(-1)).min(axis=1)
        assert len(points) > 30
        assert distance.max() < 1e-4


def test_synthesize__masks_are_where_the_surface_moves(bending: Path) -> None:
    """All of the moving node moves; of the column, what its bending joint does not hold stays."""
    scene = gltf_scene(bending.parent / "model.glb")
    column = moving_objects(scene)["column"]
    here, there = (column.shape(t).vertices for t in (1 / 8, 0.0))
    still = np.linalg.norm(here - there, axis=1) < 1e-9
    assert 0 < still.sum() < len(still)
    truth = load_truth(bending / "truth", "cam00", 1)
    ids = list(scene.objects)
    assert truth.mask[truth.ids == ids.index("floor_2")].all()
    assert not truth.mask[truth.ids < 4].any()
    assert (truth.motion[~truth.mask] == 0).all()


def test_synthesize__scales_a_model_of_any_size(tmp_path: Path) -> None:
    b = model()
    b.document["nodes"].append({"name": "all", "scale": [900, 900, 900], "children": [1, 3, 5]})
    b.document["scenes"] = [{"nodes": [0, len(b.document["nodes"]) - 1]}]
    large = gltf_scene(write_glb(tmp_path / "large.glb", b))
    small = gltf_scene(write_glb(tmp_path / "small.glb"))
    for name in NAMES:
        found, expected = (moving_objects(s)[name].shape(0.4).vertices for s in (large, small))
        assert_close(found, expected, atol=1e-5)


def test_gltf_scene__uses_the_normals_of_the_file(scene: Scene) -> None:
    column, tile = (moving_objects(scene)[name] for name in ("column", "tile"))
    assert column.meshes["mesh0"].smooth
    assert not tile.meshes["mesh0"].smooth
    assert tile.shape(0.0).normals is None


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


def test_read_gltf__agrees_with_the_scene_on_the_number_of_vertices(scene: Scene, tmp_path: Path) -> None:
    found = read_gltf(write_glb(tmp_path / "model.glb"))
    for (primitive,), item in zip(found.meshes, moving_objects(scene).values(), strict=True):
        assert len(item.shape(0.0).vertices) == len(primitive.positions)


@pytest.mark.filterwarnings("error")
def test_gltf_scene__refuses_scales_whose_product_overflows(tmp_path: Path) -> None:
    b = model()
    count = len(b.document["nodes"])
    b.document["nodes"] += [{"scale": [1e12] * 3, "children": [count + i + 1]} for i in range(60)] + [{"mesh": 2}]
    b.document["scenes"][0]["nodes"].append(count)
    path = write_glb(tmp_path / "model.glb", b)
    with pytest.raises(ValueError, match=f"^{path}: expected a model with an extent, got the size"):
        gltf_scene(path)


def test_gltf_scene__numbers_nodes_of_one_name(tmp_path: Path) -> None:
    b = model()
    for node in b.document["nodes"]:
        node["name"] = "a b"
    b.document["nodes"][5]["name"] = "a_b_2"
    assert [*moving_objects(gltf_scene(write_glb(tmp_path / "model.glb", b)))] == ["a_b", "a_b_2", "a_b_2_2"]
