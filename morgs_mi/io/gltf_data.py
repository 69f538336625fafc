"""The document and the binary data of glTF 2.0 files: JSON, buffers, buffer views and accessors."""

from __future__ import annotations

import base64
import binascii
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from morgs_mi.core.checks import LARGEST, bounded
from morgs_mi.io.bounded import check_claim

__all__ = ["GltfData"]

_MAGIC, _JSON, _BINARY = b"glTF", b"JSON", b"BIN\0"
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


class GltfData:
    """A .glb file, or a .gltf file with the files that it names, which are in its folder or below.

    Methods raise `ValueError` with a sentence for numbers that do not fit, and Python's own errors for documents that
    are not as glTF defines them.

    Attributes:
        path: the file.
        document: its JSON document.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.document, self._binary = _split(path, path.read_bytes())
        self._resources: dict[str | Path, bytes] = {}
        self._beside = self._claimed = 0

    def refused(self, fault: str) -> ValueError:
        """Return an error with a sentence that names the file."""
        return ValueError(f"{self.path}: {fault}.")

    def all(self, kind: str) -> list[dict[str, Any]]:
        """Return a list of the document, which is empty if it is missing."""
        return self.document.get(kind, [])

    def entry(self, kind: str, index: Any) -> dict[str, Any]:
        """Return an entry of a list of the document."""
        self.check_index(kind, index)
        return self.all(kind)[index]

    def check_index(self, kind: str, index: Any) -> None:
        """Raise `ValueError` unless a list of the document has an entry at `index`."""
        count = len(self.all(kind))
        if type(index) is not int or not 0 <= index < count:
            raise self.refused(f"expected one of its {count} {kind}, got number {index}; export it again")

    def claim(self, size: int, content: str) -> None:
        """Check that all decoded content of the file, `size` more bytes included, is not too much for its size."""
        self._claimed += size
        check_claim(self.path, self._claimed, f"{content}, with all before it", self._beside)

    def numbers(self, where: str, values: Any, *shape: int) -> np.ndarray:
        """Return numbers of the document as float64 of a shape, checked for NaN, infinity and huge values."""
        return self.checked(where, np.array(values, float).reshape(shape))

    def checked(self, where: str, values: np.ndarray) -> np.ndarray:
        """Return numbers if they are finite and not huge."""
        if not bounded(values):
            raise self.refused(f"{where}: expected finite numbers of at most {LARGEST:g}, got others; export it again")
        return values

    def indices(self, index: int, kind: str, count: int | None = None) -> np.ndarray:
        """Return an accessor of indices as integers [N, columns]."""
        self._unsigned(f"accessor {index}", self.entry("accessors", index))
        return self.accessor(index, kind, count).astype(int)

    def accessor(self, index: int, kind: str | None = None, count: int | None = None) -> np.ndarray:
        """Return an accessor as float64 [N, columns], checked for its type and its length."""
        item = self.entry("accessors", index)
        if (kind or item["type"]) != item["type"] or (count or item["count"]) != item["count"]:
            raise self.refused(
                f"accessor {index}: expected {count or item['count']} elements of {kind or item['type']}, got "
                f"{item['count']} of {item['type']}; export it again"
            )
        columns, dtype = _COLUMNS[item["type"]], np.dtype(_TYPES[item["componentType"]])
        self.claim(8 * item["count"] * columns, f"an accessor of {item['count']} elements")
        values = np.zeros((item["count"], columns))
        if "bufferView" in item:
            values[:] = self._elements(item, item["count"], columns, dtype)
        if "sparse" in item:
            sparse = item["sparse"]
            kind_of = self._unsigned(f"accessor {index}", sparse["indices"])
            places = self._elements(sparse["indices"], sparse["count"], 1, kind_of)[:, 0]
            values[places] = self._elements(sparse["values"], sparse["count"], columns, dtype)
        if item.get("normalized") and dtype.kind != "f":
            values = np.maximum(values / np.iinfo(dtype).max, -1)
        return self.checked(f"accessor {index}", values)

    def _unsigned(self, where: str, item: dict[str, Any]) -> np.dtype:
        """Return the type of an item of indices, which glTF stores without a sign."""
        dtype = np.dtype(_TYPES[item["componentType"]])
        if dtype.kind != "u" or item.get("normalized"):
            raise self.refused(f"{where}: expected unsigned integers as indices, got {dtype.name}; export it again")
        return dtype

    def _elements(self, item: dict[str, Any], count: int, columns: int, dtype: np.dtype) -> np.ndarray:
        """Return `count` rows of numbers that `item` refers to [count, columns]."""
        data, start, size = self.view(item["bufferView"]), item.get("byteOffset", 0), dtype.itemsize
        stride = self.entry("bufferViews", item["bufferView"]).get("byteStride", columns * size)
        end = start + (count - 1) * stride + columns * size
        if min(start, count - 1) < 0 or stride < columns * size or end > len(data):
            raise self.refused(
                f"buffer view {item['bufferView']}: expected {count} elements from byte {start}, got {len(data)} bytes;"
                " export it again"
            )
        return np.ndarray((count, columns), dtype, data, start, (stride, size))

    def view(self, index: int) -> memoryview:
        """Return the bytes of a buffer view."""
        view = self.entry("bufferViews", index)
        buffer = self.entry("buffers", view["buffer"])
        data = self.resource(buffer["uri"]) if "uri" in buffer else self._binary
        start, length = view.get("byteOffset", 0), view["byteLength"]
        if min(start, length) < 0 or start + length > len(data):
            raise self.refused(
                f"buffer view {index}: expected {length} bytes from byte {start}, got a buffer of {len(data)} bytes; "
                "export it again"
            )
        return memoryview(data)[start : start + length]

    def resource(self, uri: str) -> bytes:
        """Return the bytes of a data URI, or of a file in the folder of the glTF file or below."""
        file = None if uri.startswith("data:") else self._file(uri)
        key = file or uri
        if key not in self._resources:
            self._resources[key] = self._embedded(uri) if file is None else file.read_bytes()
            self._beside += 0 if file is None else len(self._resources[key])
        return self._resources[key]

    def _file(self, uri: str) -> Path:
        folder = self.path.parent.resolve()
        file = (folder / unquote(uri)).resolve()
        if not file.is_relative_to(folder):
            raise self.refused(f"expected files in its folder, got {uri}; copy it there, or export a .glb file")
        if not file.is_file():
            raise FileNotFoundError(
                f"{self.path}: its file {file} does not exist; copy it there, or export a .glb file."
            )
        return file

    def _embedded(self, uri: str) -> bytes:
        try:
            return base64.b64decode(uri.split(",", 1)[1], validate=True)
        except binascii.Error:
            raise self.refused("expected data URIs in base64, got another one; export it again") from None


def _split(path: Path, data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the JSON document of a file, and its binary chunk, which is empty in .gltf files."""
    chunks = {_JSON: data, _BINARY: b""}
    if data.startswith(_MAGIC):
        at = 12
        while at + 8 <= len(data):
            length, kind = struct.unpack_from("<I4s", data, at)
            chunk = data[at + 8 : at + 8 + length]
            if len(chunk) < length:
                raise ValueError(
                    f"{path}: expected {length} bytes of {kind.decode('ascii', 'replace')} from byte {at + 8}, got "
                    f"{len(chunk)}: the file is cut off; copy it again."
                )
            chunks[kind], at = chunk, at + 8 + length
    # As many values as `read_json` accepts of a file.
    text = chunks[_JSON]
    check_claim(path, 240 * text.count(b"{") + 64 * text.count(b"[") + 40 * text.count(b","), "many values")
    document = json.loads(text.decode("utf-8"))
    if not isinstance(document, dict):
        raise ValueError(f"{path}: expected a glTF document, got a {type(document).__name__}; export it again.")
    return document, chunks[_BINARY]
