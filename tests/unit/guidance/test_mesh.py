"""Meshes as parts come: STL in both forms, glTF with nodes, and what is refused."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path

import numpy as np
import pytest

from docking.errors import BadMesh, FileUnreadable
from docking.guidance.mesh import read_mesh

CORNERS = np.array([[x, y, z] for x in (0, 10) for y in (0, 20) for z in (0, 30)], dtype=np.float32)
FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


def binary_stl(name: bytes = b"solid by another program") -> bytes:
    triangles = b"".join(struct.pack("<12fH", 0, 0, 0, *CORNERS[face].ravel(), 0) for face in FACES)
    return name.ljust(80, b" ") + struct.pack("<I", len(FACES)) + triangles


def text_stl() -> str:
    rows = ["solid box"]
    for face in FACES:
        rows += ["facet normal 0 0 0", "outer loop"]
        rows += [f"vertex {x:e} {y:e} {z:e}" for x, y, z in CORNERS[face]]
        rows += ["endloop", "endfacet"]
    return "\n".join([*rows, "endsolid box"])


def gltf(uri: str | None) -> dict[str, object]:
    """The box in metres, moved by 1 m along x, turned by a quarter about z and twice as large."""
    points, rows = (CORNERS / 1000).tobytes(), FACES.astype("<u2").tobytes()
    buffer: dict[str, object] = {"byteLength": len(points) + len(rows)}
    if uri is not None:
        buffer["uri"] = uri
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"translation": [1.0, 0.0, 0.0], "children": [1]},
            {"rotation": [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)], "scale": [2.0, 2.0, 2.0], "mesh": 0},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 36, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": len(points)},
            {"buffer": 0, "byteOffset": len(points), "byteLength": len(rows)},
        ],
        "buffers": [buffer],
    }


def content() -> bytes:
    return (CORNERS / 1000).tobytes() + FACES.astype("<u2").tobytes()


def glb() -> bytes:
    head = json.dumps(gltf(None)).encode()
    head += b" " * (-len(head) % 4)
    binary = content() + b"\0" * (-len(content()) % 4)
    chunks = struct.pack("<II", len(head), 0x4E4F534A) + head + struct.pack("<II", len(binary), 0x004E4942) + binary
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


@pytest.mark.parametrize("data", [binary_stl(), text_stl().encode()])
def test_stl(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "box.stl"
    path.write_bytes(data)
    mesh = read_mesh(path)
    assert sorted(map(tuple, mesh.points_mm)) == sorted(map(tuple, CORNERS.astype(float)))
    assert mesh.triangles.shape == (12, 3)
    assert len(mesh.edges()) == 12  # of a box: the diagonals of its faces are no edges


@pytest.mark.parametrize("form", ["beside", "inside", "glb"])
def test_gltf_is_in_metres_and_its_nodes_place_it(tmp_path: Path, form: str) -> None:
    path = tmp_path / ("box.glb" if form == "glb" else "box.gltf")
    inside = "data:application/octet-stream;base64," + base64.b64encode(content()).decode()
    if form == "glb":
        path.write_bytes(glb())
    else:
        path.write_text(json.dumps(gltf("box.bin" if form == "beside" else inside)))
    (tmp_path / "box.bin").write_bytes(content())
    mesh = read_mesh(path)
    # 2 x, a quarter turn x -> y, y -> -x, and one metre along x.
    assert np.allclose(mesh.points_mm.min(axis=0), [960.0, 0.0, 0.0], atol=1e-3)
    assert np.allclose(mesh.points_mm.max(axis=0), [1000.0, 20.0, 60.0], atol=1e-3)
    assert len(mesh.edges()) == 12


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.stl", b"solid\nendsolid"),
        ("a.stl", binary_stl()[:-7]),
        ("a.obj", b"v 0 0 0"),
        ("a.glb", glb()[:100]),
        ("a.gltf", b"{}"),
        ("a.gltf", json.dumps(gltf("../box.bin")).encode()),
        ("a.gltf", json.dumps({**gltf("box.bin"), "accessors": []}).encode()),
        ("a.gltf", json.dumps({"nodes": [{"children": [0]}], "scenes": [{"nodes": [0]}]}).encode()),
        ("a.stl", b"solid x facet vertex 0 0 0 vertex 1 0 0 vertex nan 1 0"),
    ],
)
def test_damaged_meshes_are_refused(tmp_path: Path, name: str, data: bytes) -> None:
    (tmp_path / name).write_bytes(data)
    (tmp_path / "box.bin").write_bytes(content())
    with pytest.raises(BadMesh):
        read_mesh(tmp_path / name)


def test_a_missing_mesh_is_unreadable(tmp_path: Path) -> None:
    with pytest.raises(FileUnreadable):
        read_mesh(tmp_path / "none.stl")
