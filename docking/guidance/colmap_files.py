"""COLMAP models: cameras and poses read from text or binary files, whole maps written as text.

COLMAP counts pixels from the corner of the first one: its coordinates are 0.5 larger than here.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from docking.errors import ConfigInvalid, FileUnreadable, FileUnwritable
from docking.guidance.types import ArMap, Camera
from docking.types import Array, Pose

PIXEL_SHIFT = 0.5
_MODELS = {
    0: ("SIMPLE_PINHOLE", ("f", "cx", "cy")),
    1: ("PINHOLE", ("fx", "fy", "cx", "cy")),
    2: ("SIMPLE_RADIAL", ("f", "cx", "cy", "k1")),
    3: ("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    4: ("OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    6: ("FULL_OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
}
_NAMES = {name: (number, names) for number, (name, names) in _MODELS.items()}


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """The camera and, by image name, its poses X_WC in the model's free frame (units of the model)."""

    camera: Camera
    poses: dict[str, Pose]


def read_model(folder: Path) -> ColmapModel:
    """A model with one camera. Raises FileUnreadable, ConfigInvalid."""
    binary = (folder / "images.bin").exists()
    try:
        if binary:
            cameras = _binary_cameras((folder / "cameras.bin").read_bytes())
            poses = _binary_images((folder / "images.bin").read_bytes())
        else:
            cameras = _text_cameras((folder / "cameras.txt").read_text("utf-8"))
            poses = _text_images((folder / "images.txt").read_text("utf-8"))
    except OSError as error:
        raise FileUnreadable(str(error.filename or folder), error.strerror or str(error)) from error
    except (ValueError, IndexError, struct.error) as error:
        raise ConfigInvalid(str(folder), (f"not a COLMAP model: {error}",)) from error
    if len(cameras) != 1 or not poses:
        raise ConfigInvalid(str(folder), (f"{len(cameras)} cameras, {len(poses)} images: one camera is needed",))
    return ColmapModel(cameras[0], poses)


def _camera(model: str, width: int, height: int, values: list[float]) -> Camera:
    if model not in _NAMES:
        raise ValueError(f"camera model {model} is not one of {', '.join(_NAMES)}")
    names = _NAMES[model][1]
    if len(values) != len(names) or not np.all(np.isfinite(values)):
        raise ValueError(f"{model} has {len(names)} finite parameters")
    table = dict(zip(names, values, strict=True))
    if any(table.get(name, 0.0) for name in ("k4", "k5", "k6")):
        raise ValueError("k4, k5 and k6 of FULL_OPENCV must be 0")
    f = table.get("f", 0.0)
    lens = {name: table.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")}
    centre = (table["cx"] - PIXEL_SHIFT, table["cy"] - PIXEL_SHIFT)
    return Camera(width, height, table.get("fx", f), table.get("fy", f), *centre, **lens)


def _pose(numbers: list[float]) -> Pose:
    """X_WC of qw, qx, qy, qz, tx, ty, tz (camera from world)."""
    if not np.all(np.isfinite(numbers)):
        raise ValueError("a pose is not finite")
    R = Rotation.from_quat([*numbers[1:4], numbers[0]]).as_matrix()
    return Pose(R, np.array(numbers[4:7])).inverse()


def _text_cameras(text: str) -> list[Camera]:
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return [_camera(row[1], int(row[2]), int(row[3]), [float(v) for v in row[4:]]) for row in rows]


def _text_images(text: str) -> dict[str, Pose]:
    # Every second line lists the points and may be empty: only comments are dropped.
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    rows = [line.split(maxsplit=9) for line in lines[::2] if line.strip()]
    return {row[9].strip(): _pose([float(v) for v in row[1:8]]) for row in rows}


def _binary_cameras(data: bytes) -> list[Camera]:
    (count,), at, cameras = struct.unpack_from("<Q", data), 8, []
    for _ in range(count):
        _, model, width, height = struct.unpack_from("<iiQQ", data, at)
        if model not in _MODELS:
            raise ValueError(f"camera model {model} is not one of {', '.join(_NAMES)}")
        name, names = _MODELS[model]
        values = struct.unpack_from(f"<{len(names)}d", data, at + 24)
        at += 24 + 8 * len(names)
        cameras.append(_camera(name, width, height, list(values)))
    return cameras


def _binary_images(data: bytes) -> dict[str, Pose]:
    (count,), at, poses = struct.unpack_from("<Q", data), 8, {}
    for _ in range(count):
        numbers = struct.unpack_from("<7d", data, at + 4)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode("utf-8")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * points
        poses[name] = _pose(list(numbers))
    return poses


def write_model(ar_map: ArMap, folder: Path) -> None:
    """Write cameras.txt, images.txt, points3D.txt (coordinates as in the map, mm). Raises FileUnwritable."""
    files = {"cameras.txt": _cameras_text(ar_map.camera), "images.txt": _images_text(ar_map)}
    files["points3D.txt"] = _points_text(ar_map)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (folder / name).write_text(text, "utf-8")
    except OSError as error:
        raise FileUnwritable(str(folder), error.strerror or str(error)) from error


def _cameras_text(camera: Camera) -> str:
    model = "FULL_OPENCV" if camera.k3 else "OPENCV"
    values = [camera.fx_px, camera.fy_px, camera.cx_px + PIXEL_SHIFT, camera.cy_px + PIXEL_SHIFT]
    values += [camera.k1, camera.k2, camera.p1, camera.p2, *([camera.k3, 0.0, 0.0, 0.0] if camera.k3 else [])]
    return f"1 {model} {camera.width_px} {camera.height_px} {_numbers(values)}\n"


def _numbers(values: list[float] | Array) -> str:
    return " ".join(f"{float(value):.12g}" for value in values)


def _images_text(ar_map: ArMap) -> str:
    lines = []
    for number, frame in enumerate(ar_map.keyframes, 1):
        X_CW = frame.X_WC.inverse()
        x, y, z, w = Rotation.from_matrix(X_CW.R).as_quat(canonical=True)
        lines.append(f"{number} {_numbers([w, x, y, z, *X_CW.t_mm])} 1 {frame.name}")
        pixels = frame.keypoints_px + PIXEL_SHIFT
        # COLMAP numbers points from 1; -1 is a feature without one.
        rows = np.where(frame.landmarks >= 0, frame.landmarks + 1, -1)
        lines.append(" ".join(f"{u:.4f} {v:.4f} {row}" for (u, v), row in zip(pixels, rows, strict=True)))
    return "\n".join(lines) + "\n"


def _points_text(ar_map: ArMap) -> str:
    tracks: list[list[str]] = [[] for _ in ar_map.points_mm]
    for number, frame in enumerate(ar_map.keyframes, 1):
        for feature in np.flatnonzero(frame.landmarks >= 0):
            tracks[frame.landmarks[feature]].append(f"{number} {feature}")
    rows = zip(ar_map.points_mm, tracks, strict=True)
    lines = [f"{i} {_numbers(p)} 128 128 128 0 {' '.join(t)}" for i, (p, t) in enumerate(rows, 1) if t]
    return "\n".join(lines) + "\n"
