"""Is the part deformed? Many residuals that follow one smooth field are no outliers.

Two explanations of the same points compete by their evidence (Bayes; -2 ln of the probability of the data):

* a rigid part, and some points that moved each by itself, by an amount of any size (the size that suits it best);
* a part whose points are displaced by a smooth random field: a Gaussian process of the amplitude that suits best. Along
  the longest direction x its covariance is `exp(-(x - x')^2 / (2 l^2))`, l the length over which a part bends; the
  displacement is free (bending), about the longest axis (torsion), or away from the middle in proportion (growth). A
  last field is smooth in space and has no name: the part is then called by the likeliest of the others.

The pose is integrated out in both, so what a rigid motion could do costs the field nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from docking.pose.layout import spread
from docking.pose.least_squares import design
from docking.pose.quantiles import chi2_tail
from docking.pose.snooping import Pairs, Tested
from docking.pose.uncertainty import total_cov_mm2
from docking.types import Array, Pose

_SMOOTH = 0.6
"""Length of the field, in extents of the part along its longest direction."""
_LARGEST = 5e-3
"""Largest amplitude, in the same extents: beyond it is another part."""
_EVIDENCE = 3.0
"""By how much the field must be ahead: e^1.5 times as likely. None of 3300 drawn sets with a minority of mis-aimed or
slid points came near; of those with four wrong points of seven three in a thousand are called deformed."""
_CHANCE = 1e-5
"""Without any rejected point the rigid fit must be as improbable as this before a field is asked for at all."""
_NOISE = 1.5
"""A field below this many times the points' noise (all coordinates together) does no harm that noise does not."""
_LEFT_OUT = 3
"""Events that may be left out before the field is given up."""
_MOST_POINTS = 40
"""Of more points only so many are looked at."""
_UNIT = np.array([1e-3] * 3 + [1.0] * 3)
"""Scale of [rad, mm] that keeps the systems well conditioned on parts of metres."""


class Deformation(NamedTuple):
    """What the part does: its shape in a word, how far it carries a point at most, mm, and what would pass as noise."""

    shape: str
    largest_mm: float
    noise_mm: float


class _Scene(NamedTuple):
    """Rows looked at and, for each: residual of the rigid fit (m, 3), covariance (m, 3, 3), pose's design (m, 3, 6)."""

    rows: list[int]
    r: Array
    cov: Array
    a: Array

    def without(self, row: int) -> _Scene:
        """The scene less one row."""
        k = self.rows.index(row)
        keep = [i for i in range(len(self.rows)) if i != k]
        return _Scene([self.rows[i] for i in keep], self.r[keep], self.cov[keep], self.a[keep])


class _Field(NamedTuple):
    """The best field: its cost, the displacement it gives each row (m, 3), how surprising each row is with it (m,)."""

    shape: str
    cost: float
    moves_mm: Array
    surprise: Array


def deformation(pairs: Pairs, tested: Tested, events: tuple[tuple[int, ...], ...]) -> Deformation | None:
    """How the part is deformed, or None where a rigid part explains the points better.

    `tested` is the rigid fit, `events` the rows that moved without another explanation, those that moved alike
    together. A row that no field explains either counts as an event in both explanations.
    """
    moved = [i for event in events for i in event]
    if not moved and chi2_tail(tested.chi2, 3 * len(tested.kept) - 6) >= _CHANCE:
        return None
    scene = _scene(pairs, tested, sorted([*tested.kept, *moved]))
    costs = {event: _event_cost(scene, [i for i in event if i in scene.rows]) for event in events}
    kept = set(tested.kept)
    rigid = _rigid_cost(scene, [k for k, i in enumerate(scene.rows) if i in kept]) + sum(costs.values())
    spent = 0.0
    for _ in range(_LEFT_OUT + 1):
        field = _best_field(scene, pairs, tested.solution.X_MN)
        if rigid - field.cost - spent > _EVIDENCE:
            found = _described(scene, field)
            return found if found.largest_mm > found.noise_mm else None
        worst = max(costs, key=lambda event: _surprise(scene, field, event), default=())
        if not worst or len(costs) < 2:
            break
        spent += costs.pop(worst)
        for i in worst:
            scene = scene.without(i) if i in scene.rows else scene
    return None


def _scene(pairs: Pairs, tested: Tested, rows: list[int]) -> _Scene:
    if len(rows) > _MOST_POINTS:
        rows = [rows[k] for k in np.linspace(0, len(rows) - 1, _MOST_POINTS).round().astype(int)]
    q = tested.solution.X_MN.apply(pairs.nominal_mm[rows])
    q = q + tested.solution.expansion * (q - tested.solution.pivot_mm)
    cov = total_cov_mm2(pairs.nominal_cov_mm2[rows], pairs.measured_cov_mm2[rows], tested.solution.X_MN.R)
    a = design(q, tested.solution.pivot_mm)[:, :, :6] * _UNIT
    return _Scene(rows, pairs.measured_mm[rows] - q, cov, a)


def _event_cost(scene: _Scene, rows: list[int]) -> float:
    """Cost of points displaced by one vector drawn from a normal distribution of the width that suits it best."""
    if not rows:
        return 0.0
    at = [scene.rows.index(i) for i in rows]
    r = scene.r[at].mean(axis=0)
    squares = float(r @ np.linalg.solve(scene.cov[at].mean(axis=0) / len(at), r))
    return 3.0 * float(np.log(max(squares, 3.0) / 3.0)) + 3.0 * len(rows)


def _rigid_cost(scene: _Scene, at: list[int]) -> float:
    """Chi-square of the kept rows, and what is left open of their pose."""
    solved = np.linalg.solve(scene.cov[at], np.concatenate([scene.r[at][:, :, None], scene.a[at]], axis=2))
    b, a = solved[:, :, 0].reshape(-1), scene.a[at].reshape(-1, 6)
    normal = a.T @ solved[:, :, 1:].reshape(-1, 6)
    rhs = a.T @ b
    return float(scene.r[at].reshape(-1) @ b - rhs @ np.linalg.solve(normal, rhs) + np.linalg.slogdet(normal)[1])


def _best_field(scene: _Scene, pairs: Pairs, X_MN: Pose) -> _Field:
    """The field whose shape and amplitude explain the rows best."""
    extent = np.sqrt(12.0) * spread(pairs.nominal_mm).long_mm
    sigma = float(np.sqrt(np.mean(np.trace(scene.cov, axis1=1, axis2=2)) / 3.0))
    steps = max(int(np.log2(max(_LARGEST * extent / sigma, 4.0)) / 2.0), 1)
    kernels = _kernels(pairs.nominal_mm, scene.rows, extent, X_MN.R)
    fields = [_field(scene, kernel, (sigma * 4.0**k) ** 2) for kernel in kernels.items() for k in range(steps + 1)]
    best = min(fields, key=lambda field: field.cost)
    named = min((field for field in fields if field.shape), key=lambda field: field.cost)
    return best._replace(shape=named.shape)


def _kernels(nominal_mm: Array, rows: list[int], extent_mm: float, R_MN: Array) -> dict[str, Array]:
    """Covariances (3 m, 3 m) in M of the fields of unit amplitude, by the word for their shape."""
    axes = _principal_axes(nominal_mm)
    j = (nominal_mm - nominal_mm.mean(axis=0))[rows]
    m, along = len(rows), j @ axes[0]
    across = j - np.outer(along, axes[0])
    smooth = 2.0 * (_SMOOTH * extent_mm) ** 2
    line = np.exp(-((along[:, None] - along[None, :]) ** 2) / smooth)
    space = np.exp(-np.sum((j[:, None] - j[None, :]) ** 2, axis=2) / smooth)
    twist = (np.cross(axes[0], across) / max(float(np.max(np.abs(across))), 1e-9) @ R_MN.T).reshape(-1)
    growth = (j / (extent_mm / 2.0) @ R_MN.T).reshape(-1)
    each = np.ones((3, 3))
    return {
        "bending": np.kron(line, np.eye(3)),
        "torsion": np.kron(line, each) * np.outer(twist, twist),
        "growth": np.kron(np.ones((m, m)), each) * np.outer(growth, growth),
        "": np.kron(space, np.eye(3)),
    }


def _principal_axes(points_mm: Array) -> Array:
    """Rows (3, 3): the directions in which points (n, 3) extend most, second, least."""
    axes: Array = np.linalg.svd(points_mm - points_mm.mean(axis=0), full_matrices=True)[2]
    return axes


def _field(scene: _Scene, named: tuple[str, Array], variance_mm2: float) -> _Field:
    """One shape and amplitude: cost `r^T C^-1 r + ln det C / det S + ln det A^T C^-1 A` with the pose at its best."""
    (shape, kernel), m = named, len(scene.rows)
    noise = np.zeros((3 * m, 3 * m))
    for k, cov in enumerate(scene.cov):
        noise[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = cov
    inverse = np.linalg.inv(noise + variance_mm2 * kernel)
    a, r = scene.a.reshape(-1, 6), scene.r.reshape(-1)
    normal = a.T @ inverse @ a
    left = r - a @ np.linalg.solve(normal, a.T @ inverse @ r)
    pull = inverse @ left
    cost = float(left @ pull) - float(np.linalg.slogdet(inverse)[1]) + float(np.linalg.slogdet(normal)[1])
    own = inverse.reshape(m, 3, m, 3)[np.arange(m), :, np.arange(m), :]
    pulls = pull.reshape(m, 3)
    surprise = np.einsum("ni,ni->n", pulls, np.linalg.solve(own, pulls[:, :, None])[:, :, 0])
    cost -= float(np.sum(np.linalg.slogdet(scene.cov)[1]))
    return _Field(shape, cost, (variance_mm2 * kernel @ pull).reshape(m, 3), surprise)


def _surprise(scene: _Scene, field: _Field, event: tuple[int, ...]) -> float:
    """How badly the field predicts the worst point of an event from all other points."""
    return max((float(field.surprise[scene.rows.index(i)]) for i in event if i in scene.rows), default=0.0)


def _described(scene: _Scene, field: _Field) -> Deformation:
    """The field less its rigid part."""
    a, whole = scene.a.reshape(-1, 6), field.moves_mm.reshape(-1)
    u = (whole - a @ np.linalg.lstsq(a, whole, rcond=None)[0]).reshape(-1, 3)
    noise = _NOISE * float(np.sqrt(np.mean(np.trace(scene.cov, axis1=1, axis2=2))))
    return Deformation(field.shape, float(np.max(np.linalg.norm(u, axis=1))), noise)
