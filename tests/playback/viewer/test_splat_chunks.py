"""Which Gaussians the page has, and how many bytes it is sent."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from morgs_mi.playback.viewer.splat_chunks import SplatChunks, packed_splats

COUNT, MOVING = 20_000, 1000


class Scene:
    """Scene of a page that holds the buffers and counts the rows that it is sent."""

    def __init__(self) -> None:
        self.chunks: dict[str, Any] = {}
        self.sent = 0

    def add_gaussian_splats(self, name: str, *_: np.ndarray) -> Any:
        scene = self

        class Chunk(SimpleNamespace):
            def __setattr__(self, key: str, value: Any) -> None:
                scene.sent += len(value) if key == "buffer" else 0
                super().__setattr__(key, value)

        self.chunks[name] = Chunk(remove=lambda: self.chunks.pop(name))
        return self.chunks[name]

    def received(self) -> int:
        """Return the number of rows since the last call."""
        sent, self.sent = self.sent, 0
        return sent

    def splats(self) -> np.ndarray:
        """Return the rows that are not transparent, in order."""
        rows = np.concatenate([chunk.buffer for chunk in self.chunks.values()])
        return in_order(rows[rows[:, 7] >> 24 > 0])


def in_order(rows: np.ndarray) -> np.ndarray:
    return rows[np.lexsort(rows.T)]


def random_splats(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    covariances = 0.01 * np.eye(3) * rng.uniform(0.5, 1, (count, 1, 1))
    colors = np.full((count, 3), 200, np.uint8)
    return packed_splats(rng.normal(size=(count, 3)), covariances, colors, np.full(count, 0.8))


def moved(splats: np.ndarray, rows: np.ndarray) -> np.ndarray:
    splats = splats.copy()
    centers = splats[:, :3].view(np.float32)
    centers[rows] += np.float32(0.01)
    splats[:, :3] = centers.view(np.uint32)
    return splats


def test_packed_splats__are_those_of_viser():
    viser = pytest.importorskip("viser", reason="install it with pip install 'morgs-mi[viewer]'")
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(50, 3, 3))
    arguments = rng.normal(size=(50, 3)), axes @ axes.transpose(0, 2, 1), rng.integers(0, 256, (50, 3), np.uint8)
    opacities = rng.uniform(size=50)
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        expected = server.scene.add_gaussian_splats("/splats", *arguments, opacities[:, None]).buffer
    finally:
        server.stop()
    np.testing.assert_array_equal(packed_splats(*arguments, opacities), expected)


def test_splat_chunks__show_births_deaths_and_no_others():
    rng, scene = np.random.default_rng(1), Scene()
    chunks, splats = SplatChunks(scene), random_splats(3000)
    for count in (100, 103, 60, 0, 2000, 150, 3000):
        ids = np.sort(rng.choice(3000, count, replace=False))
        chunks.show(ids, splats[ids])
        np.testing.assert_array_equal(scene.splats(), in_order(splats[ids]))


@pytest.mark.parametrize("scattered", [False, True])
def test_splat_chunks__send_what_changes(scattered):
    scene, splats, ids = Scene(), random_splats(COUNT), np.arange(COUNT)
    chunks = SplatChunks(scene)
    chunks.show(ids, splats)
    assert len(scene.chunks) == 1
    assert scene.received() < 1.15 * COUNT
    nearest = np.argsort(np.linalg.norm(splats[:, :3].view(np.float32) - 1, axis=1))
    moving = np.random.default_rng(2).permutation(COUNT)[:MOVING] if scattered else nearest[:MOVING]
    received = []
    for _ in range(8):
        splats = moved(splats, moving)
        chunks.show(ids, splats)
        received.append(scene.received())
        np.testing.assert_array_equal(scene.splats(), in_order(splats))
    # The first change sends all Gaussians in chunks, those that have changed in the first ones.
    assert max(received[1:]) < 2 * MOVING
    assert sum(received) < 2 * COUNT


def test_splat_chunks__gather_changes_that_are_scattered_later():
    scene, splats, ids = Scene(), random_splats(COUNT), np.arange(COUNT)
    chunks, received = SplatChunks(scene), []
    chunks.show(ids, splats)
    for seed in (2, 3):
        moving = np.random.default_rng(seed).permutation(COUNT)[:MOVING]
        for _ in range(6):
            splats = moved(splats, moving)
            chunks.show(ids, splats)
            received.append(scene.received())
            np.testing.assert_array_equal(scene.splats(), in_order(splats))
    # The rows that did not change outnumber the Gaussians twice, then all are sent again.
    assert max(received[-2:]) < 4 * MOVING


def test_splat_chunks__send_nothing_for_the_same_gaussians_and_all_for_other_colours():
    scene, splats, ids = Scene(), random_splats(COUNT), np.arange(COUNT)
    chunks = SplatChunks(scene)
    chunks.show(ids, splats)
    scene.received()
    chunks.show(ids, splats)
    assert scene.received() == 0
    for level in range(5):
        splats[:, 7] = (splats[:, 7] & 0xFFFFFF00) | level
        chunks.show(ids, splats)
        assert COUNT <= scene.received() < 1.15 * COUNT
