"""From a frame of the camera to points of the part: tools by their names, single markers by where they are expected."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from docking.sightings import PointFrame, Sight
from docking.tracking.types import BodyModel
from docking.types import Array, Pose


class Noise(NamedTuple):
    """`sigma_mm` of a coordinate where the camera does not say, and how near a single marker is to its point."""

    sigma_mm: float
    match_mm: float


class SeenPoints(NamedTuple):
    """Rows (k,) of the body's points, rising, where they are seen (k, 3), and with what covariance (k, 3, 3)."""

    rows: NDArray[np.intp]
    xyz_mm: Array
    cov_mm2: Array

    def without(self, left_out: set[int]) -> SeenPoints:
        """The same without some rows of the body."""
        keep = np.array([int(row) not in left_out for row in self.rows], dtype=bool)
        return SeenPoints(self.rows[keep], self.xyz_mm[keep], self.cov_mm2[keep])

    def moved(self, X: Pose) -> SeenPoints:
        """The same in another frame."""
        return SeenPoints(self.rows, X.apply(self.xyz_mm), X.R @ self.cov_mm2 @ X.R.T)


def seen_points(
    frame: PointFrame, body: BodyModel, tools: frozenset[str], expected_T_mm: Array, noise: Noise
) -> SeenPoints:
    """The body's points in a frame, in the camera's frame T; `expected_T_mm` (n, 3) is where they should be there.

    A marker is the point that it is nearest to when that is within `noise.match_mm` and no other marker is nearer.
    """
    found: dict[int, Array] = {}
    cov: dict[int, Array] = {}
    usual = noise.sigma_mm**2 * np.eye(3)
    for tool in frame.tools:
        if tool.sight is Sight.SEEN and tool.name in tools and np.all(np.isfinite(tool.p_T_mm)):
            row = body.names.index(tool.name)
            found[row] = tool.p_T_mm
            if tool.cov_T_mm2 is not None:
                cov[row] = tool.cov_T_mm2
    single = [i for i, name in enumerate(body.names) if name not in tools]
    if single and len(frame.strays_T_mm):
        gap = np.linalg.norm(frame.strays_T_mm[:, None] - expected_T_mm[single][None], axis=2)
        for k in range(len(gap)):
            j = int(np.argmin(gap[k]))
            if gap[k, j] <= noise.match_mm and int(np.argmin(gap[:, j])) == k:
                found[single[j]] = frame.strays_T_mm[k]
    rows = np.array(sorted(found), dtype=np.intp)
    places = np.array([found[int(i)] for i in rows]).reshape(-1, 3)
    return SeenPoints(rows, places, np.array([cov.get(int(i), usual) for i in rows]).reshape(-1, 3, 3))
