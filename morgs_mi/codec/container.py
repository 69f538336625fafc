"""The container of the stream: packets that are checked and appended one by one, and readable while
they are written.

    stream    = "MORGS-MI" version:u32 header (keyframe | residual | index)*
    header    = packet of kind 0, payload: JSON of the cameras, frame rate and metadata
    keyframe  = packet of kind 1, payload: arrays of the whole state
    residual  = packet of kind 2, payload: arrays of the changes since the frame before
    index     = packet of kind 3, payload: entry* offset:u64 "MORGSIDX"

    packet    = kind:u32 frame:u32 length:u64 crc:u32 payload[length]
    arrays    = length:u32 table[length] bytes of the arrays, one after the other
    table     = JSON [[name, dtype, shape], ...]
    entry     = kind:u32 frame:u32 offset:u64 of each packet before, except the header

All numbers are little-endian. The CRC-32 covers the packet's first 16 bytes and its payload. A
stream that was closed ends with an index, whose offset is its own. `codec.packets` defines the
arrays; docs/stream-format.md specifies everything.

The stream's header: cameras, frame rate and metadata as JSON, with the limits that
docs/stream-format.md sets.

JSON takes up to thirty times its bytes in memory, and a header may come from anybody: its size, its
depth, and the type and range of every entry are checked where it is read. A writer checks its
header by reading it.
"""

from __future__ import annotations

import base64
import contextlib
import json
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import byte_values
from morgs_mi.core.types import Arrays
from morgs_mi.platform.bounded import JsonObject, most_memory
from morgs_mi.platform.checks import LARGEST, bounded, numbers
from morgs_mi.platform.png import PngImage, png_bytes

_MAX_BYTES = 2**26  # most of them in strings
_MAX_MARKS = 2**20  # commas and brackets
_MAX_LEVELS = 32  # of JSON; recursive programs must be able to visit it
_MAX_PIXELS = 2**26  # of a camera
# Type of each entry, least and largest number or length, and the same in words.
_HEADER = {
    "cameras": (list, 1, math.inf, "a list of at least one camera"),
    "fps": (float, 1e-6, 1e6, "a number from 1e-6 to 1e6"),
    "metadata": (dict, 0, math.inf, "an object"),
}
_CAMERA = {
    "name": (str, 0, math.inf, "a string"),
    "K": (list, 3, 3, "three lists of three numbers"),
    "viewmat": (list, 4, 4, "four lists of four numbers"),
    "width": (int, 1, _MAX_PIXELS, "an integer from 1 to 2^26"),
    "height": (int, 1, _MAX_PIXELS, "an integer from 1 to 2^26"),
    "near": (float, 1 / LARGEST, LARGEST, "a number from 1e-12 to 1e12"),
}
MAGIC = b"MORGS-MI"
INDEX_MAGIC = b"MORGSIDX"
VERSION = 2
PREAMBLE = struct.Struct("<8sI")
HEAD = struct.Struct("<IIQ")  # kind, frame, payload length; the CRC covers these and the payload
ENTRY = struct.Struct("<IIQ")  # kind, frame, offset
TRAILER = struct.Struct("<Q8s")
_U32 = struct.Struct("<I")
PAYLOAD = HEAD.size + _U32.size  # offset of the payload in a packet
_DTYPES = {"float32": "<f4", "uint32": "<u4", "uint8": "u1"}
_MAX_TABLE = 2**16  # bytes
_MAX_AXES = 8


def header_json(cameras: Sequence[Camera], fps: float, metadata: JsonObject) -> str:
    """Return a header's payload as JSON.

    Raises:
        ValueError: JSON cannot represent it, or a reader would refuse it.
    """
    views = []
    for camera in cameras:
        view = {key: getattr(camera, key) for key in _CAMERA}
        if (image := camera.backdrop) is not None:
            view["background"] = base64.b64encode(png_bytes(byte_values(image))).decode()
        views.append(view)
    fields = {
        "cameras": views,
        "fps": float(fps),
        "metadata": dict(metadata),
    }
    try:
        text = json.dumps(
            fields, allow_nan=False, default=lambda matrix: np.asarray(matrix, np.float64).tolist()
        )
        header_fields(text.encode())
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"StreamWriter(): a reader would refuse the header: {error}.") from None
    return text


def header_fields(payload: bytes | memoryview) -> tuple[tuple[Camera, ...], float, JsonObject]:
    """Return cameras, frame rate and metadata of a header's payload.

    Raises:
        ValueError: an entry is missing, or has another type or range than it must have.
    """
    cameras, fps, metadata = _entries(load_json(payload, _MAX_BYTES), _HEADER)
    views = [camera_of_fields(fields, f"cameras[{k}]") for k, fields in enumerate(cameras)]
    # The images are decoded when they are drawn, and then stay in memory.
    sizes = [3 * view.width * view.height for view in views if view.background is not None]
    most = most_memory(len(payload))
    if sum(sizes) > most:
        raise ValueError(
            f"`background` of {len(sizes)} cameras must have at most {most // 10**6} MB in a "
            f"header of {len(payload)} bytes, got claims of {sum(sizes) // 10**6} MB; use a "
            "colour, or smaller images"
        )
    return tuple(views), fps, metadata


def load_json(data: bytes | memoryview, most: int) -> Any:
    """Return the value of JSON from a file that is not trusted.

    Args:
        data: UTF-8.
        most: bytes that it may have.

    Raises:
        ValueError: it is longer, nested too deeply or no JSON, or has numbers that are not finite
            or, if they are integers, have more than 64 bits.
    """
    try:
        if len(data) > most:
            raise ValueError(f"it must have at most {most} bytes, got {len(data)}")
        text = str(data, "utf-8")
        if sum(map(text.count, ",[{")) > _MAX_MARKS:
            raise ValueError(f"it must have at most {_MAX_MARKS} commas and opening brackets")
        value = json.loads(
            text, parse_constant=_finite_number, parse_float=_finite_number, parse_int=_integer
        )
        if _levels(value) > _MAX_LEVELS:
            raise ValueError(f"it must be nested at most {_MAX_LEVELS} levels deep")
    except (ValueError, RecursionError) as error:
        raise ValueError(f"the JSON is broken ({error})") from None
    return value


def _finite_number(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"numbers must be finite, got {text:.40}")
    return number


def _integer(text: str) -> int:
    number = int(text)
    if not -(2**63) <= number < 2**64:
        raise ValueError(f"integers must have at most 64 bits, got {text:.40}")
    return number


def _levels(value: Any) -> int:
    """Return how deeply a JSON value is nested."""
    if not isinstance(value, dict | list):
        return 0
    children = value.values() if isinstance(value, dict) else value
    return 1 + max(map(_levels, children), default=0)


def camera_of_fields(fields: Any, where: str) -> Camera:
    """Return the camera of a JSON object from a header; `where` names it in messages.

    Raises:
        ValueError: an entry is missing, or has another type or range than it must have.
    """
    name, K_rows, viewmat_rows, width, height, near = _entries(fields, _CAMERA, f"{where}.")
    K = numbers(where, "matrix", K_rows)
    viewmat = numbers(where, "matrix", viewmat_rows)
    is_view = (K.shape, viewmat.shape) == ((3, 3), (4, 4)) and bounded(K) and bounded(viewmat)
    if not is_view or not name.isprintable() or width * height > _MAX_PIXELS:
        raise ValueError(
            f"`{where}` must have a printable `name`, at most 2^26 pixels, and `K` [3][3] and "
            f"`viewmat` [4][4] of at most {LARGEST:g}, got {name!r:.60}, {width}x{height}, "
            f"{[K_rows, viewmat_rows]!s:.200}"
        )
    background = fields.get("background")
    if background is not None:
        background = _image_of(background, f"{where}.background", (width, height))
    return Camera(K, viewmat, width, height, name=name, near=near, background=background)


def _image_of(text: Any, where: str, size: tuple[int, int]) -> PngImage:
    """Return the image [H, W, 3] of a PNG file in base64; `size` is (W, H)."""
    image = None
    with contextlib.suppress(TypeError, ValueError):
        image = PngImage(base64.b64decode(text))
    if image is None or image.size != size:
        raise ValueError(
            f"`{where}` must be a PNG image of {size[0]}x{size[1]} pixels in base64, got "
            f"{text!r:.60}"
        )
    return image


def _entries(
    fields: Any, limits: Mapping[str, tuple[type, float, float, str]], where: str = ""
) -> list[Any]:
    """Return the entries of a JSON object in the order of their limits; an integer is also a float,
    and a boolean is neither.
    """
    entries = []
    for key, (kind, low, high, words) in limits.items():
        value = fields.get(key) if isinstance(fields, dict) else None
        if kind is float and type(value) is int:
            value = float(value)
        size: Any = len(value) if isinstance(value, dict | list | str) else value
        if type(value) is not kind or not low <= size <= high:
            raise ValueError(f"`{where}{key}` must be {words}, got {value!r:.60}")
        entries.append(value)
    return entries


class PacketKind(IntEnum):
    """Kind of a packet."""

    HEADER = 0
    KEYFRAME = 1
    RESIDUAL = 2
    INDEX = 3


Entry = tuple[int, int, int]
"""(kind, frame, offset) of a packet."""
_KINDS = (PacketKind.KEYFRAME, PacketKind.RESIDUAL)  # of frames


class TruncatedStreamError(ValueError):
    """The stream ends inside a packet: it was truncated, or its writer has not finished that
    packet.
    """


@dataclass(frozen=True, eq=False)
class Packet:
    """Data of one frame."""

    kind: PacketKind  #: `KEYFRAME` (self-contained) or `RESIDUAL` (changes since the frame before).
    frame: int  #: Index of the video frame.
    #: float32, uint32 or uint8 arrays of any shape, by name; read-only copies of those that are
    #: passed.
    arrays: Arrays = field(default_factory=dict)
    place: str = ""  #: Description of where the packet was read, for messages; empty for a new one.

    def __post_init__(self) -> None:
        arrays = {name: np.array(array) for name, array in self.arrays.items()}
        for array in arrays.values():
            array.setflags(write=False)
        object.__setattr__(self, "arrays", MappingProxyType(arrays))

    def __repr__(self) -> str:
        return f"Packet({self.kind.name}, frame {self.frame}, {len(self.arrays)} arrays)"

    @cached_property
    def encoded(self) -> bytes:
        """The packet as bytes of the file; they are computed once.

        Raises:
            ValueError: the kind is not `KEYFRAME` or `RESIDUAL`, the frame is not a uint32, or an
                array has another dtype.
        """
        dtypes = {array.dtype.name for array in self.arrays.values()}
        if self.kind not in _KINDS or not 0 <= self.frame < 2**32 or dtypes - _DTYPES.keys():
            raise ValueError(
                "Packet.encoded: expected a keyframe or residual of a frame in 0..2^32-1 with "
                f"arrays of {', '.join(_DTYPES)}, got {self!r} of {', '.join(dtypes)}."
            )
        rows = [[name, array.dtype.name, array.shape] for name, array in self.arrays.items()]
        contents = [
            array.astype(_DTYPES[array.dtype.name]).tobytes() for array in self.arrays.values()
        ]
        table = json.dumps(rows).encode()
        return _sealed(self.kind, self.frame, b"".join([_U32.pack(len(table)), table, *contents]))

    @property
    def num_bytes(self) -> int:
        """Number of bytes that the packet takes in the file."""
        return len(self.encoded)


def decode_packet(data: bytes, place: str = "") -> Packet:
    """Return the packet that is `encoded` as `data`; `place` describes where it was read, for
    messages.

    Raises:
        ValueError: the bytes are not exactly one intact keyframe or residual packet.
    """
    kind, frame, payload = open_packet(data)
    if kind not in _KINDS:
        raise ValueError(f"the kind must be 1 (keyframe) or 2 (residual), got {kind}")
    arrays: dict[str, np.ndarray] = {}
    try:
        (length,) = _U32.unpack_from(payload)
        at = _U32.size + length
        for name, dtype, shape in load_json(payload[_U32.size : at], _MAX_TABLE):
            is_name = isinstance(name, str) and name not in arrays
            is_shape = isinstance(shape, list) and len(shape) <= _MAX_AXES
            if not is_name or not is_shape or any(type(n) is not int or n < 0 for n in shape):
                raise ValueError(f"`{name!s:.60}` is declared as {dtype!s:.60} {shape!s:.60}")
            stored_dtype = np.dtype(_DTYPES[dtype])
            end = at + math.prod(shape) * stored_dtype.itemsize
            arrays[name] = np.frombuffer(payload[at:end], stored_dtype).reshape(shape).astype(dtype)
            at = end
        if at != len(payload):
            raise ValueError(f"it describes {at} bytes of {len(payload)}")
    except (struct.error, KeyError, TypeError, OverflowError, ValueError) as error:
        raise ValueError(f"its table of arrays is broken ({error})") from None
    return Packet(PacketKind(kind), frame, arrays, place)


class StreamWriter:
    """Writer that appends packets to a new stream; a packet is handed to the system when `write`
    returns.

    Args:
        sink: path of the file, replacing an existing one; or a binary file object, such as a pipe
            or the file of a socket, which is left open.
        cameras: the rig.
        fps: frames per second.
        metadata: any value that JSON can represent.

    Raises:
        ValueError: `metadata` is not JSON.
        OSError: the file cannot be opened or written.
    """

    def __init__(
        self,
        sink: str | Path | BinaryIO,
        cameras: Sequence[Camera],
        fps: float,
        metadata: JsonObject | None = None,
    ) -> None:
        payload = header_json(cameras, fps, metadata or {}).encode()
        self.num_bytes = 0
        self._index: list[Entry] | None = []
        is_path = isinstance(sink, str | Path)
        self._owns_file = is_path
        self.path = Path(sink if is_path else str(getattr(sink, "name", "stream")))
        # Unbuffered: a buffer would write its rest again after a failed packet has been removed.
        self._file = open(sink, "wb", buffering=0) if is_path else sink  # noqa: SIM115
        try:
            self._append(PREAMBLE.pack(MAGIC, VERSION) + _sealed(PacketKind.HEADER, 0, payload))
        except OSError:
            self._index = None
            self.close()
            raise

    @classmethod
    def continued(cls, path: str | Path, index: Sequence[Entry], end: int) -> StreamWriter:
        """Return the writer of an interrupted stream; the file is truncated at byte `end`.

        Args:
            path: the file.
            index: (kind, frame, offset) of its packets except the header, as returned by
                `StreamReader.check`.
            end: end of the last of them.

        Raises:
            OSError: the file cannot be opened or truncated.
        """
        writer = cls.__new__(cls)
        writer._owns_file = True
        writer.path = Path(path)
        writer.num_bytes = end
        writer._index = list(index)
        writer._file = open(path, "r+b", buffering=0)  # noqa: SIM115
        writer._file.truncate(end)
        writer._file.seek(end)
        return writer

    def write(self, packet: Packet) -> int:
        """Append one packet and return its number of bytes.

        Raises:
            ValueError: the packet cannot be encoded.
            OSError: it could not be written; a file is truncated to its last complete packet.
        """
        assert self._index is not None
        at = self.num_bytes
        size = self._append(packet.encoded)
        self._index.append((packet.kind, packet.frame, at))
        return size

    def close(self) -> None:
        """Write the index and close the file; a second call does nothing."""
        if self._index is not None:
            entries = b"".join(ENTRY.pack(*entry) for entry in self._index)
            payload = entries + TRAILER.pack(self.num_bytes, INDEX_MAGIC)
            self._index = None
            # A full disk or a closed pipe; readers do not need the index.
            with contextlib.suppress(OSError):
                self._append(_sealed(PacketKind.INDEX, 0, payload))
        if self._owns_file:
            self._file.close()

    def __enter__(self) -> StreamWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _append(self, data: bytes) -> int:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
            self._file.flush()
        except BaseException as error:  # Ctrl-C must leave complete packets too
            if self._owns_file:
                with contextlib.suppress(OSError):  # a device cannot be truncated
                    self._file.truncate(self.num_bytes)
                    self._file.seek(self.num_bytes)
            if not isinstance(error, OSError):
                raise
            raise OSError(
                error.errno,
                f"{self.path}: {len(data)} bytes could not be written ({error.strerror}) after "
                f"{self.num_bytes} bytes of complete packets; free space on the disk",
            ) from error
        self.num_bytes += len(data)
        return len(data)


def _sealed(kind: int, frame: int, payload: bytes) -> bytes:
    head = HEAD.pack(kind, frame, len(payload))
    return b"".join([head, _U32.pack(_crc(head, payload)), payload])


def open_packet(data: bytes) -> tuple[int, int, memoryview]:
    """Return (kind, frame, payload) of an encoded packet of any kind.

    Raises:
        ValueError: its length or its CRC is wrong.
    """
    head = data[: HEAD.size]
    length = HEAD.unpack(head)[2] if len(data) >= PAYLOAD else 0
    if len(data) != PAYLOAD + length:
        raise ValueError(f"a packet should have {PAYLOAD + length} bytes, got {len(data)}")
    payload = memoryview(data)[PAYLOAD:]
    kind, frame, _ = HEAD.unpack(head)
    (stated,) = _U32.unpack_from(data, HEAD.size)
    if stated != (crc := _crc(head, payload)):
        raise ValueError(f"its CRC should be {stated:08x}, got {crc:08x}: the bytes are damaged")
    return kind, frame, payload


def _crc(head: bytes, payload: bytes | memoryview) -> int:
    return zlib.crc32(payload, zlib.crc32(head))
