"""Damaged and forged streams, made from a short clip with a random generator. Forged packets have
the right CRC.
"""

from __future__ import annotations

import copy
import json
import struct
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from morgs_mi.codec.container import PAYLOAD, PREAMBLE, Packet, PacketKind, decode_packet
from morgs_mi.codec.packets import decode
from tests.scenes.short_clip import sealed

HOSTILE_TEXT = (
    "NaN",
    "-Infinity",
    "1e999",
    "-1e999",
    "1e308",
    "1e-320",
    "0",
    "-1",
    "1.5",
    "true",
    "null",
    '""',
    "[]",
    "{}",
    "2147483648",
    "4294967295",
    "9223372036854775807",
    "18446744073709551616",
    "1" + 400 * "0",
    "[[1,2],[3]]",
    '"\\ud800"',
    '"\\u0000"',
    '"\\u001b[2J"',
    '"../../x"',
    '"auto"',
    '{"a":{"a":{"a":1}}}',
    "[null]",
    '["x","y"]',
    "[" * 200 + "]" * 200,
    "[" * 50_000,
    '{"a":' * 200 + "1" + "}" * 200,
    '"',
    "{",
    "[1,,2]",
    "\xff",
)
HOSTILE_NUMBERS = (
    0,
    1,
    2,
    3,
    4,
    5,
    7,
    16,
    80,
    81,
    255,
    2**16,
    2**20,
    2**24,
    2**30 - 1,
    2**30,
    2**31,
    2**32 - 1,
)
NAMES = ("head", "code", "parent", "offset", "", "x")
DTYPES = (
    "uint8",
    "uint32",
    "float32",
    "float64",
    "int8",
    "object",
    "O",
    "<U9",
    "f4,f4",
    "M8[s]",
    ">u4",
    "void",
    "",
)


def damaged(clip, rng):
    """Return the stream truncated, with flipped bits, or with an overwritten range."""
    data = clip.data
    spoilt = bytearray(data)
    kind = rng.integers(4)
    if kind == 0:
        return data[: rng.integers(len(data))]
    if kind == 3:
        start = rng.integers(len(data))
        length = rng.integers(1, 200)
        size = len(spoilt[start : start + length])
        spoilt[start : start + length] = bytes(size) if rng.random() < 0.5 else rng.bytes(size)
    for at in rng.choice(
        8 * len(data), 1 if kind == 1 else rng.integers(2, 9) if kind == 2 else 0, replace=False
    ):
        spoilt[at // 8] ^= 1 << at % 8
    return bytes(spoilt)


def with_forged_bytes(clip, rng):
    """Change up to three bytes inside one packet."""
    piece = clip.pieces[rng.integers(2, len(clip.pieces))]
    spoilt = bytearray(clip.data[piece.start + PAYLOAD : piece.stop])
    # Half of them among the numbers that determine the sizes of arrays.
    for at in rng.integers(
        0, len(spoilt) if rng.random() < 0.5 else min(120, len(spoilt)), rng.integers(1, 4)
    ):
        spoilt[at] = rng.integers(256)
    packet = sealed(bytes(spoilt), piece.kind, piece.frame)
    return clip.data[: piece.start] + packet + clip.data[piece.stop :]


def with_forged_packets(clip, rng):
    """Change numbers, tables, codes, kinds, frames and the order of packets; half of the time the
    parents fit again.
    """
    packets = [Draft.of(clip, piece) for piece in clip.pieces[2:]]
    changes = (_table, _head, _head, _code, _code, _number, _order, _index)
    for _ in range(rng.integers(1, 4)):
        _any(changes, rng)(packets, rng)
    if rng.random() < 0.5:
        _continue(packets)
    header = clip.data[: clip.pieces[1].stop]
    return header + b"".join(packet.sealed() for packet in packets)


def with_forged_header(clip, rng):
    """Replace, remove or add entries of the header."""
    header = json.loads(clip.data[clip.pieces[1].start + PAYLOAD : clip.pieces[1].stop])
    marks = []
    for _ in range(rng.integers(1, 3)):
        parent = _any([node for node in _nodes(header) if node], rng)
        key = _any(list(parent) if isinstance(parent, dict) else range(len(parent)), rng)
        if rng.random() < 0.1:
            del parent[key]
        else:
            marks.append(f"MARK{len(marks)}")
            parent["added" if isinstance(parent, dict) and rng.random() < 0.1 else key] = marks[-1]
    text = json.dumps(header)
    for mark in marks:
        text = text.replace(f'"{mark}"', _any(HOSTILE_TEXT, rng))
    packet = sealed(text.encode("latin1"), 0)
    return clip.data[: PREAMBLE.size] + packet + clip.data[clip.pieces[1].stop :]


def _nodes(value):
    """Return all objects and lists in a JSON value."""
    children = (
        value.values() if isinstance(value, dict) else value if isinstance(value, list) else None
    )
    return (
        [] if children is None else [value, *(node for child in children for node in _nodes(child))]
    )


def _any(choices, rng):
    return choices[rng.integers(len(choices))]


@dataclass
class Draft:
    """A packet that is not sealed yet.

    Attributes:
        kind: of the packet.
        frame: of the packet.
        arrays: by name.
        table: forged JSON of the arrays; empty: the true one.
        index: payload in place of arrays.
    """

    kind: int
    frame: int
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    table: str = ""
    index: bytes = b""

    @classmethod
    def of(cls, clip, piece):
        if piece.kind == 3:
            return cls(piece.kind, piece.frame, index=clip.data[piece.start + PAYLOAD : piece.stop])
        arrays = decode_packet(clip.data[piece.start : piece.stop]).arrays
        return cls(piece.kind, piece.frame, {name: array.copy() for name, array in arrays.items()})

    def rows(self):
        return [[name, array.dtype.name, list(array.shape)] for name, array in self.arrays.items()]

    def sealed(self):
        table = (self.table or json.dumps(self.rows())).encode("latin1")
        arrays = b"".join(array.tobytes() for array in self.arrays.values())
        return sealed(
            self.index or struct.pack("<I", len(table)) + table + arrays, self.kind, self.frame
        )


def _with_arrays(packets, rng):
    return _any([packet for packet in packets if packet.arrays], rng)


def _table(packets, rng):
    packet = _with_arrays(packets, rng)
    table = packet.rows()
    place = rng.integers(3)
    choice = rng.integers(4)
    row = _any(table, rng)
    if choice == 0:
        table.append(row)
    elif choice == 1:
        row[place] = "MARK"
    else:
        shapes = [
            rng.choice(HOSTILE_NUMBERS, rng.integers(0, 4)).tolist(),
            [1] * 10 ** rng.integers(1, 5) + row[2],
        ]
        row[place] = _any((NAMES, DTYPES, shapes)[place], rng)
    packet.table = json.dumps(table).replace('"MARK"', _any(HOSTILE_TEXT, rng))


def _head(packets, rng):
    head = _with_arrays(packets, rng).arrays["head"]
    head[rng.integers(len(head))] = _any(HOSTILE_NUMBERS, rng)


def _code(packets, rng):
    """Replace the code by other words, of the same or another number."""
    arrays = _with_arrays(packets, rng).arrays
    words = arrays["code"]
    choice = rng.integers(4)
    if choice == 0 and len(words):
        words[rng.integers(len(words), size=3)] ^= np.uint32(1 << int(rng.integers(32)))
    elif choice == 1:
        words = words[: rng.integers(len(words) + 1)]
    elif choice == 2:
        words = np.concatenate([words, np.zeros(10 ** int(rng.integers(1, 5)), np.uint32)])
    else:
        words[:] = rng.choice(np.array([0, 2**32 - 1, 2**31], np.uint32))
    arrays["code"] = words


def _number(packets, rng):
    """Change the kind or the frame of a packet."""
    packet = _any(packets, rng)
    if rng.random() < 0.3:
        packet.kind = _any((0, 1, 2, 3, 4, 2**32 - 1), rng)
    else:
        packet.frame = _any((0, 1, 3, 5, 6, packet.frame + 1, 2**31, 2**32 - 1), rng) % 2**32


def _order(packets, rng):
    """Drop, repeat or move a packet."""
    k, to = rng.integers(len(packets), size=2)
    packet = packets[k]
    if rng.random() < 0.6:
        del packets[k]
    if rng.random() < 0.6:
        packets.insert(to, copy.deepcopy(packet))


def _index(packets, rng):
    """Replace the index by one with other entries, which ends as it must."""
    numbers = [*HOSTILE_NUMBERS, 12, 600, 2**63, 2**64 - 1]
    entries = b"".join(
        struct.pack("<IIQ", _any((0, 1, 1, 2), rng), rng.integers(9), _any(numbers, rng))
        for _ in range(rng.integers(6))
    )
    end = struct.pack("<Q8s", rng.integers(6000), b"MORGSIDX")
    packets[:] = [
        *(packet for packet in packets if not packet.index),
        Draft(3, 0, index=entries + end),
    ]


def _continue(packets):
    """Replace the parents of residuals by the digests of the states before, as far as they can be
    decoded.
    """
    state = None
    for packet in packets:
        if state is not None and "parent" in packet.arrays:
            packet.arrays["parent"] = state.digest.copy()
        with suppress(ValueError, MemoryError):
            state = decode(state, Packet(PacketKind(packet.kind), packet.frame, packet.arrays))
