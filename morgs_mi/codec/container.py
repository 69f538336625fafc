"""The stream file: self-contained packets, appended one by one, readable while it is written.

    file    = magic [8], version uint32, packet*
    packet  = kind uint32, frame uint32, length uint64, crc uint32, payload [length]
    payload = table length uint32, table (JSON: name, dtype and shape of each array), the arrays' bytes

All numbers are little-endian. The CRC-32 covers the packet's first 16 bytes and its payload. Packet 0 is
the header, whose payload is JSON alone: cameras, frame rate and free metadata.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np

from morgs_mi.capture.camera import Camera

__all__ = [
    "Packet",
    "PacketKind",
    "StreamReader",
    "StreamWriter",
    "TruncatedStreamError",
    "decode_packet",
    "encode_packet",
]

MAGIC = b"MORGS-MI"
VERSION = 1
_PREAMBLE = struct.Struct("<8sI")
_HEAD = struct.Struct("<IIQ")  # kind, frame, payload length: what the CRC covers beside the payload
_U32 = struct.Struct("<I")
_PAYLOAD = _HEAD.size + _U32.size
_DTYPES = ("float32", "uint32", "uint8")


class PacketKind(IntEnum):
    """What a packet is for."""

    HEADER = 0
    KEYFRAME = 1
    RESIDUAL = 2


class TruncatedStreamError(ValueError):
    """The file ends inside a packet: it was cut off, or its writer has not finished that packet."""


@dataclass(frozen=True, eq=False)
class Packet:
    """What the stream says about one frame.

    Attributes:
        kind: `KEYFRAME` (stands alone) or `RESIDUAL` (changes the frame before).
        frame: index of the video frame.
        arrays: float32, uint32 or uint8 arrays of any shape, by name.
    """

    kind: PacketKind
    frame: int
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)


def encode_packet(packet: Packet) -> bytes:
    """Return the packet as the bytes that stand in the file.

    Raises:
        ValueError: the kind is `HEADER`, the frame is not a uint32, or an array has another dtype.
    """
    if packet.kind not in (PacketKind.KEYFRAME, PacketKind.RESIDUAL):
        raise ValueError(f"encode_packet(): `kind` must be KEYFRAME or RESIDUAL, got {packet.kind!r}.")
    if not 0 <= packet.frame < 2**32:
        raise ValueError(f"encode_packet(): `frame` must be in 0..2^32-1, got {packet.frame}.")
    for name, array in packet.arrays.items():
        if array.dtype.name not in _DTYPES:
            raise ValueError(
                f"encode_packet(): `{name}` must be one of {', '.join(_DTYPES)}, got {array.dtype}; convert it."
            )
    table = json.dumps([[n, a.dtype.name, a.shape] for n, a in packet.arrays.items()]).encode()
    arrays = (a.astype(a.dtype.newbyteorder("<")).tobytes() for a in packet.arrays.values())
    return _sealed(packet.kind, packet.frame, b"".join([_U32.pack(len(table)), table, *arrays]))


def decode_packet(data: bytes) -> Packet:
    """Return the packet that `encode_packet` turned into `data`.

    Raises:
        ValueError: the bytes are not exactly one intact keyframe or residual packet.
    """
    kind, frame, payload = _unsealed(data)
    if kind not in (PacketKind.KEYFRAME, PacketKind.RESIDUAL):
        raise ValueError(f"the kind must be 1 (keyframe) or 2 (residual), got {kind}")
    try:
        return Packet(PacketKind(kind), frame, _arrays(payload))
    except (struct.error, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"its table of arrays is broken ({error})") from None


class StreamWriter:
    """Appends packets to a new stream file; each is on its way to the disk when `write` returns.

    Args:
        path: the file; an existing one is replaced.
        cameras: the rig.
        fps: frames per second.
        metadata: anything that JSON can hold.

    Raises:
        ValueError: `metadata` is no JSON.
        OSError: the file cannot be opened or written.
    """

    def __init__(
        self,
        path: str | Path,
        cameras: Sequence[Camera],
        fps: float,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        header = {
            "cameras": [_camera_fields(camera) for camera in cameras],
            "fps": float(fps),
            "metadata": dict(metadata or {}),
        }
        try:
            payload = json.dumps(header, allow_nan=False).encode()
        except (TypeError, ValueError) as error:
            raise ValueError(f"StreamWriter(): `metadata` and `fps` must fit into JSON ({error}).") from None
        self.path = Path(path)
        self.num_bytes = 0
        # Unbuffered: a buffer would try to write its rest again after a failed packet has been taken back.
        self._file = open(self.path, "wb", buffering=0)  # noqa: SIM115
        try:
            self._append(_PREAMBLE.pack(MAGIC, VERSION) + _sealed(PacketKind.HEADER, 0, payload))
        except OSError:
            self.close()
            raise

    def write(self, packet: Packet) -> int:
        """Append one packet and return its number of bytes.

        Raises:
            ValueError: the packet cannot be encoded.
            OSError: it could not be written; the file ends with the last whole packet again.
        """
        return self._append(encode_packet(packet))

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._file.close()

    def __enter__(self) -> StreamWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _append(self, data: bytes) -> int:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except BaseException as error:  # a Ctrl-C must leave whole packets too
            with contextlib.suppress(OSError):  # a pipe or device cannot be taken back
                self._file.truncate(self.num_bytes)
                self._file.seek(self.num_bytes)
            if not isinstance(error, OSError):
                raise
            raise OSError(
                error.errno,
                f"{self.path}: {len(data)} bytes could not be written ({error.strerror}), the file keeps its "
                f"{self.num_bytes} bytes of whole packets; free space on the disk",
            ) from error
        self.num_bytes += len(data)
        return len(data)


class StreamReader:
    """Reads a stream file, whole or still growing.

    Iterating yields its packets from the first; it may be done again, e.g. when the file has grown.

    Attributes:
        path: the file.
        cameras: the rig.
        fps: frames per second.
        metadata: what the writer was given.

    Raises:
        FileNotFoundError: there is no such file.
        TruncatedStreamError: the file ends inside a packet (while iterating: after the whole ones).
        ValueError: it is no stream, of another version, or a packet is broken. The message names the
            file, the packet's number and byte offset and how many packets before it are intact.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        with open(self.path, "rb") as file:
            preamble = file.read(_PREAMBLE.size)
            if not MAGIC.startswith(preamble[:8]):
                raise ValueError(
                    f"{self.path}: expected a stream that starts with {MAGIC!r}, got {preamble[:8]!r}; check the path."
                )
            if len(preamble) == _PREAMBLE.size and (version := _PREAMBLE.unpack(preamble)[1]) != VERSION:
                raise ValueError(
                    f"{self.path}: expected format version {VERSION}, got {version}; "
                    "read it with the release that wrote it."
                )
            data = self._read(file, 0)
            if data is None:
                raise TruncatedStreamError(self._sentence(0, file.tell(), "the header is missing"))
            with self._located(0, _PREAMBLE.size):
                kind, _, payload = _unsealed(data)
                if kind != PacketKind.HEADER:
                    raise ValueError(f"the first packet must be the header, got kind {kind}")
                self.cameras, self.fps, self.metadata = _header_fields(payload)
            self._first = file.tell()

    def __iter__(self) -> Iterator[Packet]:
        number = 1
        with open(self.path, "rb") as file:
            file.seek(self._first)
            while (data := self._read(file, number)) is not None:
                with self._located(number, file.tell() - len(data)):
                    packet = decode_packet(data)
                yield packet
                number += 1

    def _read(self, file: BinaryIO, number: int) -> bytes | None:
        """Return the bytes of the packet at the file's position, None at the file's end."""
        at = file.tell()
        left = os.fstat(file.fileno()).st_size - at
        if left == 0:
            return None
        head = file.read(_PAYLOAD)
        # The length is not to be trusted: nothing is allocated before it is known to be in the file.
        need = _PAYLOAD + (_HEAD.unpack_from(head)[2] if len(head) == _PAYLOAD else 0)
        if need > left:
            raise TruncatedStreamError(
                self._sentence(number, at, f"at least {need} bytes expected, got {left}: truncated or still written")
            )
        return head + file.read(need - _PAYLOAD)

    @contextlib.contextmanager
    def _located(self, number: int, at: int) -> Iterator[None]:
        try:
            yield
        except ValueError as error:
            raise ValueError(self._sentence(number, at, str(error))) from None

    def _sentence(self, number: int, at: int, problem: str) -> str:
        return f"{self.path}: packet {number} at byte {at}: {problem}; {number} packets before it are intact."


def _sealed(kind: int, frame: int, payload: bytes) -> bytes:
    head = _HEAD.pack(kind, frame, len(payload))
    return b"".join([head, _U32.pack(zlib.crc32(payload, zlib.crc32(head))), payload])


def _unsealed(data: bytes) -> tuple[int, int, memoryview]:
    """Return (kind, frame, payload) of a packet whose length and CRC are right."""
    if len(data) < _PAYLOAD:
        raise ValueError(f"a packet has at least {_PAYLOAD} bytes, got {len(data)}")
    head, payload = data[: _HEAD.size], memoryview(data)[_PAYLOAD:]
    kind, frame, length = _HEAD.unpack(head)
    if length != len(payload):
        raise ValueError(f"its payload should have {length} bytes, got {len(payload)}")
    (expected,) = _U32.unpack_from(data, _HEAD.size)
    if (crc := zlib.crc32(payload, zlib.crc32(head))) != expected:
        raise ValueError(f"its CRC should be {expected:08x}, got {crc:08x}: the bytes are damaged")
    return kind, frame, payload


def _arrays(payload: memoryview) -> dict[str, np.ndarray]:
    (length,) = _U32.unpack_from(payload)
    at = _U32.size + length
    arrays: dict[str, np.ndarray] = {}
    for name, dtype, shape in json.loads(bytes(payload[_U32.size : at])):
        sound = isinstance(name, str) and all(type(n) is int and n >= 0 for n in shape)
        if not sound or dtype not in _DTYPES:
            raise ValueError(f"`{name}` is said to be {dtype} {shape}")
        stored = np.dtype(dtype).newbyteorder("<")
        end = at + math.prod(shape) * stored.itemsize
        if end > len(payload):
            raise ValueError(f"`{name}` {shape} would end at byte {end} of {len(payload)}")
        arrays[name] = np.frombuffer(payload[at:end], stored).reshape(shape).astype(dtype)
        at = end
    if at != len(payload):
        raise ValueError(f"it describes {at} bytes of {len(payload)}")
    return arrays


def _camera_fields(camera: Camera) -> dict[str, Any]:
    return {
        "name": camera.name,
        "K": camera.K.tolist(),
        "viewmat": np.asarray(camera.viewmat, dtype=np.float64).tolist(),
        "width": camera.width,
        "height": camera.height,
        "near": camera.near,
    }


def _header_fields(payload: memoryview) -> tuple[tuple[Camera, ...], float, dict[str, Any]]:
    try:
        header = json.loads(bytes(payload))
        cameras = tuple(
            Camera(**{**fields, "K": np.array(fields["K"]), "viewmat": np.array(fields["viewmat"])})
            for fields in header["cameras"]
        )
        return cameras, float(header["fps"]), dict(header["metadata"])
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"the header's JSON is broken ({error!r})") from None
