"""The header: types and ranges of every entry are checked, by readers and by writers."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest

from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.header import header_fields, header_json, load_json
from morgs_mi.core.camera import Camera
from tests.scenes.coded_clip import CAMERAS

SOUND = json.loads(header_json(CAMERAS, 25, {"seed": 1}))


def with_entry(path: str, text: str) -> bytes:
    """Return the JSON of a header with one entry replaced, or removed if `text` is empty."""
    header = json.loads(json.dumps(SOUND))
    *parents, last = (int(part) if part.isdecimal() else part for part in path.split("."))
    node: Any = header
    for part in parents:
        node = node[part]
    node[last] = "REPLACED"
    if not text:
        del node[last]
    return json.dumps(header).replace('"REPLACED"', text).encode()


@pytest.mark.parametrize(
    ("path", "text", "message"),
    [
        ("fps", "1e999", "numbers must be finite, got 1e999"),
        ("fps", "NaN", "numbers must be finite, got NaN"),
        ("fps", "0", "`fps` must lie between 1e-06 and 1000000, got 0"),
        ("fps", "-25", "`fps` must lie between"),
        ("fps", '"25"', "`fps` must be a number, got a string"),
        ("fps", "true", "`fps` must be a number, got a truth value"),
        ("fps", "1" + 400 * "0", "integers must have at most 64 bits, got 1000"),
        ("fps", "", "`fps` is missing"),
        ("cameras", "[]", "`cameras` must name at least one camera"),
        ("cameras", "{}", "`cameras` must be a list, got an object"),
        ("cameras.1", "7", r"`cameras\[1\]` must be an object, got an integer"),
        ("cameras.0.K.0.0", "-1", "must be finite with positive focal lengths"),
        ("metadata", "[]", "`metadata` must be an object, got a list"),
        ("metadata.seed", "1e999", "numbers must be finite"),
        ("metadata.seed", "[" * 31 + "]" * 31, "nested at most 32 levels deep"),
        ("metadata.seed", "[" * 100_000 + "]" * 100_000, "nested at most 32 levels deep"),
        ("metadata.seed", f'"{"x" * 2**22}"', "the JSON must have at most 4194304 bytes"),
    ],
    ids=lambda value: value[:20],
)
def test_header_fields__refuse_other_types_and_ranges(path: str, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        header_fields(with_entry(path, text))


@pytest.mark.parametrize(
    ("path", "text", "message"),
    [
        ("name", "3", "name` must be a string, got an integer"),
        ("name", '"\\u001b[2J"', "name` must be printable"),
        ("name", '"\\ud800"', "name` must be printable"),
        ("name", "", "name` is missing"),
        ("width", "32.5", "width` must be an integer, got a number"),
        ("width", "0", "width` must lie between 1 and"),
        ("height", "1000000", "width * height` must lie between 1 and"),
        ("near", "0", "near` must lie between"),
        ("near", "null", "near` must be a number, got null"),
        ("K", "[[1,0,0],[0,1,0]]", "K` must be a matrix [3][3]"),
        ("K.0.0", '"1"', "K` must be a number, got a string"),
        ("K.0.0", "1e300", "K` must lie between"),
        ("viewmat", "[1,2,3,4]", "viewmat` must be a matrix [4][4]"),
        ("viewmat.2.1", "[1]", "viewmat` must be a number, got a list"),
    ],
)
def test_header_fields__refuse_other_types_and_ranges_of_a_camera(
    path: str, text: str, message: str
) -> None:
    with pytest.raises(ValueError, match=re.escape(f"`cameras[0].{message}")):
        header_fields(with_entry(f"cameras.0.{path}", text))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "the JSON is broken"),
        (b"\xff\xfe", "not UTF-8"),
        (b'{"a": 1', "the JSON is broken"),
        (b"[1]", "`header` must be an object"),
    ],
)
def test_header_fields__refuse_other_json(data: bytes, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        header_fields(data)


def test_load_json__accepts_what_is_within_its_limits() -> None:
    deep = b"[" * 32 + b"]" * 32
    assert load_json(deep, len(deep)) == json.loads(deep)
    assert load_json(b"[18446744073709551615, -9223372036854775808, 1e308]", 99) == [
        2**64 - 1,
        -(2**63),
        1e308,
    ]


@pytest.mark.parametrize(
    ("cameras", "fps", "message"),
    [
        ([], 25, "a reader would refuse the header: `cameras` must name at least one"),
        (CAMERAS, 0, "a reader would refuse the header: `fps` must lie between"),
        (
            [Camera(CAMERAS[0].K, CAMERAS[0].viewmat, 2**14, 2**14)],
            25,
            r"a reader would refuse .* `cameras\[0\].width",
        ),
    ],
)
def test_stream_writer__refuses_a_header_that_a_reader_would_refuse(
    tmp_path, cameras, fps, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        StreamWriter(tmp_path / "s", cameras, fps)
    assert not (tmp_path / "s").exists()
