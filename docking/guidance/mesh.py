"""Meshes of parts: STL (binary and text, mm) and glTF 2.0 (.gltf with its buffers, .glb). Triangles in mm.

What the drawing needs is small: points, triangles and the edges worth a line. Compressed glTF is refused.
"""

from __future__ import annotations

import base64
import json
import re
import struct
from dataclasses import dataclass
from math import cos, radians
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from docking.errors import BadMesh, FileUnreadable
from docking.types import Array

Triangles = NDArray[np.int64]
MM_PER_M = 1000.0
_MOST_TRIANGLES, _MOST_NODES = 2_000_000, 10_000
_SHARP = cos(radians(25.0))
_GLB_MAGIC, _JSON_CHUNK, _BINARY_CHUNK = b"glTF", 0x4E4F534A, 0x004E4942
_INDEX_TYPES = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32}
_FLOAT, _TRIANGLE_MODE = 5126, 4


@dataclass(frozen=True, eq=False)
class Mesh:
    """`points_mm` (n, 3) and `triangles` (t, 3) rows of it, in the part's own frame."""

    points_mm: Array
    triangles: Triangles

    def edges(self) -> NDArray[np.int64]:
        """Rows (e, 2) of the edges that show the shape: borders, and where two faces meet at more than 25 deg."""
        corners = self.points_mm[self.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        sides = np.sort(
            np.concatenate([self.triangles[:, [0, 1]], self.triangles[:, [1, 2]], self.triangles[:, [2, 0]]]), 1
        )
        face = np.tile(np.arange(len(self.triangles)), 3)
        order = np.lexsort((sides[:, 1], sides[:, 0]))
        sides, face = sides[order], face[order]
        same = np.all(sides[1:] == sides[:-1], axis=1)
        flat = np.einsum("ni,ni->n", normals[face[1:]], normals[face[:-1]]) > _SHARP
        hidden = same & flat
        keep = ~(np.append(hidden, False) | np.append(False, hidden))
        return np.unique(sides[keep], axis=0)


def read_mesh(path: Path) -> Mesh:
    """The mesh of a part. Raises FileUnreadable, BadMesh."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FileUnreadable(str(path), error.strerror or str(error)) from error
    try:
        if path.suffix.lower() == ".stl":
            mesh = _welded(_stl(data))
        elif path.suffix.lower() in (".gltf", ".glb"):
            mesh = _gltf(data, path)
        else:
            raise BadMesh(str(path), "the name must end with .stl, .gltf or .glb", value=path.suffix or "no ending")
    except (ValueError, KeyError, IndexError, TypeError, struct.error, UnicodeDecodeError) as error:
        raise BadMesh(str(path), f"{type(error).__name__}: {error}", value="the content is damaged") from error
    if not 0 < len(mesh.triangles) <= _MOST_TRIANGLES:
        raise BadMesh(str(path), f"1 to {_MOST_TRIANGLES} are drawn", value=f"{len(mesh.triangles)} triangles")
    if not np.all(np.isfinite(mesh.points_mm)) or mesh.triangles.max() >= len(mesh.points_mm):
        raise BadMesh(str(path), "a corner is not finite or not there", value="the content is damaged")
    return mesh


def _stl(data: bytes) -> Array:
    """Corners (t, 3, 3). The length tells a binary file: its first word may be solid as in a text."""
    if len(data) >= 84 and len(data) == 84 + 50 * struct.unpack_from("<I", data, 80)[0]:
        record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        return np.frombuffer(data, record, offset=84)["corners"].astype(np.float64)
    text = data.decode("utf-8")
    if not text.lstrip().lower().startswith("solid"):
        raise ValueError("neither a binary nor a text STL")
    numbers = re.findall(r"vertex\s+(\S+)\s+(\S+)\s+(\S+)", text, re.IGNORECASE)
    return np.array(numbers, dtype=np.float64).reshape(-1, 3, 3)


def _welded(corners: Array) -> Mesh:
    """STL repeats every corner: equal ones become one point."""
    points, rows = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return Mesh(points, rows.reshape(-1, 3).astype(np.int64))


def _gltf(data: bytes, path: Path) -> Mesh:
    head, binary = _chunks(data) if data[:4] == _GLB_MAGIC else (json.loads(data), b"")
    buffers = [_buffer(item, binary, path) for item in head.get("buffers", [])]
    points: list[Array] = []
    triangles: list[Triangles] = []
    count = 0
    for mesh, matrix in _placed(head):
        for part in head["meshes"][mesh]["primitives"]:
            if part.get("mode", _TRIANGLE_MODE) != _TRIANGLE_MODE or part.get("extensions"):
                raise ValueError("only plain triangles are read")
            local = _accessor(head, buffers, part["attributes"]["POSITION"])
            rows = _accessor(head, buffers, part["indices"]).ravel() if "indices" in part else np.arange(len(local))
            points.append(local @ matrix[:3, :3].T + matrix[:3, 3])
            triangles.append(rows.reshape(-1, 3).astype(np.int64) + count)
            count += len(local)
    return Mesh(np.concatenate(points) * MM_PER_M, np.concatenate(triangles))


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary chunk of a .glb file."""
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2 or length > len(data):
        raise ValueError("not a whole glTF 2.0 file")
    found: dict[int, bytes] = {}
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", data, at)
        found.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    return json.loads(found[_JSON_CHUNK]), found.get(_BINARY_CHUNK, b"")


def _buffer(item: dict[str, Any], binary: bytes, path: Path) -> bytes:
    uri = item.get("uri")
    if uri is None:
        return binary
    if uri.startswith("data:"):
        return bytes(base64.b64decode(uri.partition(",")[2]))
    beside: Path = path.parent / uri
    if beside.resolve().parent != path.parent.resolve():
        raise ValueError(f"the buffer {uri!r} is not beside the file")
    return beside.read_bytes()


def _accessor(head: dict[str, Any], buffers: list[bytes], row: int) -> Array:
    """Numbers of an accessor: positions (n, 3) or indices (n, 1)."""
    item = head["accessors"][row]
    if "sparse" in item or "bufferView" not in item:
        raise ValueError("sparse numbers are not read")
    view = head["bufferViews"][item["bufferView"]]
    width = {"SCALAR": 1, "VEC3": 3}[item["type"]]
    kind = np.dtype(np.float32 if item["componentType"] == _FLOAT else _INDEX_TYPES[item["componentType"]])
    kind = kind.newbyteorder("<")
    stride = view.get("byteStride", width * kind.itemsize)
    start = view.get("byteOffset", 0) + item.get("byteOffset", 0)
    buffer = buffers[view["buffer"]]
    if start + (item["count"] - 1) * stride + width * kind.itemsize > len(buffer):
        raise ValueError("an accessor reaches beyond its buffer")
    table = np.ndarray((item["count"], width), kind, buffer, start, (stride, kind.itemsize))
    return np.asarray(table, dtype=np.float64)


def _placed(head: dict[str, Any]) -> list[tuple[int, Array]]:
    """(mesh, its (4, 4) place in the scene) of every node with a mesh; all meshes at the origin without a scene."""
    nodes = head.get("nodes", [])
    if not nodes:
        return [(k, np.eye(4)) for k in range(len(head.get("meshes", [])))]
    scenes = head.get("scenes")
    children = {child for node in nodes for child in node.get("children", [])}
    roots = scenes[head.get("scene", 0)]["nodes"] if scenes else [k for k in range(len(nodes)) if k not in children]
    found: list[tuple[int, Array]] = []
    waiting = [(root, np.eye(4)) for root in roots]
    for _ in range(_MOST_NODES):
        if not waiting:
            return found
        row, above = waiting.pop()
        matrix = above @ _local(nodes[row])
        if "mesh" in nodes[row]:
            found.append((nodes[row]["mesh"], matrix))
        waiting += [(child, matrix) for child in nodes[row].get("children", [])]
    raise ValueError("the nodes are too many, or contain each other")


def _local(node: dict[str, Any]) -> Array:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix() * node.get("scale", [1, 1, 1])
    matrix[:3, 3] = node.get("translation", [0, 0, 0])
    return matrix
