"""Projection of many points at once, with its derivatives: the inner loop of the bundle adjustment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from docking.guidance.types import Camera
from docking.types import Array


class Linearised(NamedTuple):
    """o observations: `residuals` (2, o); derivatives of the projection by the camera's pose `by_frame` (2, 6, o)

    (rotation about the camera's origin on the left, then translation), by the point (2, 3, o), by log f, cx, cy, k1,
    k2 (2, 5, o).
    """

    residuals: Array
    by_frame: Array
    by_point: Array
    by_camera: Array

    @property
    def projected(self) -> Array:
        """Before residuals are formed, the first field holds the projections."""
        return self.residuals


def _distorted(camera: Camera, x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """(distorted x, y, radial factor, r^2)."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (camera.k1 + r2 * (camera.k2 + r2 * camera.k3))
    u, v = x * radial, y * radial
    if camera.p1 or camera.p2:
        u = u + 2.0 * camera.p1 * x * y + camera.p2 * (r2 + 2.0 * x * x)
        v = v + camera.p1 * (r2 + 2.0 * y * y) + 2.0 * camera.p2 * x * y
    return u, v, radial, r2


def project_rows(camera: Camera, R: Array, t: Array, points: Array) -> tuple[Array, Array]:
    """(pixels (2, o), depths (o,)) of points (3, o), each in its own camera `R` (3, 3, o), `t` (3, o)."""
    X, Y, Z = (R[i, 0] * points[0] + R[i, 1] * points[1] + R[i, 2] * points[2] + t[i] for i in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v, _, _ = _distorted(camera, X / Z, Y / Z)
    return np.array([u * camera.fx_px + camera.cx_px, v * camera.fy_px + camera.cy_px]), Z


def linearise(camera: Camera, R: Array, t: Array, points: Array) -> Linearised:
    """Projections and their derivatives; shapes as for `project_rows`."""
    turned = [R[i, 0] * points[0] + R[i, 1] * points[1] + R[i, 2] * points[2] for i in range(3)]
    X, Y, Z = (turned[i] + t[i] for i in range(3))
    w = 1.0 / Z
    x, y = X * w, Y * w
    u, v, radial, r2 = _distorted(camera, x, y)
    projected = np.array([u * camera.fx_px + camera.cx_px, v * camera.fy_px + camera.cy_px])
    slope = 2.0 * (camera.k1 + r2 * (2.0 * camera.k2 + 3.0 * camera.k3 * r2))
    p1, p2 = camera.p1, camera.p2
    cross = slope * x * y + 2.0 * (p1 * x + p2 * y)
    dux = (radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x) * camera.fx_px
    dvy = (radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x) * camera.fy_px
    duy, dvx = cross * camera.fx_px, cross * camera.fy_px
    by_frame = np.empty((2, 6, points.shape[1]))
    by_point = np.empty((2, 3, points.shape[1]))
    for a, (dx, dy) in enumerate(((dux, duy), (dvx, dvy))):
        row = (dx * w, dy * w, -(dx * x + dy * y) * w)
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            # d(R p) = w x (R p): the row's product with the cross product is another cross product.
            by_frame[a, i] = turned[j] * row[k] - turned[k] * row[j]
            by_frame[a, 3 + i] = row[i]
            by_point[a, i] = row[0] * R[0, i] + row[1] * R[1, i] + row[2] * R[2, i]
    zero, one = np.zeros_like(x), np.ones_like(x)
    fx, fy = camera.fx_px, camera.fy_px
    by_camera = np.array(
        [
            [u * fx, one, zero, x * r2 * fx, x * r2 * r2 * fx],
            [v * fy, zero, one, y * r2 * fy, y * r2 * r2 * fy],
        ]
    )
    return Linearised(projected, by_frame, by_point, by_camera)
