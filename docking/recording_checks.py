"""What a recording cannot be: other units than its headers say, sources on different clocks, no point at all."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from docking.errors import BadRecording
from docking.tracking.types import BodyModel
from docking.types import Array

_FORCE_M_S2, _MOST_RAD_S = (5.0, 20.0), 8.0
_SLOWEST_SAMPLES_S, _SLOWEST_FRAMES_S = 0.2, 5.0


class Raw(NamedTuple):
    """What the files said: inertial samples (N, 7) and read-backs (K, 7) as their headers have them, None where there
    are none; frame times (M,), points (M, n, 3) of the body, NaN where not seen; whether nominal points are `stated`.
    """

    imu: Array | None
    encoders: Array | None
    frame_t_s: Array
    points_mm: Array
    body: BodyModel
    stated: bool


def check_recording(path: Path, raw: Raw) -> None:
    """Raises BadRecording for what gravity, the pace of the sources and the size of the body do not permit."""
    _check_frames(path, raw)
    if raw.imu is not None:
        _check_samples(path, raw.imu)
        _check_clock(path, "inertial samples", raw.imu[:, 0], raw.frame_t_s)
    if raw.encoders is not None:
        _check_clock(path, "read-backs of the encoders", raw.encoders[:, 0], raw.frame_t_s)


def _bad(path: Path, value: str, cause: str) -> NoReturn:
    raise BadRecording(str(path), cause, value=value)


def _check_frames(path: Path, raw: Raw) -> None:
    if not np.isfinite(raw.points_mm).all(axis=2).any():
        _bad(path, f"{len(raw.points_mm)} frames", "no frame shows a point")
    pace = float(np.median(np.diff(raw.frame_t_s))) if len(raw.frame_t_s) > 1 else 0.0
    if not (pace < _SLOWEST_FRAMES_S):
        _bad(path, f"{pace:.4g} s", "frames stand so far apart: times are in s")
    whole = raw.points_mm[np.isfinite(raw.points_mm).all(axis=(1, 2))][:100]
    if raw.stated and len(raw.body.names) > 2 and len(whole):
        nominal = float(np.ptp(raw.body.points_B_mm, axis=0).max())
        seen = float(np.median(np.linalg.norm(np.ptp(whole, axis=1), axis=1)))
        if not (0.02 * nominal < seen < 50.0 * nominal):
            _bad(path, f"{seen:.4g} mm", f"the seen points span so much, the nominal ones {nominal:.4g} mm")


def _check_samples(path: Path, imu: Array) -> None:
    force = float(np.median(np.linalg.norm(imu[:, 1:4], axis=1)))
    if not (_FORCE_M_S2[0] < force < _FORCE_M_S2[1]):
        _bad(path, f"{force:.4g}", "specific force is in m/s^2 with gravity: about 9.8 in the middle")
    rate = float(np.median(np.linalg.norm(imu[:, 4:7], axis=1)))
    if not (rate < _MOST_RAD_S):
        _bad(path, f"{rate:.4g}", "turning rates are in rad/s: so much in the middle is no body's")
    pace = float(np.median(np.abs(np.diff(imu[:, 0])))) if len(imu) > 1 else np.inf
    if not (pace < _SLOWEST_SAMPLES_S):
        _bad(path, f"{pace:.4g} s", "inertial samples stand so far apart: times are in s")


def _check_clock(path: Path, what: str, t: Array, frame_t: Array) -> None:
    if not (t.min() < frame_t[-1] and t.max() > frame_t[0]):
        _bad(path, f"{t[0]:.6g} s, {frame_t[0]:.6g} s", f"{what} and frames are on one clock")
