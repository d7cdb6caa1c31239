"""Devices that track themselves: where their own world is in the cell, from pairs of poses.

A pair is the pose X_WK of the device's camera in the cell (localised here) and the pose X_DK that the device gave for
the same image in its own world D. The registration is X_WD with X_WK = X_WD X_DK: the device draws at its own rate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.errors import DevicePairsDisagree
from docking.geometry import exp_so3, log_so3, rms, skew
from docking.types import Array, Pose

LEAST_PAIRS = 3
_AGREE_MM, _AGREE_RAD = 30.0, np.deg2rad(2.0)
_LEAST_SHARE = 0.6
_ROUNDS = 20
_TUKEY_SIGMAS = 14.0
"""Three times Tukey's usual limit: the device drifts by more than the sigmas of the localisation say."""
_SCALE_BASE_MM = 300.0
"""Positions closer together than this say nothing about the device's scale."""

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0])
"""Camera axes of ARKit, ARCore, WebXR (y up, z backward) as those used here: R_DK = R_device @ OPENGL_TO_OPENCV."""


@dataclass(frozen=True, eq=False)
class DevicePair:
    """One image: `X_WK` camera in the cell, `X_DK` camera in the device's world (axes x right, y down, z forward).

    `sigma_mm` and `sigma_rad` of X_WK.
    """

    X_WK: Pose
    X_DK: Pose
    sigma_mm: float = 2.0
    sigma_rad: float = 2e-3


@dataclass(frozen=True, eq=False)
class Registration:
    """X_WD, rms and largest distance mm of the pairs that agree, rows of those that do not.

    `scale` is the length of a device's metre in the cell as the pairs show it, None where they are too close together;
    X_WD itself is rigid.
    """

    X_WD: Pose
    used: tuple[int, ...]
    rejected: tuple[int, ...]
    rms_mm: float
    max_mm: float
    scale: float | None


def register(pairs: list[DevicePair]) -> Registration:
    """X_WD by a robust least-squares fit on SE(3). Raises DevicePairsDisagree when fewer than 3 or 60 % agree.

    Start: the pair whose own X_WK X_DK^-1 most pairs agree with. Then Gauss-Newton with Tukey's weights on
    [log(R_WK^T R_WD R_DK), p_WD(K) - p_WK] in sigmas.
    """
    if len(pairs) < LEAST_PAIRS:
        raise DevicePairsDisagree("registration", "too few pairs", value=len(pairs), limit=LEAST_PAIRS)
    X_WD = _consensus(pairs)
    for _ in range(_ROUNDS):
        X_WD, step = _improved(X_WD, pairs)
        if step < 1e-9:
            break
    distance, angle = _misfit(X_WD, pairs)
    agree = (distance <= _AGREE_MM) & (angle <= _AGREE_RAD)
    needed = max(LEAST_PAIRS, int(np.ceil(_LEAST_SHARE * len(pairs))))
    if not np.count_nonzero(agree) >= needed:
        cause = f"the others are more than {_AGREE_MM:.0f} mm or {np.rad2deg(_AGREE_RAD):.0f} deg off"
        raise DevicePairsDisagree("registration", cause, value=int(np.count_nonzero(agree)), limit=needed)
    used = np.flatnonzero(agree)
    return Registration(
        X_WD,
        tuple(int(k) for k in used),
        tuple(int(k) for k in np.flatnonzero(~agree)),
        rms((distance[used])[:, None]),
        float(distance[used].max()),
        _scale([pairs[k] for k in used]),
    )


def _consensus(pairs: list[DevicePair]) -> Pose:
    candidates = [pair.X_WK @ pair.X_DK.inverse() for pair in pairs]
    costs = []
    for X_WD in candidates:
        distance, angle = _misfit(X_WD, pairs)
        costs.append(float(np.sum(np.minimum(distance / _AGREE_MM, 1.0) + np.minimum(angle / _AGREE_RAD, 1.0))))
    return candidates[int(np.argmin(costs))]


def _misfit(X_WD: Pose, pairs: list[DevicePair]) -> tuple[Array, Array]:
    """(distances mm (n,), angles rad (n,)) between X_WD X_DK and X_WK."""
    errors = [pair.X_WK.inverse() @ X_WD @ pair.X_DK for pair in pairs]
    return (
        np.array([np.linalg.norm(e.t_mm) for e in errors]),
        np.array([np.linalg.norm(log_so3(e.R)) for e in errors]),
    )


def _improved(X_WD: Pose, pairs: list[DevicePair]) -> tuple[Pose, float]:
    """One weighted step on the left: X_WD -> exp([w, d]) X_WD about the mean position; (pose, size of the step)."""
    pivot = np.mean([pair.X_WK.t_mm for pair in pairs], axis=0)
    H, g = np.zeros((6, 6)), np.zeros(6)
    for pair in pairs:
        X_WK = X_WD @ pair.X_DK
        turn = log_so3(pair.X_WK.R @ X_WK.R.T) / pair.sigma_rad
        shift = (pair.X_WK.t_mm - X_WK.t_mm) / pair.sigma_mm
        weight = _weight(float(np.sqrt((turn @ turn + shift @ shift) / 2.0)))
        a = X_WK.t_mm - pivot
        J = np.zeros((6, 6))
        J[:3, :3] = np.eye(3) / pair.sigma_rad
        J[3:, :3] = -skew(a) / pair.sigma_mm
        J[3:, 3:] = np.eye(3) / pair.sigma_mm
        H += weight * J.T @ J
        g += weight * J.T @ np.concatenate([turn, shift])
    step = np.linalg.lstsq(H, g, rcond=None)[0]
    R = exp_so3(step[:3])
    moved = Pose(R @ X_WD.R, R @ (X_WD.t_mm - pivot) + pivot + step[3:])
    return moved, float(np.max(np.abs(step)))


def _weight(sigmas: float) -> float:
    # A floor keeps the fit from losing every pair when the stated sigmas are too small: the start then decides.
    return max(1e-6, (1.0 - min(1.0, sigmas / (_TUKEY_SIGMAS)) ** 2) ** 2)


def _scale(pairs: list[DevicePair]) -> float | None:
    """Ratio of the spread of the positions in the cell to that in the device's world."""
    cell = np.array([pair.X_WK.t_mm for pair in pairs])
    own = np.array([pair.X_DK.t_mm for pair in pairs])
    spread = rms(cell - cell.mean(axis=0))
    if not spread >= _SCALE_BASE_MM:
        return None
    return spread / rms(own - own.mean(axis=0))
