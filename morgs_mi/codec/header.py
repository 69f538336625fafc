"""The stream's header: cameras, frame rate and metadata as JSON, with the limits that
docs/stream-format.md sets.

JSON takes up to thirty times its bytes in memory, and a header may come from anybody: its size, its
depth, and the type and range of every entry are checked where it is read. A writer checks its
header by reading it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.checks import LARGEST, bounded, numbers

_MAX_BYTES = 2**22
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


def header_json(cameras: Sequence[Camera], fps: float, metadata: Mapping[str, Any]) -> str:
    """Return a header's payload as JSON.

    Raises:
        ValueError: JSON cannot represent it, or a reader would refuse it.
    """
    fields = {
        "cameras": [{key: getattr(camera, key) for key in _CAMERA} for camera in cameras],
        "fps": float(fps),
        "metadata": dict(metadata),
    }
    try:
        text = json.dumps(fields, allow_nan=False, default=_matrix_rows)
        header_fields(text.encode())
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"StreamWriter(): a reader would refuse the header: {error}.") from None
    return text


def _matrix_rows(matrix: Any) -> list[list[float]]:
    return np.asarray(matrix, dtype=np.float64).tolist()


def header_fields(payload: bytes | memoryview) -> tuple[tuple[Camera, ...], float, dict[str, Any]]:
    """Return cameras, frame rate and metadata of a header's payload.

    Raises:
        ValueError: an entry is missing, or has another type or range than it must have.
    """
    cameras, fps, metadata = _entries(load_json(payload, _MAX_BYTES), _HEADER)
    views = (camera_of_fields(fields, f"cameras[{k}]") for k, fields in enumerate(cameras))
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
        value = json.loads(text, parse_constant=_number, parse_float=_number, parse_int=_number)
        if _levels(value) > _MAX_LEVELS:
            raise ValueError(f"it must be nested at most {_MAX_LEVELS} levels deep")
    except (ValueError, RecursionError) as error:
        raise ValueError(f"the JSON is broken ({error})") from None
    return value


def _number(text: str) -> float:
    """Return a finite number, or an integer of at most 64 bits."""
    number = int(text) if text.lstrip("-").isdecimal() else float(text)
    is_short = -(2**63) <= number < 2**64 if isinstance(number, int) else math.isfinite(number)
    if not is_short:
        raise ValueError(f"numbers must be finite, integers of at most 64 bits, got {text:.40}")
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
    name, *rows, width, height, near = _entries(fields, _CAMERA, f"{where}.")
    K, viewmat = (numbers(where, "matrix", matrix) for matrix in rows)
    is_view = (K.shape, viewmat.shape) == ((3, 3), (4, 4)) and bounded(K) and bounded(viewmat)
    if not is_view or not name.isprintable() or width * height > _MAX_PIXELS:
        raise ValueError(
            f"`{where}` must have a printable `name`, at most 2^26 pixels, and `K` [3][3] and "
            f"`viewmat` [4][4] of at most {LARGEST:g}, got {name!r:.60}, {width}x{height}, "
            f"{rows!s:.200}"
        )
    return Camera(K, viewmat, width, height, name=name, near=near)


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
