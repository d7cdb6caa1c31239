"""A camera pair's files: calibration of each camera (TOML), pixel tracks of both, and the points that come of them."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import ValidationError

from docking.config.live import CameraCalibration
from docking.errors import BadRecording, ConfigInvalid, FileUnreadable
from docking.geometry import pose_from_vector
from docking.tracking.stereo import StereoCamera, triangulate
from docking.types import Array


class PixelRow(NamedTuple):
    """One point in one image: time, camera, point, pixel."""

    t_s: float
    camera: str
    name: str
    u_px: float
    v_px: float


class StereoFrames(NamedTuple):
    """Times (M,), names, points (M, n, 3) in W with NaN where one camera or both do not see them, and covariances
    (M, n, 3, 3)."""

    t_s: Array
    names: tuple[str, ...]
    xyz_W_mm: Array
    cov_mm2: Array


def read_stereo_camera(path: Path) -> StereoCamera:
    """A camera of a pair, called as its file. Raises FileUnreadable, ConfigInvalid."""
    try:
        table = tomllib.loads(path.read_text("utf-8-sig"))
    except OSError as error:
        raise FileUnreadable(str(path), error.strerror or type(error).__name__) from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigInvalid(str(path), (str(error),)) from error
    try:
        found = CameraCalibration.model_validate(_tuples(table))
    except ValidationError as error:
        problems = tuple(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise ConfigInvalid(str(path), problems) from error
    return stereo_camera(path.stem, found)


def stereo_camera(name: str, found: CameraCalibration) -> StereoCamera:
    """The camera of a calibration."""
    bent = np.zeros(5)
    bent[: len(found.distortion)] = found.distortion
    focal, centre = np.array([found.fx_px, found.fy_px]), np.array([found.cx_px, found.cy_px])
    return StereoCamera(name, focal, centre, bent, pose_from_vector(found.pose), found.pixel_sigma)


def _tuples(table: dict[str, object]) -> dict[str, object]:
    """TOML's arrays as tuples of floats where they are numbers; the model is strict."""

    def number(value: object) -> object:
        return float(value) if isinstance(value, int) and not isinstance(value, bool) else value

    return {k: tuple(map(number, v)) if isinstance(v, list) else number(v) for k, v in table.items()}


def stereo_frames(path: Path, cameras: Sequence[StereoCamera], rows: Sequence[PixelRow]) -> StereoFrames:
    """Points out of the pixel tracks in `path`. Raises BadRecording where cameras and tracks do not go together."""
    names = [camera.name for camera in cameras]
    if len(cameras) != 2:
        raise BadRecording(str(path), "pixel tracks need the files of two cameras", value=", ".join(names) or "none")
    strangers = sorted({row.camera for row in rows} - set(names))
    if strangers:
        raise BadRecording(str(path), f"a camera of which no file was given; there are {names}", value=strangers[0])
    points = tuple(dict.fromkeys(row.name for row in rows))
    times = sorted({row.t_s for row in rows})
    place, column = {t: k for k, t in enumerate(times)}, {name: k for k, name in enumerate(points)}
    pixels = np.full((2, len(times), len(points), 2), np.nan)
    for row in rows:
        at = names.index(row.camera), place[row.t_s], column[row.name]
        if np.isfinite(pixels[at]).any():
            raise BadRecording(str(path), "given twice for one camera and time", value=f"{row.name} at {row.t_s} s")
        pixels[at] = row.u_px, row.v_px
    flat = pixels.reshape(2, -1, 2)
    found = triangulate(cameras[0], cameras[1], (flat[0], flat[1]))
    good = found.agreeing()
    shape = len(times), len(points)
    xyz = np.where(good[:, None], found.xyz_W_mm, np.nan).reshape(*shape, 3)
    return StereoFrames(np.array(times), points, xyz, found.cov_mm2.reshape(*shape, 3, 3))
