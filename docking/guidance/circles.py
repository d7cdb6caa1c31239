"""The centre of a dark circle in an image, to a hundredth of a pixel.

Every edge pixel is a tangent `l = (gx, gy, -(gx x + gy y))` of the ellipse, so `l^T C l = 0` for its dual conic C: five
unknowns, linear, each pixel weighed by its gradient. The projected centre is not the centre of that ellipse; the
difference follows from the marker's plane.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from docking.guidance.types import Image
from docking.types import Array

_LEAST_RADIUS_PX = 2.5
_LEAST_CONTRAST = 25.0
"""Grey levels between the disc and the paper around it."""
_AXIS_RATIO = (0.75, 1.33)
"""Found against expected half axes: beyond it is another thing, or half a circle."""
_PASSES = 2
_BAND = (0.55, 1.45)
"""Pixels so many radii from the centre give tangents: the edge with its blur and nothing else."""
_LARGEST_WANDERING = 0.35
"""Of the radius: the expected centre is that close."""
_LARGEST_TANGENT_ERROR = 0.12
"""RMS distance of the tangents from the ellipse against its radius."""
_SECTORS = 12
_LEAST_COVERAGE = 0.75
"""Of the edge must be there: half a circle behind a cable gives a wrong centre."""


class Ellipse(NamedTuple):
    """Centre (2,) px and shape (2, 2) px^2: the points `c + sqrtm(shape) (cos, sin)`."""

    centre_px: Array
    shape_px2: Array


def circle_conic(H: Array, centre_mm: Array, radius_mm: float) -> Array:
    """Dual conic (3, 3) of the image of a circle under the homography `H` (3, 3) from its plane."""
    x, y = centre_mm
    r2 = radius_mm**2
    dual = np.array([[x * x - r2, x * y, x], [x * y, y * y - r2, y], [x, y, 1.0]])
    image: Array = H @ dual @ H.T
    image /= image[2, 2]
    return image


def ellipse_of(dual: Array) -> Ellipse:
    """Centre and shape of a dual conic with `dual[2, 2] = 1`."""
    centre = dual[:2, 2]
    return Ellipse(centre, np.outer(centre, centre) - dual[:2, :2])


def eccentricity_px(H: Array, centre_mm: Array, radius_mm: float) -> Array:
    """Centre of the ellipse minus image of the circle's centre (2,), px."""
    point = H @ np.array([*centre_mm, 1.0])
    result: Array = circle_conic(H, centre_mm, radius_mm)[:2, 2] - point[:2] / point[2]
    return result


def find_ellipse(image: Image, expected: Ellipse) -> Ellipse | None:
    """The ellipse of a dark disc near the expected one, or None where there is none that is whole."""
    found: Ellipse | None = expected
    start = expected.centre_px
    radius = _radius(expected)
    if not (radius >= _LEAST_RADIUS_PX):
        return None
    for _ in range(_PASSES):
        assert found is not None
        found = _fit(image, found)
        if found is None or not (float(np.hypot(*(found.centre_px - start))) <= _LARGEST_WANDERING * radius):
            return None
    assert found is not None
    ratio = np.sqrt(np.linalg.eigvalsh(found.shape_px2) / np.linalg.eigvalsh(expected.shape_px2))
    return found if _AXIS_RATIO[0] <= ratio.min() and ratio.max() <= _AXIS_RATIO[1] else None


def _radius(ellipse: Ellipse) -> float:
    determinant = float(np.linalg.det(ellipse.shape_px2))
    return determinant**0.25 if determinant > 0.0 else 0.0


def _window(image: Image, ellipse: Ellipse) -> tuple[Array, int, int] | None:
    """(grey values, left, top) of the pixels about an ellipse with a border for the gradient; None at the edge."""
    reach = _BAND[1] * np.sqrt(np.diag(ellipse.shape_px2)) + 2.0
    left, top = np.floor(ellipse.centre_px - reach).astype(int)
    right, bottom = np.ceil(ellipse.centre_px + reach).astype(int) + 1
    if left < 0 or top < 0 or right > image.shape[1] or bottom > image.shape[0]:
        return None
    return image[top:bottom, left:right].astype(np.float64), left, top


def _fit(image: Image, guess: Ellipse) -> Ellipse | None:
    """One pass: tangents from the band about `guess`."""
    window = _window(image, guess)
    if window is None:
        return None
    grey, left, top = window
    gx = (grey[1:-1, 2:] - grey[1:-1, :-2]) / 2.0
    gy = (grey[2:, 1:-1] - grey[:-2, 1:-1]) / 2.0
    x, y = np.meshgrid(np.arange(gx.shape[1]) + 1.0 + left, np.arange(gx.shape[0]) + 1.0 + top)
    dx, dy = x - guess.centre_px[0], y - guess.centre_px[1]
    whitener = np.linalg.inv(guess.shape_px2)
    r2 = whitener[0, 0] * dx * dx + 2.0 * whitener[0, 1] * dx * dy + whitener[1, 1] * dy * dy
    inside, around = grey[1:-1, 1:-1][r2 < 0.3], grey[1:-1, 1:-1][(r2 > 1.7) & (r2 < _BAND[1] ** 2)]
    if inside.size == 0 or not (np.median(around) - np.median(inside) >= _LEAST_CONTRAST):
        return None
    strength = np.hypot(gx, gy)
    outwards = gx * dx + gy * dy > 0.5 * strength * np.hypot(dx, dy)
    noise = 0.1 * (np.median(around) - np.median(inside))
    chosen = (r2 > _BAND[0] ** 2) & (r2 < _BAND[1] ** 2) & outwards & (strength > noise)
    return _dual_conic(gx[chosen], gy[chosen], dx[chosen], dy[chosen], guess)


def _dual_conic(gx: Array, gy: Array, dx: Array, dy: Array, guess: Ellipse) -> Ellipse | None:
    """Least squares of `l^T C l = 0`, coordinates about the guess and in units of its radius."""
    sector = np.floor((np.arctan2(dy, dx) + np.pi) / (2.0 * np.pi) * _SECTORS).astype(int) % _SECTORS
    if len(np.unique(sector)) < _LEAST_COVERAGE * _SECTORS:
        return None
    radius = _radius(guess)
    a, b, c = gx, gy, -(gx * dx + gy * dy) / radius
    rows = np.array([a * a, 2.0 * a * b, b * b, 2.0 * a * c, 2.0 * b * c]).T
    right = -c * c
    # The algebraic rows carry the square of the gradient already: strong edges count as they should.
    solution, *_ = np.linalg.lstsq(rows, right, rcond=None)
    A, B, C, D, E = solution
    centre = np.array([D, E])
    shape = np.outer(centre, centre) - np.array([[A, B], [B, C]])
    eigenvalues = np.linalg.eigvalsh(shape)
    if not (eigenvalues[0] > 0.04 and eigenvalues[1] < 9.0):
        return None
    # For a tangent, (l . c)^2 equals l^T shape l: the difference is how far the tangents miss.
    support = np.sqrt(shape[0, 0] * a * a + 2.0 * shape[0, 1] * a * b + shape[1, 1] * b * b)
    miss = (-c - (a * centre[0] + b * centre[1]) - support) / np.hypot(a, b)
    weight = a * a + b * b
    if not (float(np.sqrt(np.average(miss**2, weights=weight))) <= _LARGEST_TANGENT_ERROR + 1.0 / radius):
        return None
    return Ellipse(guess.centre_px + centre * radius, shape * radius**2)
