"""What the procedure of a docking needs of the files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from docking.approach import Approach
from docking.kinematics import Positioners
from docking.motion.settle import SettleSettings
from docking.planning import GuardSettings, PlanSettings
from docking.planning.raising import Raising
from docking.planning.relief import LoadCellErrors
from docking.survey import Nominals, SurveySettings
from docking.types import InputState, Pose


@dataclass(frozen=True, eq=False)
class ProcedureSettings:
    """What the procedure needs of the files, besides the stages' own settings.

    `enabling` are the devices that a person holds in every move; `measured` says what the inputs change; `cells` what
    the load cells may be wrong by; `warp_limit_n` of the lifted part; no ball's force may rise by more than
    `retreat_rise_n` on the way back.
    """

    positioners: Positioners
    plan: PlanSettings
    guard: GuardSettings
    settle: SettleSettings
    X_WT: Pose
    X_WM: Pose
    period_s: float
    linear_interpolation: bool
    drift_mm_per_s: float
    target_residual_mm: float
    rms_limit_mm: float | None
    plausibility_mm: float
    fit_age_s: float
    raising: Raising
    cells: LoadCellErrors
    warp_limit_n: float
    retreat_rise_n: float
    enabling: tuple[str, ...] = ()
    measured: Callable[[InputState], Measured | None] = lambda state: None


@dataclass(frozen=True, eq=False)
class Measured:
    """What temperature sensors change: nominal points, fits and geometry; `records` says by how much."""

    nominals: Nominals
    survey: SurveySettings
    approach: Approach
    records: tuple[dict[str, Any], ...]
