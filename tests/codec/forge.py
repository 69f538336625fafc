"""Damaged and forged streams, made from a short clip with a random generator. Forged packets have the right CRC."""

from __future__ import annotations

import json
import struct
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from morgs_mi.codec.container import PAYLOAD, PREAMBLE, decode_packet
from morgs_mi.codec.packets import decode, keyframe_packet
from tests.scenes.coded_clip import CAMERAS, cloud
from tests.scenes.short_clip import Clip, sealed

HOSTILE_TEXT = (
    *("NaN", "-Infinity", "1e999", "-1e999", "1e308", "1e-320", "0", "-1", "1.5", "true", "null", '""', "[]", "{}"),
    *("2147483648", "4294967295", "9223372036854775807", "18446744073709551616", "1" + 400 * "0", "[[1,2],[3]]"),
    *('"\\ud800"', '"\\u0000"', '"\\u001b[2J"', '"../../x"', '"auto"', '{"a":{"a":{"a":1}}}', "[null]", '["x","y"]'),
    *("[" * 200 + "]" * 200, "[" * 50_000, '{"a":' * 200 + "1" + "}" * 200, '"', "{", "[1,,2]", "\xff"),
)
HOSTILE_NUMBERS = (0, 1, 2, 3, 4, 5, 7, 16, 80, 81, 255, 2**16, 2**20, 2**24, 2**30 - 1, 2**30, 2**31, 2**32 - 1)
DTYPES = ("uint8", "uint32", "float32", "float64", "int8", "object", "O", "<U9", "f4,f4", "M8[s]", ">u4", "void", "")


class Forgery(NamedTuple):
    """A forged stream: its bytes, and the frame of the only packet that differs, None if more than that differ."""

    data: bytes
    frame: int | None


def damaged(clip: Clip, rng: np.random.Generator) -> bytes:
    """Return the stream truncated, with one or several flipped bits, or with an overwritten range."""
    data = clip.data
    spoilt, kind = bytearray(data), rng.integers(4)
    if kind == 0:
        return data[: rng.integers(len(data))]
    if kind == 3:
        start, length = rng.integers(len(data)), rng.integers(1, 200)
        size = len(spoilt[start : start + length])
        spoilt[start : start + length] = bytes(size) if rng.random() < 0.5 else rng.bytes(size)
    for at in rng.choice(8 * len(data), 1 if kind == 1 else rng.integers(2, 9) if kind == 2 else 0, replace=False):
        spoilt[at // 8] ^= 1 << at % 8
    return bytes(spoilt)


def with_forged_bytes(clip: Clip, rng: np.random.Generator) -> Forgery:
    """Change up to three bytes inside one packet."""
    piece = clip.pieces[rng.integers(2, len(clip.pieces))]
    spoilt = bytearray(clip.data[piece.start + PAYLOAD : piece.stop])
    # Half of them among the numbers that determine the sizes of arrays.
    for at in rng.integers(0, len(spoilt) if rng.random() < 0.5 else min(120, len(spoilt)), rng.integers(1, 4)):
        spoilt[at] = rng.integers(256)
    packet = sealed(bytes(spoilt), piece.kind, piece.frame)
    return Forgery(clip.data[: piece.start] + packet + clip.data[piece.stop :], piece.frame)


def with_forged_packets(clip: Clip, rng: np.random.Generator) -> Forgery:
    """Change numbers, tables, codes, kinds, frames and the order of packets; half of the time the parents fit again."""
    packets = [(p.kind, p.frame, clip.data[p.start + PAYLOAD : p.stop]) for p in clip.pieces[2:]]
    for _ in range(rng.integers(1, 4)):
        changes = (_table, _head, _head, _code, _code, _number, _order, _index)
        changes[rng.integers(len(changes))](packets, rng)
    if rng.random() < 0.5:
        packets = _with_right_parents(packets)
    header = clip.data[: clip.pieces[1].stop]
    return Forgery(header + b"".join(sealed(payload, kind, frame) for kind, frame, payload in packets), None)


def with_forged_header(clip: Clip, rng: np.random.Generator) -> Forgery:
    """Replace, remove or add entries of the header."""
    header = json.loads(clip.data[clip.pieces[1].start + PAYLOAD : clip.pieces[1].stop])
    marks = []
    for _ in range(rng.integers(1, 3)):
        parents = [node for node in _nodes(header) if node]
        parent = parents[rng.integers(len(parents))]
        keys = list(parent) if isinstance(parent, dict) else list(range(len(parent)))
        key: Any = keys[rng.integers(len(keys))]
        if rng.random() < 0.1:
            del parent[key]
        else:
            marks.append(f"MARK{len(marks)}")
            parent["added" if isinstance(parent, dict) and rng.random() < 0.1 else key] = marks[-1]
    text = json.dumps(header)
    for mark in marks:
        text = text.replace(f'"{mark}"', HOSTILE_TEXT[rng.integers(len(HOSTILE_TEXT))])
    return Forgery(
        clip.data[: PREAMBLE.size] + sealed(text.encode("latin1"), 0) + clip.data[clip.pieces[1].stop :], None
    )


def forged_streams(clip: Clip) -> tuple[bytes, bytes]:
    """Return the stream with another keyframe of frame 3, and with an index whose second entry is no keyframe.

    Both play from the start as the clip does.
    """
    forged = keyframe_packet(cloud(9, 0), 3, CAMERAS).encoded
    keyframe, at = clip.pieces[6], clip.pieces[-1].start
    assert (keyframe.kind, keyframe.frame) == (1, 3)
    entries = [(1, 0, clip.pieces[2].start), (1, 3, clip.pieces[4].start)]
    index = b"".join(struct.pack("<IIQ", *entry) for entry in entries)
    return (
        clip.data[: keyframe.start] + forged + clip.data[keyframe.stop : at],
        clip.data[:at] + sealed(index + struct.pack("<Q8s", at, b"MORGSIDX"), 3),
    )


def _nodes(value: Any) -> list[Any]:
    """Return all objects and lists in a JSON value."""
    children = value.values() if isinstance(value, dict) else value if isinstance(value, list) else None
    return [] if children is None else [value, *(node for child in children for node in _nodes(child))]


Packets = list[tuple[int, int, bytes]]


def _parts(payload: bytes) -> tuple[list[Any], bytes]:
    """Return the table of a payload and the bytes of its arrays."""
    (size,) = struct.unpack_from("<I", payload)
    return json.loads(payload[4 : 4 + size]), payload[4 + size :]


def _joined(table: str, rest: bytes) -> bytes:
    return struct.pack("<I", len(table)) + table.encode("latin1") + rest


def _pick(packets: Packets, rng: np.random.Generator) -> int | None:
    """Return the place of one of the packets that still have a table."""
    places = []
    for k, (kind, _, payload) in enumerate(packets):
        with suppress(ValueError, struct.error, TypeError):
            table = _parts(payload)[0]
            if kind in (1, 2) and all(len(row) == 3 for row in table):
                places.append(k)
    return places[rng.integers(len(places))] if places else None


def _table(packets: Packets, rng: np.random.Generator) -> None:
    if (k := _pick(packets, rng)) is None:
        return
    kind, frame, payload = packets[k]
    table, rest = _parts(payload)
    row = table[rng.integers(len(table))] if table else ["a", "uint8", [0]]
    choice = rng.integers(6)
    if choice == 0:
        row[1] = DTYPES[rng.integers(len(DTYPES))]
    elif choice == 1:
        row[2] = [int(n) for n in rng.choice(HOSTILE_NUMBERS, rng.integers(0, 4))]
    elif choice == 2:
        table.append(row)
    elif choice == 3:
        row[0] = ("head", "code", "parent", "offset", "", "x")[rng.integers(6)]
    elif choice == 4:
        row[2] = [1] * int(10 ** rng.integers(1, 5)) + row[2]
    text = json.dumps(table)
    if choice == 5:
        row[rng.integers(3)] = "MARK"
        text = json.dumps(table).replace('"MARK"', HOSTILE_TEXT[rng.integers(len(HOSTILE_TEXT))])
    packets[k] = (kind, frame, _joined(text, rest))


def _array(packets: Packets, rng: np.random.Generator, name: str) -> tuple[int, int, int] | None:
    """Return the place of a packet that has an array, and the array's byte range in the payload."""
    if (k := _pick(packets, rng)) is None:
        return None
    table, rest = _parts(packets[k][2])
    at = len(packets[k][2]) - len(rest)
    for found, dtype, shape in table:
        size = int(np.prod([1, *shape], dtype=object)) * {"uint8": 1}.get(dtype, 4) if isinstance(shape, list) else 0
        if found == name:
            return k, at, at + size
        at += size
    return None


def _head(packets: Packets, rng: np.random.Generator) -> None:
    if found := _array(packets, rng, "head"):
        k, start, stop = found
        kind, frame, payload = packets[k]
        spoilt, count = bytearray(payload), (min(stop, len(payload)) - start) // 4
        if count > 0:
            at = start + 4 * int(rng.integers(count))
            spoilt[at : at + 4] = struct.pack("<I", HOSTILE_NUMBERS[rng.integers(len(HOSTILE_NUMBERS))])
        packets[k] = (kind, frame, bytes(spoilt))


def _code(packets: Packets, rng: np.random.Generator) -> None:
    """Replace the code by other words, of the same or another number."""
    if (k := _pick(packets, rng)) is None:
        return
    kind, frame, payload = packets[k]
    table, rest = _parts(payload)
    row = next((row for row in table if row[:2] == ["code", "uint32"] and len(row[2]) == 1), None)
    if row is None or row is not table[-1] or 4 * row[2][0] > len(rest):
        return
    start = len(rest) - 4 * row[2][0]
    words = np.frombuffer(rest[start:], "<u4").copy()
    choice = rng.integers(4)
    if choice == 0 and len(words):
        words[rng.integers(len(words), size=3)] ^= np.uint32(1 << int(rng.integers(32)))
    elif choice == 1:
        words = words[: rng.integers(len(words) + 1)]
    elif choice == 2:
        words = np.concatenate([words, np.zeros(10 ** int(rng.integers(1, 5)), np.uint32)])
    else:
        words[:] = rng.choice(np.array([0, 2**32 - 1, 2**31], np.uint32))
    row[2] = [len(words)]
    packets[k] = (kind, frame, _joined(json.dumps(table), rest[:start] + words.tobytes()))


def _number(packets: Packets, rng: np.random.Generator) -> None:
    """Change the kind or the frame of a packet."""
    k = int(rng.integers(len(packets)))
    kind, frame, payload = packets[k]
    if rng.random() < 0.3:
        kind = int(rng.choice([0, 1, 2, 3, 4, 2**32 - 1]))
    else:
        frame = int(rng.choice([0, 1, 3, 5, 6, frame + 1, 2**31, 2**32 - 1]))
    packets[k] = (kind, frame, payload)


def _order(packets: Packets, rng: np.random.Generator) -> None:
    """Drop, repeat or move a packet."""
    k, to = rng.integers(len(packets), size=2)
    packet = packets[k]
    if rng.random() < 0.6:
        del packets[k]
    if rng.random() < 0.6:
        packets.insert(to, packet)


def _index(packets: Packets, rng: np.random.Generator) -> None:
    """Replace the index by one with other entries, whose end is as it must be."""
    packets[:] = [packet for packet in packets if packet[0] != 3]
    numbers = [*HOSTILE_NUMBERS, 12, 600, 2**63, 2**64 - 1]
    entries = b"".join(
        struct.pack("<IIQ", int(rng.choice([0, 1, 1, 2])), int(rng.integers(9)), numbers[rng.integers(len(numbers))])
        for _ in range(rng.integers(6))
    )
    packets.append((3, 0, entries + struct.pack("<Q8s", int(rng.integers(6000)), b"MORGSIDX")))


def _with_right_parents(packets: Packets) -> Packets:
    """Return the packets with the digest of the state before each residual, as far as they can be decoded."""
    state, fitting = None, list(packets)
    for k, (kind, frame, payload) in enumerate(packets):
        with suppress(ValueError, MemoryError, struct.error, TypeError):
            if kind == 2 and state is not None:
                table, rest = _parts(payload)
                at = len(payload) - len(rest)
                if table and table[0] == ["parent", "uint8", [8]]:
                    payload = payload[:at] + state.digest.tobytes() + payload[at + 8 :]
                    fitting[k] = (kind, frame, payload)
            if kind in (1, 2) and not (state is not None and kind == 1 and frame == state.frame):
                state = decode(state, decode_packet(sealed(payload, kind, frame)))
    return fitting
