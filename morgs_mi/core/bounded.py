"""Readers with memory bounded by the size of the file, whatever its header claims.

A file may make its reader use 10 times its size plus 200 MB. The allowance is for small files that
decode to large data without being broken, such as an image of one colour. Only regular files are
read: a pipe in a folder would keep its reader waiting, and a device may have no end.

Text is UTF-8, or UTF-16 or UTF-32 as shells of Windows write it, with or without a byte order mark.
"""

from __future__ import annotations

import json
import math
import re
import tokenize
import tomllib
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from operator import mul
from pathlib import Path
from typing import Any

import numpy as np

_FACTOR = 10
_ALLOWANCE = 200_000_000
# Errors of NumPy and zipfile for broken files. NumPy parses headers as Python.
_BROKEN = (
    *(
        ValueError,
        TypeError,
        EOFError,
        KeyError,
        MemoryError,
        RuntimeError,
        OverflowError,
        zipfile.BadZipFile,
    ),
    *(zlib.error, SyntaxError, tokenize.TokenError),
)
# At most, in bytes: an empty dict or list as the value of a list, and a number or a short key with
# its reference.
_DICT_BYTES = 240
_LIST_BYTES = 64
_VALUE_BYTES = 40
# A text in JSON, which may lack its end.
_TEXT = re.compile(r'"(?:[^"\\]|\\.)*+"?', re.DOTALL)
# Size of a TOML file, bytes that its parser takes for a table, and parts of a key: memory and time
# grow with the square of their number.
MAX_TOML = 1_000_000
_TABLE_BYTES = 1000
_MAX_PARTS = 32
# A comment or a string of a TOML file, which may lack its end. Every branch consumes what it has
# searched.
_COMMENT = r"#[^\n]*+"
_STRING = (
    r'"""(?:[^"\\]|\\.|"(?!""))*+(?:"{3,5})?'
    r"|'''(?:[^']|'(?!''))*+(?:'{3,5})?"
    r'|"(?:[^"\\\n]|\\[^\n])*+"?'
    r"|'[^'\n]*+'?"
)
_TOKEN = re.compile(f"(?P<comment>{_COMMENT})|(?:{_STRING})", re.DOTALL)
# A key or a number with its parts, and the character that shows that it is a key: of a value or of
# a table.
_WORD = re.compile(r"([^\s.=,\[\]{}]++(?:[ \t]*+\.[ \t]*+[^\s.=,\[\]{}]++)*+)[ \t]*+([=\]]?)")


def check_claim(path: str | Path, claimed: int, content: str) -> None:
    """Check that decoding a file takes no more memory than its size allows.

    Args:
        path: the file.
        claimed: bytes that the decoded content takes.
        content: claimed content of the file, for the message, e.g. ``an image of 20000x20000
            pixels``.

    Raises:
        ValueError: it takes more.
    """
    size = Path(path).stat().st_size
    if claimed > _FACTOR * size + _ALLOWANCE:
        raise ValueError(
            f"{path}: expected content that fits its {size} bytes, got a claim of {content}, "
            f"which takes {claimed / 1e6:.0f} MB; the file is broken, create it again."
        )


def regular(path: str | Path) -> Path:
    """Return the path of a file, which may be missing.

    Raises:
        ValueError: it is a folder, a pipe or a device.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise ValueError(f"{path}: expected a file, got a folder, a pipe or a device; remove it.")
    return path


def read_bytes(path: str | Path, most: int | None = None) -> bytes:
    """Return the content of a regular file.

    Raises:
        OSError: there is no such file, or it cannot be read.
        ValueError: it is no regular file, or has more bytes than `most`.
    """
    path = regular(path)
    if most is not None and path.stat().st_size > most:
        raise ValueError(
            f"{path}: expected at most {most} bytes, got {path.stat().st_size}; leave out what is "
            "not needed."
        )
    return path.read_bytes()


def encoding_of(start: bytes) -> str:
    """Return the encoding of a text that begins with these bytes, of which the first two are of
    ASCII.
    """
    return json.detect_encoding(start[:4])


def read_text(path: str | Path, most: int | None = None) -> str:
    """Return the text in a file, without a byte order mark; `most` as for `read_bytes`.

    Raises:
        OSError: there is no such file, or it cannot be read.
        ValueError: as for `read_bytes`, or the file is no text.
    """
    data = read_bytes(path, most)
    try:
        return data.decode(encoding_of(data))
    except UnicodeError as error:
        raise ValueError(
            f"{path}: expected text in UTF-8, got other bytes ({error}); save it as UTF-8."
        ) from None


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return the content of a TOML file.

    Raises:
        OSError: there is no such file, or it cannot be read.
        ValueError: the file is broken, too large, nested too deeply, or has too many tables.
    """
    text = read_text(path, MAX_TOML)
    tables, most_dots = _toml_claim(text)
    check_claim(path, _TABLE_BYTES * tables, f"{tables} tables")
    with _syntax_errors(path, "TOML"):
        if most_dots >= _MAX_PARTS:
            raise ValueError(f"a key has more than {_MAX_PARTS} parts")
        return tomllib.loads(text)


def _toml_claim(text: str) -> tuple[int, int]:
    """Return the number of tables of a TOML text at most, and the most dots in a key."""
    structure = _TOKEN.sub(lambda token: "" if token["comment"] else "s", text)
    words = [(word.count("."), end) for word, end in _WORD.findall(structure)]
    tables = sum(dots for dots, end in words if end) + sum(map(structure.count, "[{"))
    return tables, max((dots for dots, _ in words), default=0)


def read_json(path: str | Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        OSError: there is no such file, or it cannot be read.
        ValueError: it is no regular file, is broken, nested too deeply, or has too many tiny
            values.
    """
    text = read_text(path)
    claim, values = _json_claim(text)
    if claim > _ALLOWANCE:  # the punctuation of texts takes no memory
        claim, values = _json_claim(_TEXT.sub("", text))
    check_claim(path, claim, f"{values} values")
    with _syntax_errors(path, "JSON"):
        return json.loads(text)


@contextmanager
def _syntax_errors(path: str | Path, language: str) -> Iterator[None]:
    """Raise the errors of a parser as errors of the file."""
    try:
        yield
    except (ValueError, RecursionError) as error:
        raise ValueError(
            f"{path}: expected {language}, got a broken file ({error}); write it again."
        ) from None


def _json_claim(text: str) -> tuple[int, int]:
    """Return bytes that the values of a JSON text take at most, and their number."""
    counts = [text.count(mark) for mark in "{[,"]
    return sum(map(mul, counts, (_DICT_BYTES, _LIST_BYTES, _VALUE_BYTES))), sum(counts)


def read_array(path: str | Path, name: str | None = None) -> np.ndarray:
    """Return the array in a NumPy file, or the array `name` in an archive (.npz); it is not
    writable.

    Raises:
        ValueError: the file is broken, claims more numbers than it holds, or holds Python objects.
    """
    try:
        return _parsed_array(read_bytes(path) if name is None else _member(path, f"{name}.npy"))
    except _BROKEN as error:
        what = "a NumPy array" if name is None else f"an array `{name}` in a NumPy archive"
        raise ValueError(
            f"{path}: expected {what}, got a broken file ({error}); export it again."
        ) from None


def _parsed_array(data: bytes) -> np.ndarray:
    """Return the array in the bytes of a NumPy file."""
    stream = BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read_header = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, in_columns, dtype = read_header(stream)
    # NumPy would execute what such a file contains.
    if dtype.hasobject:
        raise ValueError("it holds Python objects, not numbers")
    count = math.prod(shape)
    num_bytes = len(data) - stream.tell()
    if min(shape, default=0) < 0 or count * dtype.itemsize != num_bytes:
        raise ValueError(f"its header claims {dtype} {shape}, but {num_bytes} bytes follow")
    flat = np.frombuffer(data, dtype, count, stream.tell())
    return flat.reshape(shape, order="F" if in_columns else "C")


def array_names(path: str | Path) -> list[str]:
    """Return the names of the arrays in a NumPy archive (.npz).

    Raises:
        ValueError: the file is broken.
    """
    try:
        with zipfile.ZipFile(regular(path)) as archive:
            return [name.removesuffix(".npy") for name in archive.namelist()]
    except _BROKEN as error:
        raise ValueError(
            f"{path}: expected a NumPy archive, got a broken file ({error}); export it again."
        ) from None


def _member(path: str | Path, name: str) -> bytes:
    with zipfile.ZipFile(regular(path)) as archive:
        size = archive.getinfo(name).file_size
        check_claim(path, size, f"{size} bytes of {name}")
        return archive.read(name)
