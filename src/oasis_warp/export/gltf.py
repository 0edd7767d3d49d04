"""glTF 2.0 files: what their JSON says about one buffer, and that buffer."""

import base64
import json
import struct
from pathlib import Path
from typing import Any, Literal

import numpy as np

from oasis_warp import __version__
from oasis_warp.data.output_files import write_file

AccessorType = Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT4"]
VERTICES, INDICES = 34962, 34963
"""Targets of buffer views."""
COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
WIDTHS: dict[str, int] = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
GLB_MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942


class GltfBuffer:
    """The binary part of a glTF file, as it grows."""

    def __init__(self):
        self._data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(
        self, values: np.ndarray, kind: AccessorType, *, target: int | None = None, normalized: bool = False
    ) -> int:
        """Append a row for each element, of a type in `COMPONENTS`; the index of its accessor.

        Args:
            values: Rows; little-endian. Those of a VEC3 of bytes take four, since vertices begin at whole words.
            kind: What a row is.
            target: VERTICES or INDICES, for what a mesh draws.
            normalized: Whole numbers stand for [0, 1], or signed ones for [-1, 1].
        """
        stored = values
        if kind == "VEC3" and values.itemsize == 1:
            stored = np.pad(values, ((0, 0), (0, 1)))
        accessor: dict[str, Any] = {
            "bufferView": self.add_bytes(np.ascontiguousarray(stored).tobytes(), target),
            "componentType": COMPONENTS[values.dtype.str[1:]],
            "count": values.size // WIDTHS[kind],
            "type": kind,
        }
        if normalized:
            accessor["normalized"] = True
        if stored is not values:
            self.views[-1]["byteStride"] = 4
        if kind != "MAT4" and (not normalized or kind == "VEC3"):
            rows = values.reshape(-1, WIDTHS[kind])
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def add_bytes(self, data: bytes, target: int | None = None) -> int:
        """Append bytes, an image for one; the index of their view."""
        self._data += bytes(-len(self._data) % 4)
        view = {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(data)}
        self.views.append(view if target is None else {**view, "target": target})
        self._data += data
        return len(self.views) - 1

    def data(self) -> bytes:
        """All of it, in whole words."""
        return bytes(self._data) + bytes(-len(self._data) % 4)


def write_gltf(path: Path, document: dict[str, Any], buffer: GltfBuffer) -> None:
    """Write a .glb, or with that ending a .gltf, whose buffer is text inside it, atomically.

    Args:
        path: Of the file.
        document: The JSON without asset, buffers, views and accessors.
        buffer: What the document's accessors are of.

    Raises:
        InputError: `path` cannot be written.
    """
    binary = buffer.data()
    whole = {
        "asset": {"version": "2.0", "generator": f"oasis_warp {__version__}"},
        **document,
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": buffer.views,
        "accessors": buffer.accessors,
    }
    if path.suffix.lower() == ".gltf":
        text = base64.b64encode(binary).decode()
        whole["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{text}"
        write_file(path, json.dumps(whole, allow_nan=False).encode())
        return
    text = json.dumps(whole, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), JSON_CHUNK) + text + struct.pack("<II", len(binary), BINARY_CHUNK) + binary
    write_file(path, struct.pack("<III", GLB_MAGIC, 2, 12 + len(chunks)) + chunks)
