"""Maximum likelihood with held degrees of freedom: entries of X_MN = (alpha, beta, gamma, x, y, z) keep given values.

Steps are taken in the free entries alone, so the held ones stay exact. While no angle is held the rotation turns freely
about the origin of N and no gimbal lock is met; with a held angle the other two are [Luo]'s angles.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from docking.errors import NotCongruent
from docking.geometry import euler_to_matrix, exp_so3
from docking.pose.least_squares import (
    MAX_ITERATIONS,
    Solution,
    normal_equations,
    radius_mm,
    step_limit_mm,
    weighted_centroid,
)
from docking.types import Array, Pose

ANGLES = ("alpha", "beta", "gamma")
TRANSLATIONS = ("x", "y", "z")
_GRID = 12
"""Start values of a free angle: within 15 degrees of the best, wherever that is."""
_RANK = 1e-10


class Held(NamedTuple):
    """The locks by name (rad, mm) and 1 sigma of the expansion that is estimated too (0: rigid)."""

    values: dict[str, float]
    expansion_sigma: float = 0.0

    @property
    def angles(self) -> bool:
        """Whether any angle is held."""
        return any(name in self.values for name in ANGLES)


class _Place(NamedTuple):
    """Where the iteration is: the pose, and the angles (3,) it was made from where any is held."""

    X: Pose
    angles: Array


def _held_start(X: Pose, centre_N_mm: Array, held: Held) -> _Place:
    """A pose that obeys the locks and is near X: angles from a grid, then the free translation at the centre (3,)."""
    R, angles = X.R, np.zeros(3)
    if held.angles:
        steps = (2.0 * np.pi / _GRID * np.arange(_GRID)).tolist()
        free = [[held.values[name]] if name in held.values else steps for name in ANGLES]
        angles = np.array(max(product(*free), key=lambda a: float(np.sum(euler_to_matrix(*a) * X.R))))
        R = euler_to_matrix(*angles)
    t = X.apply(centre_N_mm) - R @ centre_N_mm
    t = np.array([held.values.get(name, float(t[k])) for k, name in enumerate(TRANSLATIONS)])
    return _Place(Pose(R, t), angles)


def turning_axes(beta_rad: float, gamma_rad: float) -> Array:
    """Columns (3, 3): the axes in M about which alpha, beta and gamma turn, R = Rz(gamma) Ry(beta) Rx(alpha)."""
    cb, sb, cg, sg = np.cos(beta_rad), np.sin(beta_rad), np.cos(gamma_rad), np.sin(gamma_rad)
    return np.array([[cg * cb, -sg, 0.0], [sg * cb, cg, 0.0], [-sb, 0.0, 1.0]])


def _freedom(place: _Place, pivot_mm: Array, held: Held) -> Array:
    """(7, m): how [rotation, translation, expansion] about the pivot follows the m free parameters.

    An angle turns about an axis through the origin of N: `d = w x (c - T)`; an expansion is about the pivot.
    """
    axes = turning_axes(place.angles[1], place.angles[2]) if held.angles else np.eye(3)
    basis = np.eye(7)
    basis[:3, :3] = axes
    basis[3:6, :3] = np.cross(axes.T, pivot_mm - place.X.t_mm).T
    free = [k for k, name in enumerate((*ANGLES, *TRANSLATIONS)) if name not in held.values]
    return basis[:, [*free, 6] if held.expansion_sigma > 0.0 else free]


def _moved(place: _Place, step: Array, held: Held) -> _Place:
    """The next place after a step in the free parameters, in the order of `_freedom`."""
    whole = np.zeros(6)
    free = [k for k, name in enumerate((*ANGLES, *TRANSLATIONS)) if name not in held.values]
    whole[free] = step[: len(free)]
    angles = place.angles + whole[:3] if held.angles else place.angles
    R = euler_to_matrix(*angles) if held.angles else exp_so3(whole[:3]) @ place.X.R
    return _Place(Pose(R, place.X.t_mm + whole[3:]), angles)


def _step(normal: Array, rhs: Array, basis: Array, size: Array) -> tuple[Array, Array]:
    """Step (m,) in the free parameters and its covariance (7, 7) about the pivot; `size` (7,) scales to mm.

    With beta held at +-90 deg alpha and gamma turn about one axis: the pseudo-inverse moves along it.
    """
    scale = 1.0 / np.linalg.norm(basis * size[:, None], axis=0)
    b = basis * scale
    inverse = np.linalg.pinv(b.T @ normal @ b, rcond=_RANK, hermitian=True)
    return scale * (inverse @ (b.T @ rhs)), b @ inverse @ b.T


def fit_locked(
    nominal_mm: Array, measured_mm: Array, covs_mm2: tuple[Array, Array], start: Pose, held: Held
) -> Solution:
    """Maximum-likelihood pose among those that obey the locks; arguments and result as `fit_maximum_likelihood`.

    The covariance is `B (B^T N B)^-1 B^T` with B the free directions: zero along held ones. Raises NotCongruent.
    """
    place, e = _held_start(start, nominal_mm.mean(axis=0), held), 0.0
    c = weighted_centroid(measured_mm, covs_mm2[1] + place.X.R @ covs_mm2[0] @ place.X.R.T)
    radius = radius_mm(measured_mm, c)
    size, limit = np.array([radius] * 3 + [1.0] * 3 + [radius]), 100.0 * step_limit_mm(measured_mm)
    for iteration in range(1, MAX_ITERATIONS + 1):
        normal, rhs = normal_equations(place.X, e, (nominal_mm, measured_mm, *covs_mm2), c)
        if held.expansion_sigma > 0.0:
            normal[6, 6] += held.expansion_sigma**-2
            rhs[6] -= e * held.expansion_sigma**-2
        basis = _freedom(place, c, held)
        step, cov = _step(normal, rhs, basis, size)
        place = _moved(place, step, held)
        e += float(step[-1]) if held.expansion_sigma > 0.0 else 0.0
        if float(np.linalg.norm(size * (basis @ step))) < limit:
            return Solution(place.X, iteration, cov, c, e)
    n = len(nominal_mm)
    raise NotCongruent("fit", "no pose with these locks comes near the points", value=n, limit=n)
