"""Records a move for the report: one row every few cycles, arrays kept by reference until the end."""

from __future__ import annotations

import numpy as np

from docking.motion.monitors import Watch
from docking.types import Array, Feedback, MoveResult, Trace

_Row = tuple[float, float, Array, Array, float, float, Array, float]


class Recorder:
    """Collects the trace of one move."""

    def __init__(self, watch: Watch, every: int) -> None:
        self._watch, self._every, self._count = watch, every, 0
        self._rows: list[_Row] = []
        self._last: _Row | None = None
        watch.reset_maxima()

    def add(self, feedback: Feedback, path_time_s: float) -> None:
        """Keep this cycle if its turn has come; the last one is always kept."""
        watch = self._watch
        self._last = (
            feedback.t_s,
            path_time_s,
            feedback.position_mm,
            feedback.following_error_mm,
            watch.residual_mm,
            watch.internal_force_n,
            feedback.force_n,
            watch.measured_force_n,
        )
        if self._count % self._every == 0:
            self._rows.append(self._last)
        self._count += 1

    def result(self, outcome: str, path_time_s: float, commanded_mm: Array, cause: Exception | None) -> MoveResult:
        """The finished move."""
        watch = self._watch
        if self._last is not None and self._rows[-1] is not self._last:
            self._rows.append(self._last)
        columns = [np.array(column, dtype=np.float64) for column in zip(*self._rows, strict=True)] or [
            np.zeros(0) if k in (0, 1, 4, 5, 7) else np.zeros((0, len(commanded_mm))) for k in range(8)
        ]
        return MoveResult(
            result=outcome,
            path_time_s=path_time_s,
            commanded_mm=commanded_mm,
            trace=Trace(*columns),
            max_following_error_mm=watch.max_following_mm,
            max_residual_mm=watch.max_residual_mm,
            max_internal_force_n=watch.max_internal_force_n,
            cause=cause,
        )
