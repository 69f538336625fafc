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

from morgs_mi.io.bounded import check_claim

__all__ = ["GltfData"]

_MAGIC, _JSON, _BINARY = b"glTF", b"JSON", b"BIN\0"
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


class GltfData:
    """A .glb file, or a .gltf file with the files that it names.

    Methods raise `ValueError` with a sentence for numbers that do not fit, and Python's own errors for documents that
    are not as glTF defines them.

    Attributes:
        path: the file.
        document: its JSON document.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.document, self._binary = _split(path, path.read_bytes())
        self._buffers: dict[int, bytes] = {}

    def refused(self, fault: str) -> ValueError:
        """Return an error whose sentence names the file."""
        return ValueError(f"{self.path}: {fault}.")

    def all(self, kind: str) -> list[dict[str, Any]]:
        """Return a list of the document, which is empty if it is missing."""
        return self.document.get(kind, [])

    def accessor(self, index: int, kind: str | None = None, count: int | None = None) -> np.ndarray:
        """Return an accessor as float64 [N, columns], checked for its type and its length."""
        item = self.all("accessors")[index]
        if index < 0 or (kind or item["type"]) != item["type"] or (count or item["count"]) != item["count"]:
            raise self.refused(
                f"accessor {index}: expected {count or item['count']} elements of {kind or item['type']}, got "
                f"{item['count']} of {item['type']}; export it again"
            )
        columns, dtype = _COLUMNS[item["type"]], np.dtype(_TYPES[item["componentType"]])
        check_claim(self.path, 8 * item["count"] * columns, f"an accessor of {item['count']} elements")
        values = np.zeros((item["count"], columns))
        if "bufferView" in item:
            values[:] = self._elements(item, item["count"], columns, dtype)
        if "sparse" in item:
            sparse = item["sparse"]
            kind_of = np.dtype(_TYPES[sparse["indices"]["componentType"]])
            places = self._elements(sparse["indices"], sparse["count"], 1, kind_of)[:, 0]
            values[places] = self._elements(sparse["values"], sparse["count"], columns, dtype)
        if item.get("normalized") and dtype.kind != "f":
            values = np.maximum(values / np.iinfo(dtype).max, -1)
        if not np.isfinite(values).all():
            raise self.refused(f"accessor {index}: expected finite numbers, got NaN or infinity; export it again")
        return values

    def _elements(self, item: dict[str, Any], count: int, columns: int, dtype: np.dtype) -> np.ndarray:
        """Return `count` rows of numbers that `item` refers to [count, columns]."""
        view, start, size = self.all("bufferViews")[item["bufferView"]], item.get("byteOffset", 0), dtype.itemsize
        stride = view.get("byteStride", columns * size)
        data = self.view(item["bufferView"])
        end = start + (count - 1) * stride + columns * size
        if min(start, count - 1) < 0 or stride < columns * size or end > len(data):
            raise self.refused(
                f"buffer view {item['bufferView']}: expected {count} elements from byte {start}, got {len(data)} bytes;"
                " export it again"
            )
        return np.ndarray((count, columns), dtype, data, start, (stride, size))

    def view(self, index: int) -> bytes:
        """Return the bytes of a buffer view."""
        view = self.all("bufferViews")[index]
        if view["buffer"] not in self._buffers:
            item = self.all("buffers")[view["buffer"]]
            self._buffers[view["buffer"]] = self.resource(item["uri"]) if "uri" in item else self._binary
        data, start, length = self._buffers[view["buffer"]], view.get("byteOffset", 0), view["byteLength"]
        if min(index, start, length) < 0 or start + length > len(data):
            raise self.refused(
                f"buffer view {index}: expected {length} bytes from byte {start}, got a buffer of {len(data)} bytes; "
                "export it again"
            )
        return data[start : start + length]

    def resource(self, uri: str) -> bytes:
        """Return the bytes of a data URI, or of a file beside the glTF file."""
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.split(",", 1)[1], validate=True)
            except binascii.Error:
                raise self.refused("expected data URIs in base64, got another one; export it again") from None
        file = self.path.parent / unquote(uri)
        if not file.is_file():
            raise FileNotFoundError(
                f"{self.path}: its file {file} does not exist; copy it there, or export a .glb file."
            )
        return file.read_bytes()


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
