"""How far a figure of sockets is from one rigid body, by NumPy alone: nothing of the controller's own mathematics."""

from __future__ import annotations

import numpy as np

from docking.types import Array


def sockets_mm(origins_W_mm: Array, axes_W: Array, q_mm: Array) -> Array:
    """Socket centres (n, k, 3) of axis positions `q_mm` (n, 3 k): o_i + A_i q_i."""
    rows = np.atleast_2d(q_mm)
    return origins_W_mm + np.einsum("kij,nkj->nki", axes_W, rows.reshape(len(rows), -1, 3))


def rigid_gap_mm(figure_mm: Array, moved_mm: Array) -> Array:
    """Largest distance (n,) that is left when `figure_mm` (k, 3) is laid rigidly on each of `moved_mm` (n, k, 3)."""
    start = figure_mm - figure_mm.mean(axis=0)
    there = moved_mm - moved_mm.mean(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(np.einsum("ki,nkj->nij", start, there))
    sign = np.ones((len(moved_mm), 3))
    sign[:, 2] = np.sign(np.linalg.det(u @ vt))
    turn = np.einsum("nij,nj,njk->nik", u, sign, vt)
    left = np.einsum("ki,nij->nkj", start, turn) - there
    result: Array = np.linalg.norm(left, axis=2).max(axis=1)
    return result


def distance_gap_mm(figure_mm: Array, moved_mm: Array) -> Array:
    """Largest change (n,) of a distance between two sockets."""

    def distances(points: Array) -> Array:
        result: Array = np.linalg.norm(points[..., :, None, :] - points[..., None, :, :], axis=-1)
        return result

    change: Array = np.abs(distances(moved_mm) - distances(figure_mm)).max(axis=(1, 2))
    return change


def path_gap_mm(table_mm: Array, q_mm: Array) -> Array:
    """Distance (n,) in axis space from each of `q_mm` (n, m) to the polygon through the rows of `table_mm` (r, m)."""
    start, chord = table_mm[:-1], np.diff(table_mm, axis=0)
    length2 = np.einsum("rm,rm->r", chord, chord)
    keep = length2 > 0.0
    start, chord, length2 = start[keep], chord[keep], length2[keep]
    gaps = []
    for point in np.atleast_2d(q_mm):
        along = np.clip(np.einsum("rm,rm->r", point - start, chord) / length2, 0.0, 1.0)
        gaps.append(np.linalg.norm(point - start - along[:, None] * chord, axis=1).min())
    return np.array(gaps)
