"""Rauch-Tung-Striebel smoothing of the error-state filter, for logs: every state from all data, later ones included."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from docking.tracking.inertial_core import Layout, Navigation
from docking.types import Array


class _Step(NamedTuple):
    """One node: state and covariance after its measurements; `phi`, `cov_before` of the step that led to it (None at a
    beginning), `dx` what its measurements added."""

    nav: Navigation
    cov: Array
    phi: Array | None
    cov_before: Array
    dx: Array


class Tape:
    """What the filter did, step by step."""

    def __init__(self) -> None:
        self._steps: list[_Step] = []

    def begin(self, nav: Navigation, cov: Array) -> None:
        """A first node, or one that owes nothing to those before."""
        self._steps.append(_Step(nav, cov, None, cov, np.zeros(len(cov))))

    def step(self, nav: Navigation, phi: Array, cov: Array) -> None:
        """A prediction to a later time."""
        self._steps.append(_Step(nav, cov, phi, cov, np.zeros(len(cov))))

    def update(self, nav: Navigation, cov: Array, dx: Array) -> None:
        """A measurement at the time of the newest node."""
        last = self._steps[-1]
        self._steps[-1] = last._replace(nav=nav, cov=cov, dx=last.dx + dx)

    def back_to(self, t_s: float) -> None:
        """Forget what came after `t_s`."""
        while len(self._steps) > 1 and self._steps[-1].nav.t_s > t_s:
            self._steps.pop()

    def smoothed(self, layout: Layout) -> list[tuple[Navigation, Array]]:
        """Every node's state and covariance (n, n) from all data, oldest first.

        e_k = P_k Phi^T M_k+1^-1 (e_k+1 + dx_k+1): the error of a filtered state is that of the next prediction brought
        back, and the next prediction is off by what its measurements added and what smoothing adds.
        """
        result: list[tuple[Navigation, Array]] = []
        later: _Step | None = None
        e, cov = np.zeros(layout.size), np.zeros((layout.size, layout.size))
        for node in reversed(self._steps):
            if later is None or later.phi is None:
                e, cov = np.zeros(layout.size), node.cov
            else:
                gain = np.linalg.solve(later.cov_before, later.phi @ node.cov).T
                e = gain @ (e + later.dx)
                cov = node.cov + gain @ (cov - later.cov_before) @ gain.T
            result.append((node.nav.moved(e, layout), cov))
            later = node
        result.reverse()
        return result
