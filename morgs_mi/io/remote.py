"""Captures at URLs, such as ``s3://bucket/capture``, read through fsspec.

A capture is mirrored in a folder of ``~/.cache/morgs_mi/captures``. Calibrations are fetched when
it is opened. Videos and images are empty files there until they are read: a process fetches only
the files that it decodes. The name of the folder depends on names, sizes and versions of the remote
files (time, ETag or checksum): a capture that has changed is fetched again, and one without
versions at every opening. Ground truth is not fetched.
"""

from __future__ import annotations

import atexit
import json
import os
import shutil
import threading
import uuid
from collections.abc import Collection, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path
from typing import Any

from morgs_mi.core.files import write_json
from morgs_mi.core.llvm import cache_folder
from morgs_mi.io.listing import EXR_SUFFIX, IMAGE_SUFFIXES, VIDEO_SUFFIXES, is_listed

# Entries of fsspec's listings that change with a file, by file system. A size alone does not prove
# that it is the same.
_VERSION = (
    # Disks and clouds.
    *("mtime", "created", "LastModified", "ETag", "etag", "last_modified", "md5Hash", "generation"),
    *("Last-Modified", "Content-MD5", "Digest"),  # http
    *("modify", "modificationTime", "date_time", "sha"),  # ftp, webhdfs, archives, GitHub
)
_PAGE = (b"<!doctype html", b"<html")
_IGNORED = "truth"
# Files that are fetched when they are read.
_LATER = (*VIDEO_SUFFIXES, *IMAGE_SUFFIXES, EXR_SUFFIX)
_INDEX = ".remote.json"  # file in a mirrored folder: its URL, and the sizes of the files
# Seconds to wait for a connection and for each further piece of a file, and requests at a time.
PATIENCE = 60
_REQUESTS = 16


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
    base = root.rstrip("/")
    files = _files(system, url, base)
    if not all(map(_versions, files.values())):
        with _failures(url):
            files = _entries(system, base, files)
    folder = _folder(url, files) / base.rpartition("/")[2]
    sizes = {name: entry.get("size") for name, entry in files.items()}
    for name, size in sizes.items():
        _mirror_file(system, url, f"{base}/{name}", folder / name, size)
    write_json(folder / _INDEX, {"url": url, "sizes": sizes})
    return folder


def _mirror_file(system: Any, url: str, remote: str, file: Path, size: int | None) -> None:
    """Fetch a remote file, or create an empty one if it is fetched when it is read."""
    file.parent.mkdir(parents=True, exist_ok=True)
    if file.suffix.lower() in _LATER:
        file.touch()
    elif not file.exists():
        _fetch(system, url, remote, file, size)


def fetched(file: Path) -> Path:
    """Return a file, which is fetched before if it is an empty one in a mirrored folder.

    Raises:
        OSError, ValueError: as for `mirrored`.
    """
    if file.is_file() and not file.stat().st_size and (folder := _mirror_of(file)) is not None:
        index = _index(folder)
        name = file.relative_to(folder).as_posix()
        system, root = _file_system(index["url"])
        _fetch(system, index["url"], f"{root.rstrip('/')}/{name}", file, index["sizes"].get(name))
    return file


def url_of(folder: Path) -> str | None:
    """Return the URL of a mirrored folder, None for any other."""
    return _index(folder)["url"] if _mirror_of(folder / _INDEX) == folder else None


def _cache() -> Path:
    return (cache_folder() / "captures").resolve()


def _files(system: Any, url: str, base: str) -> dict[str, Mapping[str, Any]]:
    """Return the entries of the files in a folder at a URL, by their names there, in order."""
    with _failures(url):
        system.invalidate_cache()
        paths = _listing(system, base)
    files = {path.removeprefix(base).lstrip("/"): entry for path, entry in paths.items()}
    # A name with a query is a link of a server's listing, by which it is sorted.
    files = {name: files[name] for name in sorted(files) if name and "?" not in name}
    if not files:
        raise FileNotFoundError(f"{url}: expected a capture folder, found no files; check the URL.")
    if outside := next((name for name in files if ".." in name.split("/")), None):
        raise ValueError(f"{url}: expected files in the folder, got {outside}; rename it.")
    return files


def _entries(system: Any, base: str, names: Collection[str]) -> dict[str, Mapping[str, Any]]:
    """Return what the file system states of each file alone, which may be more than its listing."""
    with ThreadPoolExecutor(_REQUESTS) as requests:
        entries = requests.map(lambda name: system.info(f"{base}/{name}"), names)
        return dict(zip(names, entries, strict=True))


def _listing(system: Any, base: str) -> dict[str, Mapping[str, Any]]:
    """Return the files below a folder by path; fsspec's `find` would leave out folders that it
    cannot list.
    """
    entries = {}
    folders = [base]
    for folder in folders:  # which grows
        for entry in system.ls(folder, detail=True):
            path = entry["name"].rstrip("/")
            if not is_listed(path.rpartition("/")[2]):
                continue
            if entry["type"] != "directory":
                entries[path] = entry
            elif path not in (*folders, f"{base}/{_IGNORED}"):
                folders.append(path)
    return entries


def _folder(url: str, files: Mapping[str, Mapping[str, Any]]) -> Path:
    """Return the folder of these versions of files; a new one, until the process ends, if one has
    no version.
    """
    has_versions = all(map(_versions, files.values()))
    versions = [(name, entry.get("size"), _versions(entry)) for name, entry in files.items()]
    content = repr((url, versions)) if has_versions else uuid.uuid4().hex
    folder = _cache() / blake2b(content.encode(), digest_size=8).hexdigest()
    if not has_versions:
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _versions(entry: Mapping[str, Any]) -> list[str]:
    """Return the values of `_VERSION` in an entry of a listing, which change with its file; empty
    without any.
    """
    return [f"{key} {entry[key]}" for key in _VERSION if entry.get(key)]


def _mirror_of(file: Path) -> Path | None:
    """Return the mirrored folder that a file is in."""
    cache = _cache()
    if cache not in file.parents:
        return None
    return next((folder for folder in file.parents if (folder / _INDEX).is_file()), None)


def _index(folder: Path) -> dict[str, Any]:
    return json.loads((folder / _INDEX).read_text(encoding="utf-8"))


def _file_system(url: str) -> tuple[Any, str]:
    """Return the file system of a URL, and the path there."""
    try:
        from fsspec.core import url_to_fs
    except ImportError:
        raise ValueError(
            f"{url}: reading it needs the package fsspec; pip install 'morgs-mi[cluster]'."
        ) from None
    try:
        with _failures(url):
            return url_to_fs(url, **_options(url))
    except ImportError as error:
        raise ValueError(f"{url}: reading it needs another package: {error}.") from None
    except ValueError as error:
        raise ValueError(
            f"{url}: expected a URL that fsspec can open, got an error: {error}."
        ) from None


def _options(url: str) -> dict[str, Any]:
    """Return the options of the file system of a URL: http's own would wait for minutes."""
    if not url.startswith(("http://", "https://")):
        return {}
    from aiohttp import ClientTimeout

    return {"client_kwargs": {"timeout": ClientTimeout(sock_connect=PATIENCE, sock_read=PATIENCE)}}


def _fetch(system: Any, url: str, remote: str, file: Path, size: int | None) -> None:
    """Copy a remote file of `size` bytes, None if unknown; several processes may fetch the same
    one.
    """
    partial = file.with_name(f".{file.name}-{os.getpid()}-{threading.get_ident()}")
    place = remote if is_url(remote) else f"{url}: {remote}"
    try:
        with _failures(place):
            system.get_file(remote, str(partial))
        _check_content(place, partial, size)
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)


def _check_content(place: str, file: Path, size: int | None) -> None:
    """Raise `ConnectionError` if a fetched file has another size, or is a page of HTML, such as one
    to log in.
    """
    got = file.stat().st_size
    if _is_page(file):
        raise ConnectionError(
            f"{place}: expected a file, got a page of HTML; check the URL, or log in, and try "
            "again."
        )
    if size is not None and got != size:
        raise ConnectionError(
            f"{place}: expected {size} bytes, got {got}; it has changed or was cut short, try "
            "again."
        )


def _is_page(file: Path) -> bool:
    with file.open("rb") as stream:
        head = stream.read(512).lower()
    return any(mark in head for mark in _PAGE)


@contextmanager
def _failures(place: str) -> Iterator[None]:
    """Raise what file systems raise as errors with one sentence."""
    try:
        yield
    except FileNotFoundError:
        raise FileNotFoundError(
            f"{place}: expected a file or a folder, found none; check the URL."
        ) from None
    except PermissionError as error:
        raise PermissionError(
            f"{place}: expected to be allowed to read it, got {error}; check the rights."
        ) from None
    except TimeoutError:
        message = f"{place}: expected an answer, got none in time; check the connection, try again."
        raise ConnectionError(message) from None
    except (ImportError, ValueError):
        raise
    except Exception as error:  # the libraries of the protocols have errors of their own
        raise ConnectionError(
            f"{place}: expected to read it, got {str(error) or type(error).__name__}."
        ) from None
