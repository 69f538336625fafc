"""Mattes by name in EXR files, as compositing programs read them (Cryptomatte 1.2, Friedman and Jones 2015).

A name is identified by its 32-bit MurmurHash3, stored with the bits of a float. Per pixel, the pairs of identifier and
coverage are sorted by coverage, two of them in the channels R, G, B, A of each layer. The header has the names.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping

import numpy as np

__all__ = ["LAYER", "MOST", "cryptomatte", "name_hash"]

LAYER = "crypto_object"
"""Name of the mattes among the layers of a file."""
MOST = 6
"""Mattes of a pixel that are stored; those that cover least are omitted."""


def name_hash(name: str) -> int:
    """Return the identifier of a name: MurmurHash3_32 of its UTF-8 bytes, changed where it would be no normal float."""
    value = _murmur3(name.encode())
    return value ^ (1 << 23) if value >> 23 & 255 in (0, 255) else value


def cryptomatte(mattes: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return the EXR channels [H, W] and the header's attributes of mattes by name.

    Args:
        mattes: coverage [H, W] in [0, 1] by name, at least one; their sum is at most 1.
    """
    hashes = {name: name_hash(name) for name in mattes}
    ids = np.array(list(hashes.values()), np.uint32).view(np.float32)
    coverage = np.stack([np.asarray(part, np.float32) for part in mattes.values()])
    levels = -(-min(len(ids), MOST) // 2)
    order = np.argsort(-coverage, axis=0, kind="stable")[: 2 * levels]
    ranked = np.take_along_axis(coverage, order, axis=0)
    channels = {}
    for rank in range(2 * levels):
        found = ranked[rank] if rank < len(ranked) else np.zeros_like(coverage[0])
        id_of = np.where(found > 0, ids[order[rank]], 0) if rank < len(ranked) else found
        first, second = ("R", "G") if rank % 2 == 0 else ("B", "A")
        channels |= {f"{LAYER}{rank // 2:02d}.{first}": id_of, f"{LAYER}{rank // 2:02d}.{second}": found}
    key = f"cryptomatte/{name_hash(LAYER):08x}"[:-1]
    manifest = {name: f"{value:08x}" for name, value in hashes.items()}
    values = {
        "name": LAYER,
        "hash": "MurmurHash3_32",
        "conversion": "uint32_to_float32",
        "manifest": json.dumps(manifest, ensure_ascii=False, separators=(",", ":")),
    }
    return channels, {f"{key}/{name}": value for name, value in values.items()}


def _murmur3(data: bytes) -> int:
    """Return the 32-bit MurmurHash3 with seed 0 (Appleby 2011)."""
    h, whole = 0, len(data) & ~3
    for (k,) in struct.iter_unpack("<I", data[:whole]):
        h = (_rotated(h ^ _scrambled(k), 13) * 5 + 0xE6546B64) & 0xFFFFFFFF
    h ^= _scrambled(int.from_bytes(data[whole:], "little")) ^ len(data)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        h = ((h ^ (h >> shift)) * factor) & 0xFFFFFFFF
    return h ^ (h >> 16)


def _scrambled(k: int) -> int:
    return (_rotated(k * 0xCC9E2D51 & 0xFFFFFFFF, 15) * 0x1B873593) & 0xFFFFFFFF


def _rotated(value: int, bits: int) -> int:
    return (value << bits | value >> (32 - bits)) & 0xFFFFFFFF
