"""Recordings of a moving body: CSV files with the headers of docs/tracking.md, BROAD .mat files, EuRoC CSV files.

Several files make one recording; each is told by its header. Times come out in s from the first frame's clock, lengths
in mm. Every fault names file, line and value.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

import numpy as np
from scipy.spatial.transform import Rotation

from docking.errors import BadRecording, FileUnreadable
from docking.point_file import read_points
from docking.recording_checks import Raw, check_recording
from docking.stereo_files import PixelRow, read_stereo_camera, stereo_frames
from docking.tracking.recording import Recording
from docking.tracking.stereo import StereoCamera
from docking.tracking.types import BodyModel
from docking.types import Array

IMU = ("t_s", "fx_m_s2", "fy_m_s2", "fz_m_s2", "wx_rad_s", "wy_rad_s", "wz_rad_s")
ATTITUDE = ("t_s", "qw", "qx", "qy", "qz")
ENCODERS = ("t_s", "x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")
POINTS = ("t_s", "name", "x_mm", "y_mm", "z_mm")
SIGMAS = ("sx_mm", "sy_mm", "sz_mm")
TRACKS = ("t_s", "camera", "name", "u_px", "v_px")
NOMINAL = ("name", "x_mm", "y_mm", "z_mm")
BROAD_FRAME_HZ = 50.0
"""Poses of BROAD stand at every inertial sample; so many a second are given to the filters, as a camera would."""
_MOST_BYTES = 512 * 1024 * 1024
_NEAR_S = 0.05


@dataclass
class _Parts:
    """What the files said so far."""

    imu: Array | None = None
    attitude: Array | None = None
    encoders: Array | None = None
    frames: tuple[Array, tuple[str, ...], Array, Array] | None = None
    body: BodyModel | None = None
    moving: Array | None = None
    cameras: list[StereoCamera] = field(default_factory=list)
    tracks: tuple[Path, list[PixelRow]] | None = None
    cov: Array | None = None
    others: frozenset[str] = frozenset()
    """names that points may have although this body has none of them"""
    seen: list[str] = field(default_factory=list)


def read_recording(paths: Sequence[Path], sigma_mm: float = 1.0) -> Recording:
    """One recording out of its files; `sigma_mm` of every coordinate where a file states none.

    Raises FileUnreadable, BadRecording, BadPointFile.
    """
    parts = _Parts()
    for path in paths:
        _read(path, parts, sigma_mm)
    if parts.tracks is not None or parts.cameras:
        _triangulate(paths[0], parts)
    return _assembled(paths[0], parts)


def nominal_files(paths: Sequence[Path]) -> list[Path]:
    """Those that hold nominal points: one a body. Raises FileUnreadable."""
    return [path for path in paths if path.suffix.lower() == ".csv" and _columns(path)[:4] == NOMINAL]


def read_bodies(paths: Sequence[Path], sigma_mm: float = 1.0) -> list[Recording]:
    """One recording a file of nominal points. A file called BODY.anything.csv belongs to that body alone; frames, pixel
    tracks and cameras belong to all, everything else to the first body.

    Raises as `read_recording`, and BadRecording for points that no body has.
    """
    nominal = nominal_files(paths)
    bodies = [path.stem for path in nominal]
    names = [name for path in nominal for name in read_points(path, "nominal").names]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        _bad(nominal[0], twice[0], "a point that two bodies have")
    found = []
    for k, own in enumerate(nominal):
        parts = _Parts(others=frozenset(names))
        for path in paths:
            owner = path.name.split(".")[0] if path.name.count(".") > 1 else ""
            shared = path.suffix.lower() == ".toml" or _columns(path) in (POINTS, POINTS + SIGMAS, TRACKS)
            mine = owner == own.stem if owner in bodies else (shared or k == 0)
            if path == own or (path not in nominal and mine):
                _read(path, parts, sigma_mm)
        if parts.tracks is not None or parts.cameras:
            _triangulate(own, parts)
        found.append(_assembled(own, parts))
    return found


def _columns(path: Path) -> tuple[str, ...]:
    """The names in the header line of a CSV file, in small letters."""
    try:
        with path.open("rb") as file:
            head = file.read(4096)
    except OSError as error:
        raise FileUnreadable(str(path), error.strerror or type(error).__name__) from error
    first = head.decode("utf-8-sig", errors="replace").splitlines()[0] if head.strip() else ""
    return tuple(c.strip().lower() for c in first.split(","))


def _bad(path: Path, value: object, cause: str) -> NoReturn:
    raise BadRecording(str(path), cause, value=str(value)[:80])


def _read(path: Path, parts: _Parts, sigma_mm: float) -> None:
    try:
        size = path.stat().st_size
    except OSError as error:
        raise FileUnreadable(str(path), error.strerror or type(error).__name__) from error
    if size > _MOST_BYTES:
        raise FileUnreadable(str(path), f"{size} bytes, at most {_MOST_BYTES} are read")
    if path.suffix.lower() == ".mat":
        _read_broad(path, parts, sigma_mm)
        return
    if path.suffix.lower() == ".toml":
        parts.cameras.append(read_stereo_camera(path))
        return
    columns = _columns(path)
    if columns and columns[0].startswith("#timestamp"):
        _read_euroc(path, columns, parts, sigma_mm)
    else:
        _read_columns(path, columns, parts, sigma_mm)


def _read_columns(path: Path, columns: tuple[str, ...], parts: _Parts, sigma_mm: float) -> None:
    """A CSV file of this program, told by its header."""
    if columns == IMU:
        _once(path, "inertial samples", parts)
        parts.imu = _in_order(path, _table(path, len(IMU)))
    elif columns == ATTITUDE:
        _once(path, "attitude", parts)
        parts.attitude = _in_order(path, _table(path, len(ATTITUDE)))
    elif columns == ENCODERS:
        _once(path, "encoders", parts)
        parts.encoders = _in_order(path, _table(path, len(ENCODERS)))
    elif columns in (POINTS, POINTS + SIGMAS):
        _once(path, "frames", parts)
        parts.frames = _point_rows(path, sigma_mm)
    elif columns == TRACKS:
        _once(path, "frames", parts)
        parts.tracks = path, _pixel_rows(path)
    elif columns[:4] == NOMINAL:
        _once(path, "nominal points", parts)
        points = read_points(path, "nominal")
        parts.body = BodyModel(path.stem, points.names, points.xyz_mm, points.xyz_mm.mean(axis=0))
    else:
        _bad(path, ",".join(columns), "the header is none of those that are known")


def _once(path: Path, what: str, parts: _Parts) -> None:
    if what in parts.seen:
        _bad(path, what, "given twice")
    parts.seen.append(what)


def _table(path: Path, columns: int, scale: Callable[[Array], Array] = lambda a: a) -> Array:
    """Finite numbers (n, columns) below the header line."""
    rows = []
    for number, line in enumerate(_lines(path)[1:], 2):
        if not line.strip():
            continue
        fields = line.split(",")
        if len(fields) < columns:
            _bad(path, f"line {number}", f"{columns} columns are needed, {len(fields)} found")
        rows.append([_number(path, number, text) for text in fields[:columns]])
    if not rows:
        _bad(path, "0 rows", "the file holds no data")
    return scale(np.array(rows))


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise FileUnreadable(str(path), f"not UTF-8 text at byte {error.start}") from error
    except OSError as error:
        raise FileUnreadable(str(path), error.strerror or type(error).__name__) from error


def _number(path: Path, line: int, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        _bad(path, f"line {line}: {text.strip()!r}", "a finite number is needed")
    return value


def _in_order(path: Path, table: Array) -> Array:
    """The rows by time. Stamps that go back or repeat are the sensor's clock at fault: the trackers alarm on them, a
    recording may keep its order."""
    back = np.flatnonzero(np.diff(table[:, 0]) <= 0.0)
    if len(back) > len(table) // 2:
        _bad(path, f"line {int(back[0]) + 3}", "times do not rise")
    return table


def _point_rows(path: Path, sigma_mm: float) -> tuple[Array, tuple[str, ...], Array, Array]:
    """Frame times (M,), names, points (M, n, 3) with NaN where not seen, sigmas (M, n, 3)."""
    rows: list[tuple[float, str, list[float]]] = []
    width = 3
    for number, line in enumerate(_lines(path)[1:], 2):
        fields = [f.strip() for f in line.split(",")]
        if not any(fields):
            continue
        if len(fields) < 5 or not fields[1]:
            _bad(path, f"line {number}", "time, name and three coordinates are needed")
        width = 6 if len(fields) >= 8 else 3
        if fields[2].lower() in ("", "nan"):
            rows.append((_number(path, number, fields[0]), fields[1], [float("nan")] * 6))
            continue
        values = [_number(path, number, f) for f in fields[2 : 2 + width]]
        rows.append((_number(path, number, fields[0]), fields[1], values if width == 6 else [*values, *[sigma_mm] * 3]))
    if not rows:
        _bad(path, "0 rows", "the file holds no data")
    names = tuple(dict.fromkeys(name for _, name, _ in rows))
    times = np.array(sorted({t for t, _, _ in rows}))
    place, column = {t: k for k, t in enumerate(times.tolist())}, {name: k for k, name in enumerate(names)}
    points = np.full((len(times), len(names), 3), np.nan)
    sigma = np.full(points.shape, sigma_mm)
    for t, name, values in rows:
        if np.isfinite(values).all() and any(v != 0.0 for v in values[:3]):  # (0, 0, 0) is a lost point
            points[place[t], column[name]] = values[:3]
            sigma[place[t], column[name]] = values[3:]
    if not (sigma > 0.0).all():
        _bad(path, float(sigma.min()), "a standard deviation is greater than zero")
    return times, names, points, sigma


def _pixel_rows(path: Path) -> list[PixelRow]:
    """Rows of both cameras; one with an empty or `nan` pixel is not seen."""
    rows = []
    for number, line in enumerate(_lines(path)[1:], 2):
        fields = [f.strip() for f in line.split(",")]
        if not any(fields):
            continue
        if len(fields) != len(TRACKS) or not fields[1] or not fields[2]:
            _bad(path, f"line {number}", "time, camera, name and two pixel coordinates are needed")
        hidden = any(f.lower() in ("", "nan") for f in fields[3:])
        u, v = (float("nan"),) * 2 if hidden else (_number(path, number, f) for f in fields[3:])
        rows.append(PixelRow(_number(path, number, fields[0]), fields[1], fields[2], u, v))
    if not rows:
        _bad(path, "0 rows", "the file holds no data")
    return rows


def _triangulate(path: Path, parts: _Parts) -> None:
    """Points of the pixel tracks, with their covariances."""
    if parts.tracks is None:
        _bad(path, ", ".join(camera.name for camera in parts.cameras), "cameras without pixel tracks")
    found = stereo_frames(parts.tracks[0], parts.cameras, parts.tracks[1])
    parts.cov = found.cov_mm2
    sigma = np.sqrt(np.diagonal(found.cov_mm2, axis1=2, axis2=3))
    parts.frames = found.t_s, found.names, found.xyz_W_mm, np.where(np.isfinite(sigma), sigma, 1.0)


def _read_broad(path: Path, parts: _Parts, sigma_mm: float) -> None:
    from scipy.io import loadmat

    try:
        data = loadmat(path, variable_names=["imu_gyr", "imu_acc", "opt_quat", "opt_pos", "movement", "sampling_rate"])
        rate = float(np.ravel(data["sampling_rate"])[0])
        force, turn, place = data["imu_acc"], data["imu_gyr"], 1000.0 * data["opt_pos"]
        quaternion, moving = data["opt_quat"], np.ravel(data["movement"]).astype(np.float64)
    except Exception as error:
        raise BadRecording(str(path), "not a BROAD file", value=type(error).__name__) from error
    n = len(force)
    if not (n == len(turn) == len(place) == len(quaternion) == len(moving)) or n < 2 or not rate > 0.0:
        _bad(path, n, "arrays of a BROAD file are equally long")
    for what in ("inertial samples", "frames", "attitude"):
        _once(path, what, parts)
    t = np.arange(n) / rate
    every = slice(0, None, max(1, int(np.ceil(rate / BROAD_FRAME_HZ))))
    parts.imu = np.column_stack([t, force, turn])
    points = place[every][:, None, :]
    parts.frames = t[every], ("P",), points, np.full(points.shape, sigma_mm)
    known = np.isfinite(quaternion).all(axis=1)
    parts.attitude = np.column_stack([t, quaternion])[known]
    parts.moving = moving[every]


def _read_euroc(path: Path, columns: tuple[str, ...], parts: _Parts, sigma_mm: float) -> None:
    """imu0/data.csv: rate before force. Poses (state_groundtruth_estimate0, vicon0): place in m, quaternion w first.
    leica0: place only."""
    if len(columns) >= 7 and columns[1].startswith("w_"):
        _once(path, "inertial samples", parts)
        table = _table(path, 7)
        parts.imu = np.column_stack([1e-9 * table[:, 0], table[:, 4:7], table[:, 1:4]])
    elif len(columns) >= 4 and columns[1].startswith("p_"):
        _once(path, "frames", parts)
        whole = len(columns) >= 8
        table = _table(path, 8 if whole else 4)
        t = 1e-9 * table[:, 0]
        points = 1000.0 * table[:, None, 1:4]
        parts.frames = t, ("P",), points, np.full(points.shape, sigma_mm)
        if whole:
            parts.attitude = np.column_stack([t, table[:, 4:8]])
    else:
        _bad(path, ",".join(columns)[:80], "an EuRoC file of another sensor")


def _assembled(path: Path, parts: _Parts) -> Recording:
    if parts.frames is None:
        _bad(path, ", ".join(parts.seen) or "nothing", "frames of points are missing")
    t, names, points, sigma = parts.frames
    body = parts.body or BodyModel("body", names, np.zeros((len(names), 3)))
    if parts.body is None and len(names) > 1:
        _bad(path, len(names), "several points need a file of nominal points, header name,x_mm,y_mm,z_mm")
    here = [k for k, name in enumerate(names) if name in body.names or name not in parts.others]
    names, points, sigma = tuple(names[k] for k in here), points[:, here], sigma[:, here]
    points, sigma = _in_body_order(path, body, names, points, sigma)
    cov = None
    if parts.cov is not None:
        cov = np.zeros((len(t), len(body.names), 3, 3))
        cov[:, [body.names.index(name) for name in names]] = parts.cov[:, here]
    check_recording(path, Raw(parts.imu, parts.encoders, t, points, body, parts.body is not None))
    imu = parts.imu if parts.imu is not None else np.zeros((0, 7))
    encoders = parts.encoders if parts.encoders is not None else np.zeros((0, 7))
    zero = float(t[0])
    turns = Rotation.from_euler("xyz", encoders[:, 4:7], degrees=True).as_matrix().reshape(-1, 3, 3)
    moving = parts.moving if parts.moving is not None else np.full(len(t), np.nan)
    return Recording(
        path.stem, body, imu[:, 0] - zero, imu[:, 1:4], imu[:, 4:7], t - zero, points, sigma,
        _attitudes(path, parts.attitude, t), encoders[:, 0] - zero, turns, encoders[:, 1:4], moving, cov,
    )  # fmt: skip


def _in_body_order(
    path: Path, body: BodyModel, names: tuple[str, ...], points: Array, sigma: Array
) -> tuple[Array, Array]:
    unknown = [name for name in names if name not in body.names]
    if unknown:
        _bad(path, unknown[0], "a point that the nominal file does not have")
    wide = np.full((len(points), len(body.names), 3), np.nan)
    wide_sigma = np.ones(wide.shape)
    for k, name in enumerate(names):
        at = body.names.index(name)
        wide[:, at], wide_sigma[:, at] = points[:, k], sigma[:, k]
    return wide, wide_sigma


def _attitudes(path: Path, attitude: Array | None, frame_t: Array) -> Array:
    """Attitudes (M, 3, 3) at the frames: the next one in time, NaN where none is near."""
    result = np.full((len(frame_t), 3, 3), np.nan)
    if attitude is None or len(attitude) == 0:
        return result
    norm = np.linalg.norm(attitude[:, 1:], axis=1)
    if not (np.abs(norm - 1.0) < 0.01).all():
        _bad(path, f"|q| = {float(norm[np.argmax(np.abs(norm - 1.0))]):.3g}", "an attitude is a unit quaternion")
    R = Rotation.from_quat(attitude[:, [2, 3, 4, 1]]).as_matrix()
    at = np.clip(np.searchsorted(attitude[:, 0], frame_t), 0, len(R) - 1)
    before = np.maximum(at - 1, 0)
    at = np.where(np.abs(attitude[before, 0] - frame_t) < np.abs(attitude[at, 0] - frame_t), before, at)
    near = np.abs(attitude[at, 0] - frame_t) <= _NEAR_S
    result[near] = R[at[near]]
    return result
