"""The Gaussians of a stream with the ids that they have for life."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from morgs_mi.codec.container import PacketKind
from morgs_mi.codec.packets import CodedFrame, decode
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.gaussians import Gaussians

__all__ = ["by_place", "frames_with_first_id"]

_CELL_BITS = 10


def frames_with_first_id(stream: StreamReader) -> Iterator[tuple[int, CodedFrame]]:
    """Yield (first_id, frame) for every frame; `first_id` is added to the frame's ids.

    It changes where a keyframe starts a new set of Gaussians with ids from 0, so that no two Gaussians have one id.

    Raises:
        ValueError: a broken packet.
    """
    first_id, coded = 0, None
    for packet in stream:
        if coded is not None and packet.frame == coded.frame:
            continue  # a re-emitted keyframe, from which a receiver can start
        if coded is not None and packet.kind == PacketKind.KEYFRAME:
            first_id += max(coded.next_id, 1)  # also after a set without Gaussians
        coded = decode(coded, packet)
        yield first_id, coded


def by_place(stream: StreamReader) -> Iterator[tuple[int, Gaussians]]:
    """Yield (frame, Gaussians) like `play`, with the Gaussians along a Z-order curve of the places of their births.

    Neighbours on the curve are neighbours in space and mostly move together. As the place of the birth does not change,
    Gaussians that live in two frames have the same order in both.

    Raises:
        ValueError: a broken packet.
    """
    known_ids, known_keys, cells = np.zeros(0, np.int64), np.zeros(0, np.int64), None
    for first_id, coded in frames_with_first_id(stream):
        ids, means = coded.ids.astype(np.int64) + first_id, coded.gaussians.numpy()["means"]
        if len(ids) and (cells is None or not np.isin(ids, known_ids).any()):
            # Cells with equal numbers of Gaussians along each axis, which far ones do not widen.
            cells = np.quantile(means, np.linspace(0, 1, 2**_CELL_BITS + 1)[1:-1], axis=0)
        born = ~np.isin(ids, known_ids)
        if cells is not None and born.any():
            known_ids = np.concatenate([known_ids, ids[born]])
            known_keys = np.concatenate([known_keys, _z_order(means[born], cells)])
        keys = known_keys[np.searchsorted(known_ids, ids)]
        yield coded.frame, coded.gaussians.select(np.argsort(keys, kind="stable"))


def _z_order(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return the places int64 [N] of points [N, 3] on a Z-order curve through a grid with the inner bounds `cells`."""
    keys = np.zeros(len(points), np.int64)
    for axis in range(3):
        index = np.searchsorted(cells[:, axis], points[:, axis])
        for bit in range(_CELL_BITS):
            keys |= (index >> bit & 1) << (3 * bit + axis)
    return keys
