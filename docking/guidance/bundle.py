"""Bundle adjustment: Levenberg-Marquardt on the reduced camera system, analytic Jacobians, robust loss.

[Huo] step 6. Minimises `sum rho(|z - project(R p + t)| / sigma)` over cameras, points and, if asked, the shared
intrinsics, plus Gaussian priors on points (surveyed circle centres) and on the intrinsics (the calibration).
Points are eliminated (Schur complement); what is left is one dense system of 6 unknowns a camera.
Arrays of observations are kept component by component, (2, o) and so on: NumPy is fast along the long axis only.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import bsr_array

from docking.geometry import exp_so3
from docking.guidance.projection import Linearised, linearise, project_rows
from docking.guidance.types import Camera
from docking.types import Array

INTRINSICS = 5
"""log f, cx, cy, k1, k2."""
_FIRST_DAMPING = 1e-4
_MOST_REJECTIONS = 8


@dataclass(frozen=True, eq=False)
class Bundle:
    """What is adjusted and what is known.

    Cameras `R` (n, 3, 3), `t` (n, 3): `p_C = R p_W + t`; `points` (m, 3); observation k is `pixels[k]` (2,) of point
    `point_rows[k]` in frame `frame_rows[k]`, standard deviation `sigma_px[k]`, robust beyond `robust_at[k]` sigmas
    (inf: not robust). `held_frames` (n,) and `held_points` (m,) stay. `prior_*`: rows of points with known positions
    (k, 3) and their sigmas (k, 3). `camera_sigma` (5,): the calibration's sigma of log f, cx, cy, k1, k2; None: held.
    """

    camera: Camera
    R: Array
    t: Array
    points: Array
    frame_rows: NDArray[np.integer]
    point_rows: NDArray[np.integer]
    pixels: Array
    sigma_px: Array
    robust_at: Array
    held_frames: NDArray[np.bool_]
    held_points: NDArray[np.bool_] | None = None
    prior_rows: NDArray[np.integer] = field(default_factory=lambda: np.zeros(0, np.int64))
    prior_points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    prior_sigma: Array = field(default_factory=lambda: np.ones((0, 3)))
    camera_sigma: Array | None = None


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The result: cameras, points, intrinsics; `residuals_px` (o, 2) in the order of the observations."""

    camera: Camera
    R: Array
    t: Array
    points: Array
    residuals_px: Array
    cost: float
    iterations: int


@dataclass(frozen=True, eq=False)
class _State:
    R: Array
    t: Array
    points: Array
    intrinsics: Array
    """Change of log f, cx, cy, k1, k2 against the calibration."""


def adjust(bundle: Bundle, iterations: int = 20, tolerance: float = 1e-3) -> Adjusted:
    """Adjust until the cost falls by less than `tolerance` of itself, or for `iterations` steps."""
    return _Solver(bundle).run(iterations, tolerance)


def camera_with(camera: Camera, change: Array) -> Camera:
    """The camera with (log f, cx, cy, k1, k2) changed by `change` (5,)."""
    grown = float(np.exp(change[0]))
    return replace(
        camera,
        fx_px=camera.fx_px * grown,
        fy_px=camera.fy_px * grown,
        cx_px=camera.cx_px + float(change[1]),
        cy_px=camera.cy_px + float(change[2]),
        k1=camera.k1 + float(change[3]),
        k2=camera.k2 + float(change[4]),
    )


class _Solver:
    """One adjustment: the structure of the observations is worked out once."""

    def __init__(self, bundle: Bundle) -> None:
        self.bundle = bundle
        self.order = np.lexsort((bundle.frame_rows, bundle.point_rows))
        self.frames = np.asarray(bundle.frame_rows)[self.order]
        seen, self.starts, self.columns = np.unique(
            np.asarray(bundle.point_rows)[self.order], return_index=True, return_inverse=True
        )
        self.seen = seen
        self.pixels = np.ascontiguousarray(bundle.pixels[self.order].T)
        self.inverse_sigma = 1.0 / bundle.sigma_px[self.order]
        self.robust_at = bundle.robust_at[self.order]
        observed = np.bincount(self.frames, minlength=len(bundle.R)) > 0
        self.free = np.flatnonzero(~bundle.held_frames & observed)
        self.slot = np.full(len(bundle.R), -1)
        self.slot[self.free] = np.arange(len(self.free))
        self.moving = np.flatnonzero(self.slot[self.frames] >= 0)
        self.intrinsics = INTRINSICS if bundle.camera_sigma is not None else 0
        self.held = np.zeros(len(seen), bool) if bundle.held_points is None else bundle.held_points[seen]
        self.prior_slot = np.searchsorted(seen, bundle.prior_rows)
        self._block_structure()

    def _block_structure(self) -> None:
        """Rows of the blocks camera x point, sorted by camera as BSR wants them."""
        slots = self.slot[self.frames[self.moving]]
        self.by_frame = self.moving[np.argsort(slots, kind="stable")]
        counts = np.bincount(slots, minlength=len(self.free))
        self.row_ends = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        self.block_columns = self.columns[self.by_frame].astype(np.int32)

    def sum_by_frame(self, values: Array) -> Array:
        """Sums (n,) over the observations of every free camera; `values` in the order of `by_frame`."""
        sums: Array = np.add.reduceat(values, self.row_ends[:-1]) if len(self.free) else np.zeros(0)
        return sums

    def run(self, iterations: int, tolerance: float) -> Adjusted:
        bundle = self.bundle
        state = _State(bundle.R, bundle.t, bundle.points, np.zeros(INTRINSICS))
        residuals, cost = self._cost(state)
        damping, done, rejected = _FIRST_DAMPING, 0, 0
        while done < iterations and rejected < _MOST_REJECTIONS:
            if rejected == 0:
                system = _Normal(self, state)
            candidate = self._stepped(state, system, damping)
            trial, trial_cost = self._cost(candidate) if candidate is not None else (residuals, np.inf)
            if candidate is None or not (trial_cost <= cost):
                damping, rejected = damping * 10.0, rejected + 1
                continue
            fallen = cost - trial_cost
            state, residuals, cost = candidate, trial, trial_cost
            damping, rejected, done = max(damping * 0.1, 1e-9), 0, done + 1
            if fallen <= tolerance * cost:
                break
        unsorted = np.empty((len(self.order), 2))
        unsorted[self.order] = residuals.T
        camera = camera_with(bundle.camera, state.intrinsics)
        return Adjusted(camera, state.R, state.t, state.points, unsorted, cost, done)

    def camera(self, state: _State) -> Camera:
        return camera_with(self.bundle.camera, state.intrinsics) if self.intrinsics else self.bundle.camera

    def _cost(self, state: _State) -> tuple[Array, float]:
        """(residuals (2, o) px, robust cost); points behind a camera make the cost infinite."""
        projected, depth = project_rows(self.camera(state), *self._gathered(state))
        residuals = self.pixels - projected
        if not (depth.min(initial=1.0) > 0.0):
            return residuals, np.inf
        size = np.hypot(*residuals) * self.inverse_sigma
        beyond = np.minimum(size, self.robust_at)
        cost = float(np.sum(beyond * (2.0 * size - beyond)))
        cost += float(np.sum(self.prior_residuals(state) ** 2))
        if self.bundle.camera_sigma is not None:
            cost += float(np.sum((state.intrinsics / self.bundle.camera_sigma) ** 2))
        return residuals, cost

    def _gathered(self, state: _State) -> tuple[Array, Array, Array]:
        """Rotation (3, 3, o), translation (3, o) and point (3, o) of every observation."""
        points = np.ascontiguousarray(state.points[self.seen].T)
        R, t = np.ascontiguousarray(state.R.transpose(1, 2, 0)), np.ascontiguousarray(state.t.T)
        return R.take(self.frames, axis=2), t.take(self.frames, axis=1), points.take(self.columns, axis=1)

    def prior_residuals(self, state: _State) -> Array:
        bundle = self.bundle
        result: Array = (bundle.prior_points - state.points[bundle.prior_rows]) / bundle.prior_sigma
        return result

    def linearised(self, state: _State) -> Linearised:
        """Jacobians and residuals, whitened and weighted."""
        rows = linearise(self.camera(state), *self._gathered(state))
        residuals = self.pixels - rows.projected
        size = np.hypot(*residuals) * self.inverse_sigma
        # Huber: beyond the limit the weight falls with 1/size.
        weight = np.sqrt(np.minimum(1.0, self.robust_at / np.maximum(size, 1e-12))) * self.inverse_sigma
        return Linearised(residuals * weight, rows.by_frame * weight, rows.by_point * weight, rows.by_camera * weight)

    def _stepped(self, state: _State, system: _Normal, damping: float) -> _State | None:
        try:
            frames, camera, points = system.solve(damping)
        except LinAlgError:
            return None
        R, t, moved = state.R.copy(), state.t.copy(), state.points.copy()
        for k, row in enumerate(self.free):
            R[row] = exp_so3(frames[k, :3]) @ R[row]
        t[self.free] += frames[:, 3:]
        moved[self.seen] += np.where(self.held[:, None], 0.0, points)
        return _State(R, t, moved, state.intrinsics + camera)


class _Normal:
    """The normal equations about one state: U (cameras), V (points), W (between), and the intrinsics' borders."""

    def __init__(self, solver: _Solver, state: _State) -> None:
        self.solver = solver
        rows = solver.linearised(state)
        n, q = len(solver.free), solver.intrinsics
        size = 6 * n + q
        self.U, self.g = np.zeros((size, size)), np.zeros(size)
        self._points(rows, state)
        moving = solver.by_frame
        frame, residual = rows.by_frame.take(moving, axis=2), rows.residuals.take(moving, axis=1)
        at = 6 * np.arange(n)
        for i in range(6):
            self.g[at + i] = solver.sum_by_frame(frame[0, i] * residual[0] + frame[1, i] * residual[1])
            for j in range(i, 6):
                sums = solver.sum_by_frame(frame[0, i] * frame[0, j] + frame[1, i] * frame[1, j])
                self.U[at + i, at + j] = self.U[at + j, at + i] = sums
        point = rows.by_point.take(moving, axis=2)
        self.W = np.empty((6, 3, len(moving)))
        for i in range(6):
            for j in range(3):
                self.W[i, j] = frame[0, i] * point[0, j] + frame[1, i] * point[1, j]
        self.W[:, :, solver.held[solver.columns[moving]]] = 0.0
        self.W_transposed = self._blocks(self.W).transpose()
        if q:
            self._intrinsics(rows, state, frame)

    def _blocks(self, values: Array) -> bsr_array:
        solver = self.solver
        data = np.ascontiguousarray(np.moveaxis(values, 2, 0))
        shape = (6 * len(solver.free), 3 * len(solver.seen))
        return bsr_array((data, solver.block_columns, solver.row_ends), shape=shape)

    def _points(self, rows: Linearised, state: _State) -> None:
        solver, point = self.solver, rows.by_point
        self.V = np.empty((3, 3, len(solver.seen)))
        self.h = np.empty((3, len(solver.seen)))
        for i in range(3):
            products = point[0, i] * rows.residuals[0] + point[1, i] * rows.residuals[1]
            self.h[i] = np.add.reduceat(products, solver.starts)
            for j in range(i, 3):
                products = point[0, i] * point[0, j] + point[1, i] * point[1, j]
                self.V[i, j] = self.V[j, i] = np.add.reduceat(products, solver.starts)
        inverse = 1.0 / solver.bundle.prior_sigma.T
        for i in range(3):
            np.add.at(self.V[i, i], solver.prior_slot, inverse[i] ** 2)
            np.add.at(self.h[i], solver.prior_slot, inverse[i] * solver.prior_residuals(state)[:, i])
        self.h[:, solver.held] = 0.0

    def _intrinsics(self, rows: Linearised, state: _State, frame: Array) -> None:
        solver, n = self.solver, len(self.solver.free)
        sigma = solver.bundle.camera_sigma
        assert sigma is not None
        camera, at = rows.by_camera, 6 * n
        self.U[at:, at:] = np.einsum("aio,ajo->ij", camera, camera, optimize=True) + np.diag(sigma**-2)
        self.g[at:] = np.einsum("aio,ao->i", camera, rows.residuals) - state.intrinsics / sigma**2
        self.K = np.empty((INTRINSICS, 3, len(solver.seen)))
        ordered = camera.take(solver.by_frame, axis=2)
        for k in range(INTRINSICS):
            for i in range(6):
                sums = solver.sum_by_frame(ordered[0, k] * frame[0, i] + ordered[1, k] * frame[1, i])
                self.U[i:at:6, at + k] = self.U[at + k, i:at:6] = sums
            for j in range(3):
                products = camera[0, k] * rows.by_point[0, j] + camera[1, k] * rows.by_point[1, j]
                self.K[k, j] = np.add.reduceat(products, solver.starts)
        self.K[:, :, solver.held] = 0.0

    def solve(self, damping: float) -> tuple[Array, Array, Array]:
        """Steps of the cameras (n, 6), the intrinsics (5,) and the points (m, 3) at one damping."""
        solver, n = self.solver, len(self.solver.free)
        inverse = _inverse(self.V, damping)
        S = self.U + np.diag(np.diag(self.U) * damping)
        right, Vh = self.g.copy(), np.einsum("ijm,jm->im", inverse, self.h)
        at = 6 * n
        if n:
            chosen = inverse[:, :, solver.columns[solver.by_frame]]
            Y = self._blocks(_times(self.W, chosen))
            S[:at, :at] -= (Y @ self.W_transposed).toarray()
            right[:at] -= Y @ self.h.T.ravel()
        if solver.intrinsics:
            KV = _times(self.K, inverse)
            S[at:, at:] -= np.einsum("ijm,kjm->ik", KV, self.K, optimize=True)
            right[at:] -= np.einsum("ijm,jm->i", KV, self.h)
            if n:
                border = Y @ np.ascontiguousarray(self.K.transpose(2, 1, 0)).reshape(-1, INTRINSICS)
                S[:at, at:] -= border
                S[at:, :at] -= border.T
        step = cho_solve(cho_factor(S, check_finite=False), right) if len(right) else right
        if not np.all(np.isfinite(step)):
            raise LinAlgError
        back = np.zeros_like(self.h)
        if n:
            back += (self.W_transposed @ step[:at]).reshape(-1, 3).T
        if solver.intrinsics:
            back += np.einsum("kim,k->im", self.K, step[at:])
        points = Vh - np.einsum("ijm,jm->im", inverse, back)
        camera = step[at:] if solver.intrinsics else np.zeros(INTRINSICS)
        return step[:at].reshape(n, 6), camera, points.T


def _times(left: Array, right: Array) -> Array:
    """(a, 3, k) times symmetric (3, 3, k), block by block."""
    result = np.empty_like(left)
    for i in range(left.shape[0]):
        for j in range(3):
            result[i, j] = left[i, 0] * right[0, j] + left[i, 1] * right[1, j] + left[i, 2] * right[2, j]
    return result


def _inverse(V: Array, damping: float) -> Array:
    """Inverses (3, 3, m) of the damped symmetric blocks, by cofactors."""
    a, d, f = (V[i, i] * (1.0 + damping) + 1e-12 for i in range(3))
    b, c, e = V[0, 1], V[0, 2], V[1, 2]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * A + b * B + c * C)
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    result: Array = np.array([[A, B, C], [B, D, E], [C, E, F]]) * scale
    return result
