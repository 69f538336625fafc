"""Files and folders that appear whole or not at all, and JSON that every reader takes."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

__all__ = ["atomic_folder", "finite", "whole", "write_json"]


@contextmanager
def whole(path: str | os.PathLike[str], place: str) -> Iterator[Path]:
    """Give a name in the same folder to write a file or folder under, which becomes `path` if all goes well.

    If anything goes wrong, what was written vanishes and what stood at `path` stays. A file replaces a file, a folder
    one that was there from the start. Folders above are not made.

    Raises:
        OSError: the body or the renaming did, in a sentence that begins with `place`, e.g. ``write_json()``.
    """
    final = Path(path).resolve()  # a rename would replace a link, and `.` has no name
    partial, old = (final.with_name(f".{what}-{os.getpid()}-{final.name}") for what in ("partial", "old"))
    replaces_folder = os.path.isdir(final)  # unlike Path's, never raises
    for left in _left_behind(final):
        _remove(left)
    try:
        yield partial
        if replaces_folder and partial.is_dir():
            final.rename(old)  # deleting takes time, and a folder that is half deleted would look whole
        partial.replace(final)
    except OSError as error:
        reason = (error.strerror or str(error)).rstrip(".")
        if error.filename and str(error.filename) != str(partial):
            reason += f": {error.filename}"
        remedy = "check that its folder is writable and the disk has room"
        failure = OSError(f"{place}: cannot write {path}, nothing is left of the attempt: {reason}; {remedy}.")
        failure.strerror = reason  # so that a folder's sentence does not contain that of a file in it
        raise failure from error
    finally:
        if os.path.exists(old) and not os.path.exists(final):
            old.rename(final)
        _remove(partial)
        _remove(old)


@contextmanager
def atomic_folder(path: str | os.PathLike[str], place: str) -> Iterator[Path]:
    """Make a folder, and those above, under another name, which becomes `path` as in `whole`.

    Raises:
        FileExistsError: there is something at `path`.
        OSError: as `whole`.
    """
    if Path(path).exists():
        raise FileExistsError(f"{path}: expected a new folder, got one that exists; remove it first.")
    with whole(path, place) as partial:
        partial.mkdir(parents=True)
        yield partial


def write_json(path: str | os.PathLike[str], value: Mapping[str, Any]) -> None:
    """Write `value` as JSON; the file appears whole or not at all. What is not finite becomes null.

    Missing folders are made.

    Raises:
        OSError: the file cannot be written.
    """
    text = json.dumps(finite(value), indent=2, allow_nan=False) + "\n"
    with whole(path, "write_json()") as partial:
        partial.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(text, encoding="utf-8")


def finite(value: Any) -> Any:
    """Return `value` with None for every float in it that JSON cannot express."""
    if isinstance(value, Mapping):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _left_behind(final: Path) -> list[Path]:
    """Return what processes wrote that were to make `final` and were killed; one of them may have had our number."""
    own, named = str(os.getpid()), re.compile(rf"\.partial-(\d+)-{re.escape(final.name)}")
    found = ((path, named.fullmatch(path.name)) for path in final.parent.glob(".partial-*"))
    return [path for path, match in found if match and (match[1] == own or not _alive(int(match[1])))]


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # somebody else's
        pass
    return True


def _remove(path: Path) -> None:
    """Delete a file or a folder as far as that is possible."""
    shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.unlink()
