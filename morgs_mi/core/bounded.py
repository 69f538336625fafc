"""Readers with memory bounded by the size of the file, whatever its header claims.

A file may make its reader use 10 times its size plus 200 MB. The allowance is for small files that
decode to large data without being broken, such as an image of one colour. Only regular files are
read: a pipe in a folder would keep its reader waiting, and a device may have no end.

Text is UTF-8, with or without a byte order mark. Settings have at most 256 kB, JSON files 64 MB.
"""

from __future__ import annotations

import json
import math
import os
import stat
import tokenize
import tomllib
import zipfile
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

_FACTOR = 10
_ALLOWANCE = 200_000_000
# Errors of NumPy and zipfile for broken files. NumPy parses headers as Python.
_BROKEN = (
    ValueError,
    TypeError,
    EOFError,
    KeyError,
    MemoryError,
    RuntimeError,
    OverflowError,
    SyntaxError,
    zipfile.BadZipFile,
    zlib.error,
    tokenize.TokenError,
)
MAX_TOML = 256_000
"""Most bytes of a TOML file."""
MAX_JSON = 64_000_000
"""Most bytes of a JSON file."""


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


def open_regular(path: str | Path, follow: bool = True) -> BinaryIO:
    """Open a regular file to read it; the file is the one that was checked, even if the path is
    replaced meanwhile.

    Args:
        path: the file.
        follow: whether `path` may be a link to it.

    Raises:
        OSError: there is no such file, or it cannot be read.
        ValueError: it is a pipe or a device, or a link that is not followed.
    """
    # Opening a pipe would wait for its writer.
    extra = getattr(os, "O_NONBLOCK", 0)
    if not follow:
        if os.path.islink(path):  # Windows has no such flag
            raise ValueError(f"{path}: expected a file, got a link; open the file that it names.")
        extra |= getattr(os, "O_NOFOLLOW", 0)
    file = open(  # noqa: SIM115 (the caller closes it)
        path, "rb", opener=lambda name, flags: os.open(name, flags | extra)
    )
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise ValueError(f"{path}: expected a file, got a pipe or a device; remove it.")
    return file


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


def read_text(path: str | Path, most: int | None = None) -> str:
    """Return the text in a file, without a byte order mark; `most` as for `read_bytes`.

    Raises:
        OSError: there is no such file, or it cannot be read.
        ValueError: as for `read_bytes`, or the file is no text.
    """
    data = read_bytes(path, most)
    try:
        return data.decode("utf-8-sig")
    except UnicodeError as error:
        raise ValueError(
            f"{path}: expected text in UTF-8, got other bytes ({error}); save it as UTF-8."
        ) from None


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return the content of a TOML file.

    Raises:
        OSError: there is no such file, or it cannot be read.
        ValueError: the file is broken, too large or nested too deeply.
    """
    return _parsed(path, MAX_TOML, "TOML", tomllib.loads)


def read_json(path: str | Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        OSError: there is no such file, or it cannot be read.
        ValueError: it is no regular file, is broken, too large or nested too deeply.
    """
    return _parsed(path, MAX_JSON, "JSON", json.loads)


def _parsed(path: str | Path, most: int, language: str, parse: Callable[[str], Any]) -> Any:
    """Return the result of a parser for a text file, whose errors are raised as errors of the
    file.
    """
    text = read_text(path, most)
    try:
        return parse(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(
            f"{path}: expected {language}, got a broken file ({error}); write it again."
        ) from None


def read_array(path: str | Path, name: str | None = None) -> np.ndarray:
    """Return the array in a NumPy file, or the array `name` in an archive (.npz); it is not
    writable.

    Raises:
        ValueError: the file is broken, claims more numbers than it holds, or holds Python objects.
    """
    try:
        if name is None:
            data = read_bytes(path)
        else:
            with zipfile.ZipFile(regular(path)) as archive:
                size = archive.getinfo(f"{name}.npy").file_size
                check_claim(path, size, f"{size} bytes of {name}.npy")
                data = archive.read(f"{name}.npy")
        stream = BytesIO(data)
        read_header = (
            np.lib.format.read_array_header_1_0
            if np.lib.format.read_magic(stream) == (1, 0)
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
    except _BROKEN as error:
        what = "a NumPy array" if name is None else f"an array `{name}` in a NumPy archive"
        raise ValueError(
            f"{path}: expected {what}, got a broken file ({error}); export it again."
        ) from None


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
