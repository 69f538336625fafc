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
from morgs_mi.core.checks import LARGEST

_MAX_BYTES = 2**22
_MAX_LEVELS = 32  # of JSON; recursive programs must be able to visit it
_MAX_PIXELS = 2**26  # of a camera
_MAX_FPS = 1e6
_IN_WORDS = {
    dict: "an object",
    list: "a list",
    str: "a string",
    int: "an integer",
    float: "a number",
    bool: "a truth value",
    type(None): "null",
}


def header_json(cameras: Sequence[Camera], fps: float, metadata: Mapping[str, Any]) -> str:
    """Return a header's payload as JSON.

    Raises:
        ValueError: JSON cannot represent it, or a reader would refuse it.
    """
    fields = {
        "cameras": [
            {
                "name": camera.name,
                "K": camera.K.tolist(),
                "viewmat": np.asarray(camera.viewmat, dtype=np.float64).tolist(),
                "width": camera.width,
                "height": camera.height,
                "near": camera.near,
            }
            for camera in cameras
        ],
        "fps": float(fps),
        "metadata": dict(metadata),
    }
    try:
        text = json.dumps(fields, allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"StreamWriter(): `metadata` and `fps` must fit into JSON ({error})."
        ) from None
    try:
        header_fields(text.encode())
    except ValueError as error:
        raise ValueError(f"StreamWriter(): a reader would refuse the header: {error}.") from None
    return text


def header_fields(payload: bytes | memoryview) -> tuple[tuple[Camera, ...], float, dict[str, Any]]:
    """Return cameras, frame rate and metadata of a header's payload.

    Raises:
        ValueError: an entry is missing, or has another type or range than it must have.
    """
    header = _typed(load_json(payload, _MAX_BYTES), dict, "header")
    cameras = [
        camera_of_fields(fields, f"cameras[{k}]")
        for k, fields in enumerate(_entry(header, "cameras", list))
    ]
    if not cameras:
        raise ValueError("`cameras` must name at least one camera, got none")
    fps = _within(_entry(header, "fps", float), 1 / _MAX_FPS, _MAX_FPS, "fps")
    return tuple(cameras), fps, _entry(header, "metadata", dict)


def load_json(data: bytes | memoryview, most: int) -> Any:
    """Return the value of JSON from a file that is not trusted.

    Args:
        data: UTF-8.
        most: bytes that it may have.

    Raises:
        ValueError: it is longer, nested too deeply or no JSON, or has numbers that are not finite
            or, if they are integers, have more than 64 bits.
    """
    if len(data) > most:
        raise ValueError(f"the JSON must have at most {most} bytes, got {len(data)}")
    too_deep = f"the JSON must be nested at most {_MAX_LEVELS} levels deep"
    try:
        value = json.loads(
            str(data, "utf-8"), parse_constant=_finite, parse_float=_finite, parse_int=_short
        )
    except UnicodeDecodeError:
        raise ValueError("the JSON is broken (not UTF-8)") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"the JSON is broken ({error})") from None
    except RecursionError:
        raise ValueError(too_deep) from None
    level = [value]
    for _ in range(_MAX_LEVELS):
        parents = [parent for parent in level if isinstance(parent, dict | list)]
        level = [
            child
            for parent in parents
            for child in (parent.values() if isinstance(parent, dict) else parent)
        ]
    if level:
        raise ValueError(too_deep)
    return value


def _finite(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise ValueError(f"numbers must be finite, got {text[:40]}")
    return value


def _short(text: str) -> int:
    if len(text) > 20 or not -(2**63) <= (value := int(text)) < 2**64:
        raise ValueError(f"integers must have at most 64 bits, got {text[:40]}")
    return value


def camera_of_fields(fields: Any, where: str) -> Camera:
    """Return the camera of a JSON object from a header; `where` names it in messages.

    Raises:
        ValueError: an entry is missing, or has another type or range than it must have.
    """
    fields = _typed(fields, dict, where)
    name = _entry(fields, "name", str, where)
    if not name.isprintable():
        raise ValueError(f"`{where}.name` must be printable, got {name!r:.60}")
    width, height = (
        _within(_entry(fields, key, int, where), 1, _MAX_PIXELS, f"{where}.{key}")
        for key in ("width", "height")
    )
    _within(width * height, 1, _MAX_PIXELS, f"{where}.width * height")
    near = _within(_entry(fields, "near", float, where), 1 / LARGEST, LARGEST, f"{where}.near")
    K = _matrix(fields, "K", 3, where)
    viewmat = _matrix(fields, "viewmat", 4, where)
    return Camera(K, viewmat, width, height, name=name, near=near)


def _matrix(fields: dict[str, Any], key: str, size: int, where: str) -> np.ndarray:
    rows = _entry(fields, key, list, where)
    what = f"{where}.{key}"
    if len(rows) != size or any(not isinstance(row, list) or len(row) != size for row in rows):
        raise ValueError(f"`{what}` must be a matrix [{size}][{size}]")
    return np.array(
        [[_within(_typed(x, float, what), -LARGEST, LARGEST, what) for x in row] for row in rows]
    )


def _entry(fields: dict[str, Any], key: str, kind: type, where: str = "") -> Any:
    name = f"{where}.{key}".lstrip(".")
    if key not in fields:
        raise ValueError(f"`{name}` is missing")
    return _typed(fields[key], kind, name)


def _typed(value: Any, kind: type, name: str) -> Any:
    """Return a value of type `kind`; an integer is also a float, and a boolean is neither."""
    if type(value) is int and kind is float:
        return float(value)
    if type(value) is not kind:
        raise ValueError(f"`{name}` must be {_IN_WORDS[kind]}, got {_IN_WORDS[type(value)]}")
    return value


def _within(value: Any, low: float, high: float, name: str) -> Any:
    if not low <= value <= high:
        raise ValueError(f"`{name}` must lie between {low:.10g} and {high:.10g}, got {value:.10g}")
    return value
