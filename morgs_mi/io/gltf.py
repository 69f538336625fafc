"""Reader of animated glTF 2.0 files (.glb, or .gltf with its files): meshes, skins, materials and animations as arrays.

Of https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html it reads triangles with the first set of texture
coordinates, any number of joints per vertex, morph targets, sparse and quantised accessors, and the base colour,
roughness and metalness of materials. Cameras, lights and other texture maps are left out.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from morgs_mi.io.gltf_data import GltfData
from morgs_mi.io.video import decode_image

__all__ = ["Animation", "Channel", "Gltf", "Material", "Node", "Primitive", "Skin", "Texture", "read_gltf"]

_TRIANGLES = 4
# Components of an animated value; of morph weights, as many as there are targets.
_PATHS = {"translation": 3, "rotation": 4, "scale": 3, "weights": -1}
_INTERPOLATIONS = ("LINEAR", "STEP", "CUBICSPLINE")
# Quantised accessors are read like all others. Materials look different without their extensions, but move as they do.
_READ_EXTENSIONS = ("KHR_mesh_quantization", "KHR_materials_")
_WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_BROKEN = (
    *(KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError, RecursionError, MemoryError),
    *(OSError, struct.error),
)
# Nodes of a file, and bytes of a posed vertex: its position and normal as float64.
_MAX_NODES, _VERTEX_BYTES = 5000, 48


@dataclass(frozen=True)
class Primitive:
    """Triangles with one material; V vertices.

    Attributes:
        positions: [V, 3] in the space of the mesh.
        faces: vertex indices [F, 3].
        uvs: texture coordinates [V, 2] with the origin at the upper left; None without a texture.
        normals: unit normals [V, 3]; None for flat faces.
        joints: indices into the joints of a skin [V, J]; None without one.
        weights: of the joints [V, J], with a sum of 1.
        targets: displacements of the positions by each morph target [K, V, 3].
        normal_targets: the same of the normals.
        material: index into `Gltf.materials`; -1 for glTF's default.
    """

    positions: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray | None
    normals: np.ndarray | None
    joints: np.ndarray | None
    weights: np.ndarray | None
    targets: np.ndarray
    normal_targets: np.ndarray
    material: int


@dataclass(frozen=True)
class Texture:
    """An image with its behaviour outside of [0, 1].

    Attributes:
        image: uint8 [H, W, 3].
        wrap: ``repeat``, ``clamp`` or ``mirror``.
    """

    image: np.ndarray
    wrap: str = "repeat"


@dataclass(frozen=True)
class Material:
    """A material of metallic-roughness.

    Attributes:
        color: base colour [3], linear; a factor on its texture.
        color_texture: sRGB-encoded.
        roughness: a factor on the green of its texture.
        metallic: a factor on the blue of its texture.
        surface_texture: roughness and metalness.
    """

    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    color_texture: Texture | None = None
    roughness: float = 1.0
    metallic: float = 1.0
    surface_texture: Texture | None = None


@dataclass(frozen=True)
class Node:
    """A node of the hierarchy.

    Attributes:
        name: empty if it has none.
        parent: its index; -1 for a root.
        matrix: to the parent [4, 4], of a node that has no separate transforms.
        translation: [3].
        rotation: unit quaternion [4], xyzw.
        scale: [3].
        mesh: index into `Gltf.meshes`; -1 for none.
        skin: index into `Gltf.skins`; -1 for none.
        weights: of the morph targets [K].
        drawn: whether it is in the scene.
    """

    name: str
    parent: int
    matrix: np.ndarray | None
    translation: np.ndarray
    rotation: np.ndarray
    scale: np.ndarray
    mesh: int
    skin: int
    weights: np.ndarray
    drawn: bool


@dataclass(frozen=True)
class Skin:
    """The joints of a skinned mesh.

    Attributes:
        joints: indices of nodes [J].
        inverse_bind: from the mesh's space to each joint's, in the pose of the mesh [J, 4, 4].
    """

    joints: np.ndarray
    inverse_bind: np.ndarray


@dataclass(frozen=True)
class Channel:
    """Keys of one property of a node.

    Attributes:
        node: its index.
        path: ``translation``, ``rotation``, ``scale`` or ``weights``.
        times: seconds, ascending [N].
        values: [N, D]; [N, 3, D] for CUBICSPLINE: in-tangent, value and out-tangent.
        interpolation: ``LINEAR``, ``STEP`` or ``CUBICSPLINE``.
    """

    node: int
    path: str
    times: np.ndarray
    values: np.ndarray
    interpolation: str


@dataclass(frozen=True)
class Animation:
    """An animation.

    Attributes:
        name: its own, or ``animation0`` etc.
        channels: keys of the properties that it moves.
    """

    name: str
    channels: tuple[Channel, ...]

    @property
    def duration(self) -> float:
        """Seconds from 0 to the last key."""
        return max((float(channel.times[-1]) for channel in self.channels), default=0.0)


@dataclass(frozen=True, eq=False)
class Gltf:
    """The content of a file.

    Attributes:
        nodes: all nodes.
        order: indices of the nodes, parents before their children.
        meshes: primitives of each mesh.
        skins: joints of skinned meshes.
        materials: materials of primitives.
        animations: in the order of the file.
    """

    nodes: tuple[Node, ...]
    order: tuple[int, ...]
    meshes: tuple[tuple[Primitive, ...], ...]
    skins: tuple[Skin, ...]
    materials: tuple[Material, ...]
    animations: tuple[Animation, ...]


def read_gltf(path: str | Path) -> Gltf:
    """Read a .glb file, or a .gltf file with the files that it names.

    Raises:
        FileNotFoundError: the file, or one that it names, does not exist.
        ValueError: the file is broken, or needs an extension or a kind of primitive that is not read.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a glTF file, got none; check the path.")
    try:
        reader = _Reader(path)
        reader.check()
        return reader.read()
    except _BROKEN as error:
        if str(error).startswith(f"{path}: "):  # it has its sentence
            raise
        reason = f"{type(error).__name__}: {error}".rstrip(".")
        raise ValueError(f"{path}: expected a glTF 2.0 file, got a broken one ({reason}); export it again.") from None


class _Reader(GltfData):
    """The parts of a file that refer to one another by index."""

    def check(self) -> None:
        """Raise `ValueError` if the file is of another version, or needs an extension that is not read."""
        required = [e for e in self.document.get("extensionsRequired", []) if not e.startswith(_READ_EXTENSIONS)]
        if required:
            raise self.refused(
                f"expected a file without required extensions, got {', '.join(required)}; export it without compression"
                " and other extensions"
            )
        if not str(self.document["asset"]["version"]).startswith("2."):
            raise self.refused(f"expected glTF 2.0, got {self.document['asset']['version']}; export it as glTF 2.0")

    def read(self) -> Gltf:
        meshes = tuple(tuple(self.primitive(i, p) for p in m["primitives"]) for i, m in enumerate(self.all("meshes")))
        skins = tuple(map(self.skin, self.all("skins")))
        nodes, order = self.nodes(meshes, skins)
        animations = tuple(self.animation(i, a, nodes) for i, a in enumerate(self.all("animations")))
        return Gltf(nodes, order, meshes, skins, tuple(map(self.material, self.all("materials"))), animations)

    def nodes(self, meshes: Sequence[Sequence[Primitive]], skins: Sequence[Skin]) -> tuple[tuple[Node, ...], Any]:
        """Return the nodes, and their indices with parents before children."""
        items = self.all("nodes")
        if len(items) > _MAX_NODES:
            raise self.refused(f"expected at most {_MAX_NODES} nodes, got {len(items)}; export fewer objects")
        parents = np.full(len(items), -1)
        for index, item in enumerate(items):
            for child in item.get("children", ()):
                self.check_index("nodes", child)
                if parents[child] >= 0:
                    raise self.refused(f"expected a node {child} with one parent, got another; export it again")
                parents[child] = index
        order = [int(root) for root in np.flatnonzero(parents < 0)]
        for index in order:  # which grows
            order += items[index].get("children", ())
        if len(order) < len(items):
            raise self.refused("expected a hierarchy of nodes, got a cycle; export it again")
        drawn = set(order)
        if self.all("scenes"):
            drawn = set(self.entry("scenes", self.document.get("scene", 0)).get("nodes", ()))
        for index in drawn:
            self.check_index("nodes", index)
        for index in order:
            if parents[index] in drawn:
                drawn.add(index)
        found = [self.node(item, int(parents[i]), i in drawn, meshes) for i, item in enumerate(items)]
        for index, node in enumerate(found):
            self.check_node(index, node, meshes, skins)
        return tuple(found), tuple(order)

    def node(self, item: dict[str, Any], parent: int, drawn: bool, meshes: Sequence[Sequence[Primitive]]) -> Node:
        mesh, skin, count, default = item.get("mesh", -1), item.get("skin", -1), 0, []
        if "skin" in item:
            self.check_index("skins", skin)
        if "mesh" in item:
            default = self.entry("meshes", mesh).get("weights")
            count = len(meshes[mesh][0].targets)
            self.claim(_VERTEX_BYTES * sum(len(primitive.positions) for primitive in meshes[mesh]), "a mesh of a node")
        where = f"node {item.get('name', '')!r}"
        return Node(
            str(item.get("name", "")),
            parent,
            self.numbers(where, item["matrix"], 4, 4).T if "matrix" in item else None,
            self.numbers(where, item.get("translation", (0, 0, 0)), 3),
            self.numbers(where, item.get("rotation", (0, 0, 0, 1)), 4),
            self.numbers(where, item.get("scale", (1, 1, 1)), 3),
            mesh,
            skin,
            self.numbers(where, item.get("weights", default or [0.0] * count), count),
            drawn,
        )

    def check_node(self, index: int, node: Node, meshes: Sequence[Sequence[Primitive]], skins: Sequence[Skin]) -> None:
        self.check_rotations(f"node {index}", node.rotation)
        if node.mesh < 0:
            return
        counts = {len(primitive.targets) for primitive in meshes[node.mesh]}
        if len(counts) > 1:
            raise self.refused(
                f"mesh {node.mesh}: expected as many morph targets in all its primitives, got {sorted(counts)}; export "
                "it again"
            )
        if node.skin < 0:
            return
        for primitive in meshes[node.mesh]:
            if primitive.joints is None or primitive.joints.max(initial=0) >= len(skins[node.skin].joints):
                raise self.refused(
                    f"node {index}: expected vertices with joints of its skin, got none or too large ones; export it "
                    "again"
                )

    def skin(self, item: dict[str, Any]) -> Skin:
        for joint in item["joints"]:
            self.check_index("nodes", joint)
        joints = np.array(item["joints"], int)
        if not len(joints):
            raise self.refused("expected skins with joints, got one without; export it again")
        if "inverseBindMatrices" not in item:
            return Skin(joints, np.tile(np.eye(4), (len(joints), 1, 1)))
        # glTF stores matrices by columns.
        matrices = self.accessor(item["inverseBindMatrices"], "MAT4").reshape(-1, 4, 4).swapaxes(1, 2)
        if len(matrices) < len(joints):
            raise self.refused(f"expected {len(joints)} inverse bind matrices, got {len(matrices)}; export it again")
        return Skin(joints, matrices[: len(joints)])

    def primitive(self, mesh: int, item: dict[str, Any]) -> Primitive:
        if item.get("mode", _TRIANGLES) != _TRIANGLES:
            raise self.refused(
                f"mesh {mesh}: expected triangles, got primitives of mode {item['mode']}; export triangles only"
            )
        if "material" in item:
            self.check_index("materials", item["material"])
        attributes = item["attributes"]
        positions = self.accessor(attributes["POSITION"], "VEC3")
        count = len(positions)
        faces = self.indices(item["indices"], "SCALAR") if "indices" in item else np.arange(count)
        faces = faces.reshape(-1, 3)
        if not len(faces) or faces.max() >= count:
            raise self.refused(f"mesh {mesh}: expected faces with its {count} vertices, got others; export it again")

        def optional(name: str, kind: str) -> np.ndarray | None:
            return self.accessor(attributes[name], kind, count) if name in attributes else None

        sets = [i for i in range(len(attributes)) if f"JOINTS_{i}" in attributes]
        joints = [self.indices(attributes[f"JOINTS_{i}"], "VEC4", count) for i in sets]
        weights = [self.accessor(attributes[f"WEIGHTS_{i}"], "VEC4", count) for i in sets]
        targets = item.get("targets", [])
        return Primitive(
            positions,
            faces,
            optional("TEXCOORD_0", "VEC2"),
            optional("NORMAL", "VEC3"),
            np.concatenate(joints, axis=1) if sets else None,
            _normalized(np.concatenate(weights, axis=1)) if sets else None,
            self.displacements(targets, "POSITION", count),
            self.displacements(targets, "NORMAL", count),
            item.get("material", -1),
        )

    def displacements(self, targets: list[dict[str, int]], name: str, count: int) -> np.ndarray:
        """Return an attribute of the morph targets [K, V, 3], zero in those that do not have it."""
        none = np.zeros((count, 3))
        self.claim(none.nbytes * len(targets), f"{len(targets)} morph targets")
        found = [self.accessor(target[name], "VEC3", count) if name in target else none for target in targets]
        return np.stack(found) if found else np.zeros((0, count, 3))

    def animation(self, index: int, item: dict[str, Any], nodes: Sequence[Node]) -> Animation:
        name = str(item.get("name") or f"animation{index}")
        # Channels without a node, and channels of extensions, have no effect.
        own = [c for c in item["channels"] if c["target"]["path"] in _PATHS and "node" in c["target"]]
        if len({(c["target"]["node"], c["target"]["path"]) for c in own}) < len(own):
            raise self.refused(
                f"animation {name!r}: expected one channel for a property of a node, got several; export it again"
            )
        if wrong := [c["sampler"] for c in own if c["sampler"] < 0]:
            raise self.refused(f"animation {name!r}: expected samplers of its own, got {wrong[0]}; export it again")
        channels = (self.channel(name, c["target"], item["samplers"][c["sampler"]], nodes) for c in own)
        return Animation(name, tuple(channels))

    def channel(self, name: str, target: dict[str, Any], sampler: dict[str, Any], nodes: Sequence[Node]) -> Channel:
        node, path, interpolation = target["node"], target["path"], sampler.get("interpolation", "LINEAR")
        self.check_index("nodes", node)
        times = self.accessor(sampler["input"], "SCALAR")[:, 0]
        values = self.accessor(sampler["output"])
        columns = len(nodes[node].weights) if path == "weights" else _PATHS[path]
        shape = (len(times), 3, columns) if interpolation == "CUBICSPLINE" else (len(times), columns)
        fits = interpolation in _INTERPOLATIONS and values.size == np.prod(shape)
        if not fits or not len(times) or (np.diff(times) <= 0).any():
            raise self.refused(
                f"animation {name!r}, {path} of node {node}: expected ascending times with a value of {columns} "
                f"numbers each, got {len(times)} times, {values.size} numbers and {interpolation}; export it again"
            )
        values = values.reshape(shape)
        if path == "rotation":
            self.check_rotations(f"animation {name!r}", values[:, 1] if interpolation == "CUBICSPLINE" else values)
        return Channel(node, path, times, values, interpolation)

    def check_rotations(self, where: str, quaternions: np.ndarray) -> None:
        """Raise `ValueError` if a quaternion of [..., 4] is zero, which is no rotation."""
        if not np.linalg.norm(quaternions, axis=-1).all():
            raise self.refused(f"{where}: expected quaternions of length 1 as rotations, got zeros; export it again")

    def material(self, item: dict[str, Any]) -> Material:
        surface = item.get("pbrMetallicRoughness", {})
        red, green, blue, _ = self.numbers("material", surface.get("baseColorFactor", (1, 1, 1, 1)), 4).tolist()
        return Material(
            (red, green, blue),
            self.texture(surface.get("baseColorTexture")),
            self.numbers("material", surface.get("roughnessFactor", 1)).item(),
            self.numbers("material", surface.get("metallicFactor", 1)).item(),
            self.texture(surface.get("metallicRoughnessTexture")),
        )

    def texture(self, item: dict[str, Any] | None) -> Texture | None:
        if item is None:
            return None
        if item.get("texCoord", 0):
            raise self.refused("expected textures that use TEXCOORD_0, got another set; export one set only")
        texture = self.entry("textures", item["index"])
        image = self.entry("images", texture["source"])
        data = self.view(image["bufferView"]) if "bufferView" in image else self.resource(image["uri"])
        pixels = decode_image(self.path, np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        self.claim(pixels.nbytes, "an image")
        wrap = self.entry("samplers", texture["sampler"]).get("wrapS", 10497) if "sampler" in texture else 10497
        return Texture(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), _WRAPS[wrap])


def _normalized(weights: np.ndarray) -> np.ndarray:
    """Return joint weights [V, J] with a sum of 1; a vertex without weights follows its first joint."""
    total = weights.sum(axis=1, keepdims=True)
    first = np.eye(1, weights.shape[1])
    return np.where(total > 0, weights / np.where(total > 0, total, 1), first)
