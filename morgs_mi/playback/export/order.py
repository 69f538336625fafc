"""The Gaussians of a stream in an order that lasts."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from morgs_mi.codec.frame_source import FrameSource
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.z_order import equal_cells, z_order


def by_place(stream: FrameSource) -> Iterator[tuple[int, Gaussians]]:
    """Yield (frame, Gaussians) like `play`, with the Gaussians along a Z-order curve of the places
    of their births.

    Neighbours on the curve are neighbours in space and mostly move together. As the place of the
    birth does not change, Gaussians that live in two frames have the same order in both.

    Raises:
        ValueError: a broken packet.
    """
    all_ids = np.zeros(0, np.int64)
    all_keys = np.zeros(0, np.int64)
    cells = None
    for state in stream.states():
        ids = state.lasting_ids
        means = state.gaussians.numpy()["means"]
        if len(ids) and (cells is None or not np.isin(ids, all_ids).any()):
            cells = equal_cells(means)
        births = ~np.isin(ids, all_ids)
        if cells is not None and births.any():
            all_ids = np.concatenate([all_ids, ids[births]])
            all_keys = np.concatenate([all_keys, z_order(means[births], cells)])
        keys = all_keys[np.searchsorted(all_ids, ids)]
        yield state.frame, state.gaussians.select(np.argsort(keys, kind="stable"))
