"""The Gaussians of a stream in an order that lasts."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from morgs_mi.codec.packets import frames_with_lasting_ids
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.z_order import equal_cells, z_order


def by_place(stream: StreamReader) -> Iterator[tuple[int, Gaussians]]:
    """Yield (frame, Gaussians) like `play`, with the Gaussians along a Z-order curve of the places of their births.

    Neighbours on the curve are neighbours in space and mostly move together. As the place of the birth does not change,
    Gaussians that live in two frames have the same order in both.

    Raises:
        ValueError: a broken packet.
    """
    known_ids, known_keys, cells = np.zeros(0, np.int64), np.zeros(0, np.int64), None
    for ids, coded in frames_with_lasting_ids(stream):
        means = coded.gaussians.numpy()["means"]
        if len(ids) and (cells is None or not np.isin(ids, known_ids).any()):
            cells = equal_cells(means)
        born = ~np.isin(ids, known_ids)
        if cells is not None and born.any():
            known_ids = np.concatenate([known_ids, ids[born]])
            known_keys = np.concatenate([known_keys, z_order(means[born], cells)])
        keys = known_keys[np.searchsorted(known_ids, ids)]
        yield coded.frame, coded.gaussians.select(np.argsort(keys, kind="stable"))
