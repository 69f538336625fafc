"""Atomic creation of files and folders, locked folders, and JSON that every reader accepts.

Names of the files in the folder of a fit, and of a capture's settings.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Generator, Iterable, Mapping
from contextlib import ExitStack, contextmanager, suppress
from errno import ENOLCK, ENOTSUP
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

STREAM = "stream.morgs"
"""The stream."""
PROVISIONAL = "provisional.morgs"
"""The stream beside it that has a provisional first frame, until the fit has the first frame."""
REPORT = "report.json"
"""The report of every frame."""
CAPTURE = "capture.json"
"""The path of the capture and how it was read; in a capture, its settings."""


FilePath = str | os.PathLike[str]
_LOCK = ".morgs-lock"


@contextmanager
def atomic_path(path: FilePath, place: str, parents: bool = False) -> Generator[Path, None, None]:
    """Yield a path in the same folder for a file or folder, which is renamed to `path` when the
    body succeeds.

    On failure what was written is removed and `path` stays as it was; a process that is killed
    leaves it beside `path`, as ``.partial-PROCESS-NAME``. A file replaces a file; a folder replaces
    one that existed from the start. Missing `parents` are created where asked for.

    Raises:
        FileExistsError: `path` is a device or a pipe.
        OSError: raised by the body or the renaming; its sentence begins with `place`, e.g.
            ``write_json()``.
    """
    # A rename would replace a link, except one to itself, and `.` has no name.
    final = Path(os.path.realpath(path))
    partial = final.with_name(f".partial-{os.getpid()}-{final.name}")
    old = final.with_name(f".old-{os.getpid()}-{final.name}")
    replaces_folder = os.path.isdir(final)  # unlike Path's, never raises
    if os.path.exists(final) and not (replaces_folder or os.path.isfile(final)):
        raise FileExistsError(
            f"{place}: {path} is a device or a pipe, which would be replaced; name a file."
        )
    _remove(partial)  # of a killed process that had this process's number
    try:
        if parents:
            final.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        if replaces_folder and partial.is_dir():
            final.rename(old)  # deleting takes time, and a half-deleted folder would look complete
        partial.replace(final)
    except OSError as error:
        raise write_error(f"{place}: cannot write {path}", error, partial) from error
    finally:
        if os.path.exists(old) and not os.path.exists(final):
            old.rename(final)
        _remove(partial)
        _remove(old)


@contextmanager
def atomic_folder(path: FilePath, place: str) -> Generator[Path, None, None]:
    """Create a folder and its parents under another name, which is renamed to `path` as by
    `atomic_path`.

    Raises:
        FileExistsError: `path` exists.
        OSError: as `atomic_path`.
    """
    if Path(path).exists():
        raise FileExistsError(
            f"{path}: expected a new folder, got one that exists; remove it first."
        )
    with atomic_path(path, place) as partial:
        partial.mkdir(parents=True)
        yield partial


@contextmanager
def locked_folder(path: FilePath, place: str) -> Generator[None, None, None]:
    """Create a folder with its parents if it is missing, and lock it against other writers while
    the body runs.

    The lock is an empty file in the folder, which is removed at the end, as are the created folders
    that are still empty. A killed process leaves the file, but not the lock. A file system without
    locks is not locked.

    Raises:
        BlockingIOError: another writer has locked the folder.
        OSError: the folder cannot be created or written; the sentence begins with `place`.
    """
    folder = Path(path)
    file = folder / _LOCK
    new_folders = [parent for parent in (folder, *folder.parents) if not os.path.lexists(parent)]
    with ExitStack() as undo:
        undo.callback(_remove_empty, new_folders)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            undo.enter_context(FileLock(file, blocking=False))
        except Timeout:
            raise BlockingIOError(
                f"{path}: expected a folder into which nothing else is written, got one into which "
                "another process is writing; wait until it has ended, or choose another folder."
            ) from None
        except FileExistsError:
            raise FileExistsError(f"{place}: {path} is a file; name a folder.") from None
        except OSError as error:
            if error.errno not in (ENOLCK, ENOTSUP):
                raise write_error(f"{place}: cannot write into {path}", error, folder) from error
        undo.callback(_remove, file)
        yield


def is_same_file(path: FilePath, status: os.stat_result) -> bool:
    """Return whether `path` still is the file that was opened: it was not removed, moved or
    replaced since.
    """
    try:
        return os.path.samestat(os.stat(path), status)
    except OSError:
        return False


def write_json(path: FilePath, value: Mapping[str, Any]) -> None:
    """Write `value` as JSON atomically, with null for floats that are not finite; missing folders
    are created.

    Raises:
        OSError: the file cannot be written.
    """
    text = json.dumps(json_finite(value), indent=2, allow_nan=False) + "\n"
    with atomic_path(path, "write_json()", parents=True) as partial:
        partial.write_text(text, encoding="utf-8")


def json_finite(value: Any) -> Any:
    """Return `value` as JSON has it, with None for every float in it that JSON cannot represent."""
    return json.loads(json.dumps(value, default=dict), parse_constant=lambda _: None)


def write_error(start: str, error: Exception, target: Path) -> OSError:
    """Return an error with the reason of another one, and its file unless that is `target`."""
    reason = (getattr(error, "strerror", None) or str(error)).rstrip(".")
    if (file := getattr(error, "filename", None)) and str(file) != str(target):
        reason += f": {file}"
    failure = OSError(
        f"{start}: {reason}; check that its folder is writable and the disk has room."
    )
    # Otherwise a folder's sentence would contain the sentence of a file in it.
    failure.strerror = reason
    return failure


def _remove_empty(folders: Iterable[Path]) -> None:
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def _remove(path: Path) -> None:
    """Delete a file or a folder as far as that is possible."""
    shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.unlink()
