"""The similarity of the map to the cell, against the minimum that an optimiser finds."""

from __future__ import annotations

import numpy as np
import pytest

from docking.geometry import exp_so3
from docking.guidance.similarity import closed_form, refined


def test_the_closed_form_is_the_least_squares_minimum_for_flat_and_noisy_sets() -> None:
    """Nearly coplanar sets with noise often make the determinant negative: rotation and scale both need its sign."""
    rng = np.random.default_rng(3)
    mirrored = 0
    for _ in range(40):
        points = rng.normal(size=(6, 3)) * (1.0, 1.0, 0.05)
        known = 700.0 * points @ exp_so3(rng.normal(size=3)).T + rng.normal(size=(6, 3)) * 60.0
        da, db = points - points.mean(axis=0), known - known.mean(axis=0)
        mirrored += np.linalg.det(da.T @ db) < 0.0
        found = closed_form(points, known)
        best = refined(found, points, known)
        assert found.scale == pytest.approx(best.scale, rel=1e-6)
        np.testing.assert_allclose(found.apply(points), best.apply(points), atol=1e-3)
    assert mirrored >= 5
