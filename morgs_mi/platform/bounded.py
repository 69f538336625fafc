"""Readers with memory bounded by the size of the file, whatever its header claims.

A file may make its reader use 10 times its size plus 200 MB. The allowance is for small files that
decode to large data without being broken, such as an image of one colour. Only regular files are
read: a pipe in a folder would keep its reader waiting, and a device may have no end.

Text is UTF-8, with or without a byte order mark. Settings have at most 256 kB, JSON files 64 MB.
"""

from __future__ import annotations

import json
import logging
import math
import os
import re
import stat
import tomllib
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np

from morgs_mi.platform.checks import few, require

JsonObject: TypeAlias = dict[str, Any]
"""Object of a JSON file, or table of a TOML file."""

_FACTOR = 10
_ALLOWANCE = 200_000_000
MAX_TOML = 256_000
"""Most bytes of a TOML file."""
MAX_JSON = 64_000_000
"""Most bytes of a JSON file."""
# Bytes of memory of an object, of a list, and of an item of either.
_JSON_BYTES = {"{": 200, "[": 60, ",": 40}
# tomllib takes time and memory by the square of the dots in a key. A key begins behind what is no
# part of a word or string, so that no character is searched often.
_LONG_KEY = re.compile(
    r"""(?<![\w\\-])(?:(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){21}"""
)
# Digits of a number that is not decimal, which Python does not print.
_LONG_NUMBER = re.compile(r"0[xob][\da-fA-F_]{1000}")


def most_memory(size: int) -> int:
    """Return the bytes of memory that a file of `size` bytes may make its reader use."""
    return _FACTOR * size + _ALLOWANCE


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
    require(
        claimed <= most_memory(size),
        path,
        f"expected content that fits its {size} bytes",
        f"a claim of {content}, which takes {claimed / 1e6:.0f} MB",
        "the file is broken, create it again",
    )


def regular(path: str | Path) -> Path:
    """Return the path of a file, which may be missing.

    Raises:
        ValueError: it is a folder, a pipe or a device.
    """
    path = Path(path)
    is_other = path.exists() and not path.is_file()
    require(not is_other, path, "expected a file", "a folder, a pipe or a device", "name a file")
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
        # Windows has no such flag.
        is_link = os.path.islink(path)
        require(not is_link, path, "expected a file", "a link", "open the file that it names")
        extra |= getattr(os, "O_NOFOLLOW", 0)
    file = open(  # noqa: SIM115 (the caller closes it)
        path, "rb", opener=lambda name, flags: os.open(name, flags | extra)
    )
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise ValueError(f"{path}: expected a file, got a pipe or a device; remove it.")
    return file


def read_bytes(path: str | Path, most: float = math.inf) -> bytes:
    """Return the content of a regular file.

    Raises:
        OSError: there is no such file, or it cannot be read.
        ValueError: it is no regular file, or has more bytes than `most`.
    """
    size = regular(path).stat().st_size
    require(
        size <= most, path, f"expected at most {most} bytes", size, "leave out what is not needed"
    )
    return Path(path).read_bytes()


def read_text(path: str | Path, most: float = math.inf) -> str:
    """Return the text in a file, without a byte order mark; `most` as for `read_bytes`.

    Raises:
        OSError: there is no such file, or it cannot be read.
        ValueError: as for `read_bytes`, or the file is no text.
    """
    data = read_bytes(path, most)
    with _refusing(path, "text in UTF-8", "save it as UTF-8"):
        return data.decode("utf-8-sig")


def read_toml(path: str | Path) -> JsonObject:
    """Return the content of a TOML file.

    Raises:
        OSError: there is no such file, or it cannot be read.
        ValueError: the file is broken, too large or nested too deeply, or a key or a number is too
            long.
    """
    text = read_text(path, MAX_TOML)
    has_long_key = _LONG_KEY.search(text) is not None
    require(not has_long_key, path, "expected keys of at most 20 dots", "more", "nest fewer tables")
    has_long_number = _LONG_NUMBER.search(text) is not None
    require(not has_long_number, path, "expected numbers below 1000 digits", "more", "correct it")
    with _refusing(path, "TOML", "write it again"):
        return tomllib.loads(text)


def read_json(path: str | Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        OSError: there is no such file, or it cannot be read.
        ValueError: it is no regular file, is broken, too large or nested too deeply, or has too
            many objects and lists for its size.
    """
    text = read_text(path, MAX_JSON)
    claimed = sum(size * text.count(mark) for mark, size in _JSON_BYTES.items())
    check_claim(path, claimed, "many small objects and lists")
    with _refusing(path, "JSON", "write it again"):
        return json.loads(text)


def read_array(path: str | Path, name: str | None = None) -> np.ndarray:
    """Return the array in a NumPy file, or the array `name` in an archive (.npz).

    Raises:
        ValueError: the file is broken, claims more numbers than it holds, or holds Python objects.
    """
    what = "a NumPy array" if name is None else f"an array `{name}` in a NumPy archive"
    with _refusing(path, what, "export it again"):
        if name is None:
            data = read_bytes(path)
        else:
            with zipfile.ZipFile(BytesIO(read_bytes(path))) as archive:
                size = archive.getinfo(f"{name}.npy").file_size
                check_claim(path, size, f"{size} bytes of {name}.npy")
                data = archive.read(f"{name}.npy")
        stream = BytesIO(data)
        read_header = (
            np.lib.format.read_array_header_1_0
            if np.lib.format.read_magic(stream) == (1, 0)
            else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = read_header(stream)
        if math.prod(shape) * dtype.itemsize > len(data):
            raise ValueError(f"its header claims {dtype} {shape}, but it has {len(data)} bytes")
        stream.seek(0)
        array = np.lib.format.read_array(stream, allow_pickle=False)
        if array.dtype.kind not in "fiub":
            raise ValueError(f"it holds {array.dtype}, not numbers")
        return array


def array_names(path: str | Path) -> list[str]:
    """Return the names of the arrays in a NumPy archive (.npz).

    Raises:
        ValueError: the file is broken.
    """
    with (
        _refusing(path, "a NumPy archive", "export it again"),
        zipfile.ZipFile(BytesIO(read_bytes(path))) as archive,
    ):
        return [name.removesuffix(".npy") for name in archive.namelist()]


@contextmanager
def _refusing(path: str | Path, expected: str, remedy: str) -> Iterator[None]:
    """Raise the errors of a parser, which may be of any class, as an error of the file."""
    try:
        yield
    except OSError:
        raise
    except Exception as error:
        raise ValueError(
            f"{path}: expected {expected}, got a broken file ({error}); {remedy}."
        ) from None


_LOG = logging.getLogger(__name__)


def warn_unread(path: Path, names: Iterable[str]) -> None:
    """Name in one warning the entries of a file that are not understood, if there are any; a name
    may occur often.
    """
    if unread := sorted(set(names)):
        _LOG.warning("%s: not understood and not used: %s.", path, few(unread))
