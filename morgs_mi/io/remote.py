"""Captures at URLs, such as ``s3://bucket/capture``, read through fsspec.

A capture is mirrored in a folder of ``~/.cache/morgs_mi/captures``. Calibrations are fetched when it is opened; videos
and images are empty files there until they are read, so that a process fetches only what it decodes. The name of the
folder depends on names, sizes and times of the remote files, so that a capture that has changed is fetched again.
Ground truth is not fetched.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path
from typing import Any

__all__ = ["fetched", "is_url", "mirrored", "url_of"]

# Entries of fsspec's listings that change with a file, by file system.
_VERSION = ("size", "mtime", "created", "LastModified", "ETag", "etag", "last_modified", "md5Hash", "generation")
_FETCHED_LATER = (".mp4", ".mkv", ".avi", ".mov", ".webm", ".png", ".jpg", ".jpeg")
_IGNORED = "truth"
_URL = ".url"  # file in a mirrored folder


def is_url(path: str | Path) -> bool:
    """Return whether a path is a URL with a protocol."""
    return isinstance(path, str) and "://" in path


def mirrored(url: str) -> Path:
    """Return the local folder of a capture at a URL, see the module.

    Raises:
        FileNotFoundError: there are no files.
        ConnectionError: the place does not answer.
        PermissionError: it refuses to list or to read its files.
        ValueError: fsspec does not know the protocol, or it or a package for it is missing.
    """
    system, root = _file_system(url)
    with _failures(url):
        system.invalidate_cache()
        listing: Mapping[str, Mapping[str, Any]] = system.find(root, detail=True)
    files = {path.removeprefix(root).lstrip("/"): about for path, about in sorted(listing.items())}
    files = {name: about for name, about in files.items() if name and name.split("/")[0] != _IGNORED}
    if not files:
        raise FileNotFoundError(f"{url}: expected a capture folder, found no files; check the URL.")
    if outside := next((name for name in files if ".." in name.split("/")), None):
        raise ValueError(f"{url}: expected files in the folder, got {outside}; rename it.")
    versions = [(name, [str(about.get(key)) for key in _VERSION]) for name, about in files.items()]
    digest = blake2b(repr((url, versions)).encode(), digest_size=8).hexdigest()
    folder = _cache() / digest / root.rstrip("/").rpartition("/")[2]
    for name in files:
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix.lower() in _FETCHED_LATER:
            file.touch()
        elif not file.exists():
            _fetch(system, url, f"{root.rstrip('/')}/{name}", file)
    (folder / _URL).write_text(url, encoding="utf-8")
    return folder


def fetched(file: Path) -> Path:
    """Return a file, which is fetched before if it is an empty one in a mirrored folder.

    Raises:
        OSError, ValueError: as for `mirrored`.
    """
    if file.is_file() and not file.stat().st_size and (folder := _mirror_of(file)) is not None:
        url = (folder / _URL).read_text(encoding="utf-8")
        system, root = _file_system(url)
        _fetch(system, url, f"{root.rstrip('/')}/{file.relative_to(folder).as_posix()}", file)
    return file


def url_of(folder: Path) -> str | None:
    """Return the URL of a mirrored folder, None for any other."""
    mirror = _mirror_of(folder / _URL)
    return (folder / _URL).read_text(encoding="utf-8") if mirror == folder else None


def _cache() -> Path:
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "morgs_mi", "captures")
    return cache.resolve()


def _mirror_of(file: Path) -> Path | None:
    """Return the mirrored folder that a file is in."""
    cache = _cache()
    if cache not in file.parents:
        return None
    return next((folder for folder in file.parents if (folder / _URL).is_file()), None)


def _file_system(url: str) -> tuple[Any, str]:
    """Return the file system of a URL, and the path there."""
    try:
        from fsspec.core import url_to_fs
    except ImportError:
        raise ValueError(f"{url}: reading it needs the package fsspec; pip install 'morgs-mi[cluster]'.") from None
    try:
        with _failures(url):
            return url_to_fs(url)
    except ImportError as error:
        raise ValueError(f"{url}: reading it needs another package: {error}.") from None
    except ValueError as error:
        raise ValueError(f"{url}: expected a URL that fsspec can open, got an error: {error}.") from None


def _fetch(system: Any, url: str, remote: str, file: Path) -> None:
    """Copy a remote file; several processes may fetch the same one."""
    partial = file.with_name(f".{file.name}-{os.getpid()}-{threading.get_ident()}")
    try:
        with _failures(f"{url}: {remote}"):
            system.get_file(remote, str(partial))
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def _failures(place: str) -> Iterator[None]:
    """Raise what file systems raise as errors with one sentence."""
    try:
        yield
    except FileNotFoundError:
        raise FileNotFoundError(f"{place}: expected a file or a folder, found none; check the URL.") from None
    except PermissionError as error:
        raise PermissionError(f"{place}: expected to be allowed to read it, got {error}; check the rights.") from None
    except (ImportError, ValueError):
        raise
    except Exception as error:  # the libraries of the protocols have errors of their own
        raise ConnectionError(f"{place}: expected to read it, got {str(error) or type(error).__name__}.") from None
