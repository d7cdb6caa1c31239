"""Axes that hold a force: do their load cells show it?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from docking.errors import BallForceTrip, BallUnloaded
from docking.kinematics import Positioners
from docking.motion.monitors.limits import Margins
from docking.motion.triggers import Finding, Trigger
from docking.types import Array, AxisState, Feedback


class HeldForces:
    """Judges the load cells of force-controlled axes against set force and tolerance, once a reading.

    Two readings in a row must show a violation. While such an axis is not enabled it holds its position, for example
    after a quick stop, and its force is whatever the part makes of it.
    """

    def __init__(self, positioners: Positioners, weighed: NDArray[np.bool_], margins: Margins) -> None:
        self._axes, self._margins = positioners.axes, margins
        self._holds = np.flatnonzero(positioners.followers & weighed).tolist()
        self._held_n = positioners.held_n[self._holds]
        self._tolerance_n = positioners.held_tolerance_n[self._holds]
        self._seen: Array = np.full(len(self._holds), np.nan)
        self._before = False
        self._finding: Finding | None = None

    def judge(self, feedback: Feedback) -> Finding | None:
        """The first axis whose force is outside its tolerance; a reading counts once, however often it is shown."""
        if not self._holds:
            return None
        if any(feedback.states[k] is not AxisState.ENABLED for k in self._holds):
            self._before, self._finding = False, None
            return None
        reads = feedback.force_n[self._holds]
        if not (reads == self._seen).all():
            self._seen = reads
            found = self._judged(reads)
            self._finding = found if self._before else None
            self._before = found is not None
        return self._finding

    def _judged(self, reads_n: Array) -> Finding | None:
        off = np.abs(reads_n - self._held_n) / self._tolerance_n
        if self._margins.note("held_force", float(off.max())):
            return None
        k = int(np.argmin(off <= 1.0))
        axis, value = self._axes[self._holds[k]], float(reads_n[k])
        held, tolerance = float(self._held_n[k]), float(self._tolerance_n[k])
        cause = f"It shall hold {held:g} +- {tolerance:g} N."
        if value < held:
            return Finding(Trigger.UNDERLOAD, BallUnloaded(axis, cause, value=value, limit=held - tolerance))
        return Finding(Trigger.OVERLOAD, BallForceTrip(axis, cause, value=value, limit=held + tolerance))
