"""Atomic creation of files and folders, and JSON that every reader accepts."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
from collections.abc import Generator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

__all__ = ["atomic_folder", "atomic_path", "json_finite", "write_json"]


@contextmanager
def atomic_path(path: str | os.PathLike[str], place: str) -> Generator[Path, None, None]:
    """Yield a path in the same folder for a file or folder, which is renamed to `path` when the body succeeds.

    On failure what was written is removed and `path` stays as it was. A file replaces a file; a folder replaces one
    that existed from the start. Parent folders are not created.

    Raises:
        OSError: raised by the body or the renaming; its sentence begins with `place`, e.g. ``write_json()``.
    """
    final = Path(path).resolve()  # a rename would replace a link, and `.` has no name
    partial, old = (final.with_name(f".{what}-{os.getpid()}-{final.name}") for what in ("partial", "old"))
    replaces_folder = os.path.isdir(final)  # unlike Path's, never raises
    for left in _left_behind(final):
        _remove(left)
    try:
        yield partial
        if replaces_folder and partial.is_dir():
            final.rename(old)  # deleting takes time, and a half-deleted folder would look complete
        partial.replace(final)
    except OSError as error:
        reason = (error.strerror or str(error)).rstrip(".")
        if error.filename and str(error.filename) != str(partial):
            reason += f": {error.filename}"
        remedy = "check that its folder is writable and the disk has room"
        failure = OSError(f"{place}: cannot write {path}, the partial output was removed: {reason}; {remedy}.")
        failure.strerror = reason  # so that a folder's sentence does not contain that of a file in it
        raise failure from error
    finally:
        if os.path.exists(old) and not os.path.exists(final):
            old.rename(final)
        _remove(partial)
        _remove(old)


@contextmanager
def atomic_folder(path: str | os.PathLike[str], place: str) -> Generator[Path, None, None]:
    """Create a folder and its parents under another name, which is renamed to `path` as by `atomic_path`.

    Raises:
        FileExistsError: `path` exists.
        OSError: as `atomic_path`.
    """
    if Path(path).exists():
        raise FileExistsError(f"{path}: expected a new folder, got one that exists; remove it first.")
    with atomic_path(path, place) as partial:
        partial.mkdir(parents=True)
        yield partial


def write_json(path: str | os.PathLike[str], value: Mapping[str, Any]) -> None:
    """Write `value` as JSON atomically, with null for floats that are not finite; missing folders are created.

    Raises:
        OSError: the file cannot be written.
    """
    text = json.dumps(json_finite(value), indent=2, allow_nan=False) + "\n"
    with atomic_path(path, "write_json()") as partial:
        partial.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(text, encoding="utf-8")


def json_finite(value: Any) -> Any:
    """Return `value` with None for every float in it that JSON cannot represent."""
    if isinstance(value, Mapping):
        return {key: json_finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [json_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _left_behind(final: Path) -> list[Path]:
    """Return the partial files of `final` of killed processes, one of which may have had this process's number."""
    own, named = str(os.getpid()), re.compile(rf"\.partial-(\d+)-{re.escape(final.name)}")
    found = ((path, named.fullmatch(path.name)) for path in final.parent.glob(".partial-*"))
    return [path for path, match in found if match and (match[1] == own or not _alive(int(match[1])))]


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # it belongs to another user
        pass
    return True


def _remove(path: Path) -> None:
    """Delete a file or a folder as far as that is possible."""
    shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.unlink()
