"""P2: fits of ten points against SciPy's `Rotation.align_vectors` (centroids taken off) and NumPy's SVD."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from docking.pose import LASER_TRACKER, fit_pose, screen
from docking.pose.batch import fit_poses
from docking.pose.svd import fit_svd
from docking.types import Array, Points
from tests.bench.metric import Metric, Sizes, median_ratio, side_by_side

LOOPED = 500
"""Fits of the peer's loop; it takes as long for every fit."""
TOGETHER = 100
"""Single fits a turn: one alone is too short for the clock."""


def measure(sizes: Sizes) -> list[Metric]:
    nominal, measured = _points()
    epochs = measured.xyz_mm + np.random.default_rng(2).normal(0.0, 0.02, (sizes.epochs, 10, 3))
    works: dict[str, Callable[[], object]] = {
        "peer": lambda: [_align(nominal.xyz_mm, measured.xyz_mm) for _ in range(TOGETHER)],
        "single": lambda: [fit_svd(nominal.xyz_mm, measured.xyz_mm) for _ in range(TOGETHER)],
        "complete": lambda: [fit_pose(screen(nominal, measured)) for _ in range(TOGETHER)],
    }
    times = side_by_side(works, 3 * sizes.repeats)
    return [
        _metric("single fit, 10 points", times["single"], times["peer"], 0.5),
        _metric("screening, ML fit and covariance, 10 points", times["complete"], times["peer"], 20.0),
        *_batch(nominal.xyz_mm, epochs, sizes),
    ]


def _metric(what: str, product: list[float], peer: list[float], target: float) -> Metric:
    mine, theirs = (1e6 * float(np.median(t)) / TOGETHER for t in (product, peer))
    ratio = median_ratio(product, peer)
    return Metric("P2", what, f"{mine:.0f} us", f"{theirs:.0f} us align_vectors", ratio, target, at_least=False)


def _batch(nominal_mm: Array, epochs_mm: Array, sizes: Sizes) -> list[Metric]:
    h = np.einsum("ni,bnj->bij", nominal_mm - nominal_mm.mean(axis=0), epochs_mm)
    some = epochs_mm[:LOOPED]
    works: dict[str, Callable[[], object]] = {
        "product": lambda: fit_poses(nominal_mm, epochs_mm),
        "loop": lambda: [_align(nominal_mm, p) for p in some],
        "svd": lambda: np.linalg.svd(h),
    }
    times = side_by_side(works, sizes.repeats)
    loop = [t * len(epochs_mm) / len(some) for t in times["loop"]]
    product, looped, svd = (float(np.median(t)) for t in (times["product"], loop, times["svd"]))
    what = f"{len(epochs_mm)} fits of 10 points"
    faster, share = median_ratio(loop, times["product"]), median_ratio(times["product"], times["svd"])
    mine = f"{1e3 * product:.0f} ms"
    return [
        Metric("P2", what, mine, f"{1e3 * looped:.0f} ms align_vectors", faster, 60.0),
        Metric("P2", what, mine, f"{1e3 * svd:.0f} ms np.linalg.svd", share, 0.4, at_least=False),
    ]


def _points() -> tuple[Points, Points]:
    """Ten targets of a fuselage section and one reading of each from a tracker nine metres to the side."""
    rng = np.random.default_rng(1)
    j = rng.uniform([-4000.0, -2000.0, -2000.0], [4000.0, 2000.0, 2000.0], (10, 3))
    p = Rotation.random(random_state=rng).apply(j) + np.array([1000.0, 2000.0, 3000.0])
    cov = LASER_TRACKER.covariance(p - np.array([500.0, -9000.0, 800.0]))
    p = p + np.einsum("nij,nj->ni", np.linalg.cholesky(cov), rng.normal(size=p.shape))
    names = tuple(f"T{i + 1}" for i in range(10))
    return Points(names, j, np.tile(0.005**2 * np.eye(3), (10, 1, 1))), Points(names, p, cov)


def _align(nominal_mm: Array, measured_mm: Array) -> tuple[Rotation, Array]:
    """The peer: SciPy's rotation, centroids and translation by hand."""
    c, d = nominal_mm.mean(axis=0), measured_mm.mean(axis=0)
    turn, _ = Rotation.align_vectors(measured_mm - d, nominal_mm - c)
    return turn, d - turn.apply(c)
