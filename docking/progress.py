"""Where a docking stands: what is known, what has been done."""

from __future__ import annotations

from dataclasses import dataclass, field

from docking.planning import Attempt, Scene
from docking.types import Alarm, Array, FeatureErrors, Fit, MoveResult, Plan, StopTimes

RAISING = ("lift", "level")
"""Kinds of the moves before the first alignment."""


@dataclass(frozen=True, eq=False)
class Executed:
    """A plan that has been run to `path_time_s`, for the `stage` (index) that the component stood at before; with the
    fit and the scene that it was planned from."""

    plan: Plan
    path_time_s: float
    stage: int
    fit: Fit | None = None
    scene: Scene | None = None


@dataclass
class Standing:
    """Where the axes of any run stand, how its last move ended, and what went wrong."""

    commanded_mm: Array | None = None
    plan: Plan | None = None
    result: MoveResult | None = None
    alarms: list[Alarm] = field(default_factory=list)


@dataclass
class Progress(Standing):
    """Where a docking stands. `way` is what a retreat would go back: the moves made, oldest first; `back` the moves of
    a retreat that are planned, the next one first, `agreed` those among them that need no further confirmation."""

    stage: int = 0
    corrections: int = 0
    passes: int = 0
    moves: int = 0
    X_WC: Fit | None = None
    fitted_at_s: float = float("nan")
    errors: FeatureErrors | None = None
    kind: str = "align"
    stood_at: int = 0
    tared: bool = False
    scene: Scene | None = None
    back: tuple[Plan, ...] = ()
    agreed: tuple[Plan, ...] = ()
    way: list[Executed] = field(default_factory=list)
    history: list[Attempt] = field(default_factory=list)
    rejected: set[str] = field(default_factory=set)
    max_residual_mm: float = 0.0
    max_internal_force_n: float = 0.0

    def made(self, *kinds: str) -> int:
        """Moves of these kinds on the way."""
        return sum(step.plan.kind in kinds for step in self.way)

    @property
    def raised_only(self) -> bool:
        """True until the component is first moved for the mate: it was lifted and levelled at the most."""
        return self.made(*RAISING) == len(self.way)

    def moved(self, plan: Plan, result: MoveResult) -> None:
        """Keep how a move ended. A move along the way is added to it; one back along it is taken off, and leaves
        everything to be measured anew at the stage that it led back to."""
        self.moves, self.passes, self.result = self.moves + 1, 0, result
        self.commanded_mm = result.commanded_mm
        self.max_residual_mm = max(self.max_residual_mm, result.max_residual_mm)
        self.max_internal_force_n = max(self.max_internal_force_n, result.max_internal_force_n)
        if plan.kind != "retreat":
            self.way.append(Executed(plan, result.path_time_s, self.stood_at, self.X_WC, self.scene))
            return
        undone = self.way.pop()
        self.stage, self.corrections, self.history, self.X_WC = undone.stage, 0, [], None


def stop_of(result: MoveResult | None, error: Exception) -> StopTimes | None:
    """The times of the stop that `error` led to; None where it did not end the last move."""
    return result.stop if result is not None and result.cause is error else None
