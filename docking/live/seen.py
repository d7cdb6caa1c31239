"""From a frame of the camera to points of the part: tools by their names, single markers by where they are expected."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from docking.sightings import PointFrame, Sight
from docking.tracking.types import BodyModel
from docking.types import Array


class SeenPoints(NamedTuple):
    """Rows (k,) of the body's points, rising, and where they are seen (k, 3)."""

    rows: NDArray[np.intp]
    xyz_mm: Array

    def without(self, left_out: set[int]) -> SeenPoints:
        """The same without some rows of the body."""
        keep = np.array([int(row) not in left_out for row in self.rows], dtype=bool)
        return SeenPoints(self.rows[keep], self.xyz_mm[keep])


def seen_points(
    frame: PointFrame, body: BodyModel, tools: frozenset[str], expected_T_mm: Array, match_mm: float
) -> SeenPoints:
    """The body's points in a frame, in the camera's frame T; `expected_T_mm` (n, 3) is where they should be there.

    A marker is the point that it is nearest to when that is within `match_mm` and no other marker is nearer to it.
    """
    found: dict[int, Array] = {}
    for tool in frame.tools:
        if tool.sight is Sight.SEEN and tool.name in tools and np.all(np.isfinite(tool.p_T_mm)):
            found[body.names.index(tool.name)] = tool.p_T_mm
    single = [i for i, name in enumerate(body.names) if name not in tools]
    if single and len(frame.strays_T_mm):
        gap = np.linalg.norm(frame.strays_T_mm[:, None] - expected_T_mm[single][None], axis=2)
        for k in range(len(gap)):
            j = int(np.argmin(gap[k]))
            if gap[k, j] <= match_mm and int(np.argmin(gap[:, j])) == k:
                found[single[j]] = frame.strays_T_mm[k]
    rows = np.array(sorted(found), dtype=np.intp)
    return SeenPoints(rows, np.array([found[int(i)] for i in rows]).reshape(-1, 3))
