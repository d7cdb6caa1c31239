"""The nouns that flow through the house: points -> screened -> fit -> correction -> plan -> set-points -> feedback.

All are frozen; arrays are float64 and read-only. Lengths are mm, angles rad, times s, forces N.
Frames: W assembly (cell), T tracker station, C component, M mate. `X_AB` is the pose of frame B in frame A,
so `p_A = X_AB.apply(p_B)` and `X_AC = X_AB @ X_BC`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def readonly(values: ArrayLike) -> Array:
    """Return a read-only float64 copy of `values`."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


class _Frozen:
    """Base of the nouns: every ndarray field becomes a read-only float64 copy."""

    __slots__ = ()

    def __post_init__(self) -> None:
        for item in fields(self):  # type: ignore[arg-type]
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray):
                object.__setattr__(self, item.name, readonly(value))


@dataclass(frozen=True, eq=False)
class Pose(_Frozen):
    """A rigid pose X_AB: rotation `R` (3, 3), translation `t_mm` (3,): `p_A = R p_B + t`."""

    R: Array
    t_mm: Array

    @staticmethod
    def identity() -> Pose:
        return Pose(np.eye(3), np.zeros(3))

    def matrix(self) -> Array:
        """Homogeneous (4, 4) matrix."""
        m = np.eye(4)
        m[:3, :3] = self.R
        m[:3, 3] = self.t_mm
        return m

    def apply(self, points_mm: ArrayLike) -> Array:
        """Transform points (..., 3) from frame B to frame A."""
        result: Array = np.asarray(points_mm, dtype=np.float64) @ self.R.T + self.t_mm
        return result

    def inverse(self) -> Pose:
        return Pose(self.R.T, -self.R.T @ self.t_mm)

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.R @ other.R, self.R @ other.t_mm + self.t_mm)


@dataclass(frozen=True, eq=False)
class Reading(_Frozen):
    """One tracker measurement of one target, in the station frame T.

    `cov_mm2` (3, 3) is the instrument's covariance of this reading; `degraded` marks a usable reading whose
    accuracy the instrument does not guarantee. `face` is 1 or 2 (two-face instruments).
    """

    target: str
    p_T_mm: Array
    cov_mm2: Array
    t_s: float
    face: int = 1
    degraded: bool = False


@dataclass(frozen=True, eq=False)
class Points(_Frozen):
    """Named points in one frame: `xyz_mm` (n, 3) with `cov_mm2` (n, 3, 3).

    A point measured in several passes appears in several rows with the same name; `passes` (n,) is the row's pass.
    """

    names: tuple[str, ...]
    xyz_mm: Array
    cov_mm2: Array
    passes: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class Rejection:
    """A point left out of the fit: which, why (`reason` is a short stable word), and the numbers in `detail`.

    `partner` is the point at whose place it was measured, where that is what happened.
    """

    name: str
    reason: str
    detail: str = ""
    partner: str = ""


@dataclass(frozen=True, eq=False)
class Screened(_Frozen):
    """Point pairs that passed the screening, one row a name.

    `nominal_mm` (n, 3) in N, `measured_mm` (n, 3) in M (passes averaged), with covariances (n, 3, 3).
    `rejected` are whole points; `dropped` are single readings left out of a point that is still used.
    """

    names: tuple[str, ...]
    nominal_mm: Array
    nominal_cov_mm2: Array
    measured_mm: Array
    measured_cov_mm2: Array
    rejected: tuple[Rejection, ...] = ()
    dropped: tuple[Rejection, ...] = ()


@dataclass(frozen=True, eq=False)
class Fit(_Frozen):
    """A fitted pose X_MN (nominal frame N into measured frame M) with its uncertainty.

    `cov` (6, 6) is the covariance of the left perturbation [rotation_rad (3), translation_mm (3)] in M taken about
    `pivot_mm` (3,) in M: a point p in M moves by `w x (p - pivot) + d`. `residuals_mm` (n, 3) = measured - fitted.
    `expansion` is the fitted uniform expansion of the body about the pivot (0 = rigid fit); `expansion_cov` (7,) is
    its covariance with the six pose parameters and its variance, None where it was not estimated.
    """

    X_MN: Pose
    cov: Array
    pivot_mm: Array
    names: tuple[str, ...]
    residuals_mm: Array
    rms_mm: float
    max_mm: float
    method: str
    iterations: int
    chi2: float
    dof: int
    rejected: tuple[Rejection, ...] = ()
    expansion: float = 0.0
    expansion_cov: Array | None = None

    @property
    def redundancy(self) -> int:
        """Points beyond the three that define a pose: 0 means that nothing in the fit can prove it wrong."""
        return max(len(self.names) - 3, 0)

    def predict(self, p_N_mm: ArrayLike) -> Array:
        """Where the points `p_N_mm` (..., 3) of the fitted body are in M, its expansion about the pivot included."""
        q = self.X_MN.apply(p_N_mm)
        result: Array = q + self.expansion * (q - self.pivot_mm)
        return result

    def grown(self, p_N_mm: ArrayLike) -> Array:
        """Points `p_N_mm` (..., 3) of the fitted body in N with its expansion: `X_MN` takes them to `predict`."""
        return self.X_MN.inverse().apply(self.predict(p_N_mm))

    def whole_cov(self) -> Array:
        """Covariance (7, 7) of pose and expansion; zero in its last row where the expansion was not estimated."""
        cov = np.zeros((7, 7))
        cov[:6, :6] = self.cov
        if self.expansion_cov is not None:
            cov[6, :] = cov[:, 6] = self.expansion_cov
        return cov


RISK_LIMIT = 0.025
"""Largest probability, given what was measured, that any docking feature of an accepted docking is out of tolerance."""


@dataclass(frozen=True, eq=False)
class FeatureErrors(_Frozen):
    """Docking features, component against mate, in W.

    `error_mm` (n, 3) component minus mate; `sigma_mm` (n,) sqrt of the largest eigenvalue of that difference's
    covariance (component fit, mate fit, drift, nominal, thermal); `tolerance_mm` (n,). `risk` is the probability that
    at least one feature is outside its tolerance (specific risk, JCGM 106): near e = 0 a deviation in three directions
    exceeds 2 sigma more often than e + 2 sigma suggests.
    """

    names: tuple[str, ...]
    error_mm: Array
    sigma_mm: Array
    tolerance_mm: Array
    risk: float = float("nan")

    @property
    def norm_mm(self) -> Array:
        result: Array = np.linalg.norm(self.error_mm, axis=1)
        return result

    def worst(self) -> int:
        """Index of the feature with the largest e + 2 sigma (ISO 14253-1 decision rule, k = 2)."""
        return int(np.argmax(self.norm_mm + 2.0 * self.sigma_mm))

    def accepted(self) -> bool:
        """True when every e + 2 sigma is inside its tolerance and the risk inside its limit; NaN fails."""
        inside = bool(np.all(self.norm_mm + 2.0 * self.sigma_mm <= self.tolerance_mm))
        return inside and self.risk <= RISK_LIMIT


@dataclass(frozen=True, eq=False)
class Correction(_Frozen):
    """A rigid displacement of the component in W about `pivot_W_mm`: rotate by `rotvec_rad`, shift by `shift_mm`."""

    pivot_W_mm: Array
    rotvec_rad: Array
    shift_mm: Array


@dataclass(frozen=True, eq=False)
class PlanBounds(_Frozen):
    """What the pre-flight foresees of a plan; (m,) in the order of its axes.

    `peak_mm_s` (m,); `quick_stop_s` in which all axes ramp down together with a_quick. If an axis jams at its peak
    speed the worst ball parts by `jam_mm` (m,) and feels `jam_n` (m,), and the part is warped by `jam_warp_n` (m,); if
    it ramps down by itself, the worst ball parts by `ramp_mm` (m,).
    `residual_mm`, `force_n`, `warp_n`: largest at any instant from the devices' straight interpolation between two rows
    and from their start and clock differences. `clearance_mm` from the mate where it least exceeds what is asked, at
    path coordinate `clearance_s`, asked there `clearance_asked_mm`, all NaN where nothing is declared. `limits`: each
    limit with the share of it that the plan uses, largest first: the first one sets the speed.
    """

    peak_mm_s: Array
    quick_stop_s: float
    jam_mm: Array
    jam_n: Array
    jam_warp_n: Array
    ramp_mm: Array
    residual_mm: float
    force_n: float
    warp_n: float
    clearance_mm: float
    clearance_asked_mm: float
    clearance_s: float
    duration_s: float
    limits: tuple[tuple[str, float], ...]


@dataclass(frozen=True, eq=False)
class Plan(_Frozen):
    """A checked move as a table: what the positioners do when the path is run at full rate.

    `t_s` (n,) path time on an even grid of `period_s`; `q_mm` (n, m) axis positions in the order of `axes`
    (driven and passive); `s` (n,) the scalar path coordinate 0..1. `plan_hash` identifies the content.
    `margins`: for each axis the least room to the stroke's margin (mm) and to its speed limit (mm/s).
    `bounds` is what the pre-flight foresees, None only of a table that was not planned. `requires` are the inputs that
    have to be given while it runs, as far as they are wired. `duration_s` is t_s[-1]. All
    stops and holds change the rate at which path time runs, never the path.
    """

    plan_id: int
    plan_hash: str
    stage: str
    kind: str
    axes: tuple[str, ...]
    period_s: float
    t_s: Array
    s: Array
    q_mm: Array
    correction: Correction
    chord_error_mm: float
    rate_slew_per_s: float
    speed_limited_by: str
    margins: tuple[tuple[str, float, float], ...] = ()
    bounds: PlanBounds | None = None
    requires: tuple[str, ...] = ()

    @property
    def duration_s(self) -> float:
        return float(self.t_s[-1])

    @property
    def displacement_mm(self) -> Array:
        result: Array = self.q_mm[-1] - self.q_mm[0]
        return result


class AxisState(Enum):
    """What a positioner axis reports of itself, whatever its bus."""

    UNKNOWN = "unknown"
    DISABLED = "disabled"
    ENABLED = "enabled"
    STOPPING = "stopping"
    FAULT = "fault"


class FaultKind(Enum):
    """What `Feedback.fault` is about."""

    DRIVE_FAULT = "the drive is in fault"
    DRIVE_WARNING = "the drive complains and goes on"
    NODE_RESTARTED = "the device restarted or left its operational state"
    HEARTBEAT_LOST = "the device fell silent"
    FOREIGN_SENDER = "somebody else commands the device"
    STUCK = "an axis does not follow its command"
    FOLLOWING_ERROR = "an axis hangs back too far"
    LIMIT_SWITCH = "an axis came to its limit switch"


@dataclass(frozen=True, eq=False)
class Feedback:
    """One read-back of all axes (order of the cell file). Not copied: made once a cycle by a driver.

    `position_mm` (m,), `following_error_mm` (m,), `force_n` (m,) load on each axis along itself (NaN where no load
    cell); `age_cycles` (m,) cycles since each axis last reported. `fault` is None or (axis, code, text) of the first
    axis in fault and `fault_kind` says what about; `at_limit` (m,) are the axes that report a limit, None where none
    does.

    Of devices that play a queue: `path_times_s` (m,) the path time that each position belongs to, `path_time_s` the
    least of them, `path_skew_s` by how much the path times are apart for certain at one instant. NaN, None and 0 where
    the host streams.
    """

    t_s: float
    position_mm: Array
    following_error_mm: Array
    force_n: Array
    states: tuple[AxisState, ...]
    age_cycles: Array
    path_time_s: float = float("nan")
    fault: tuple[str, int, str] | None = None
    at_limit: NDArray[np.bool_] | None = None
    fault_kind: FaultKind = FaultKind.DRIVE_FAULT
    path_times_s: Array | None = None
    path_skew_s: float = 0.0


@dataclass(frozen=True)
class InputState:
    """What the wired inputs of a cell say, by name.

    `given`: True while the condition holds (given, pressed, closed), None where its module is silent. `temperature_c`
    in deg C, NaN where the sensor says nothing. `silent` are the modules that are not heard. Empty where nothing is
    wired.
    """

    given: dict[str, bool | None] = field(default_factory=dict)
    temperature_c: dict[str, float] = field(default_factory=dict)
    silent: tuple[str, ...] = ()


@dataclass(frozen=True)
class Identity:
    """Who answered on a wire: `where` (tracker, axis A.X, positioner A) and what it says of itself."""

    where: str
    vendor: str
    product: str
    serial: str
    firmware: str


@dataclass(frozen=True, eq=False)
class Trace:
    """What was recorded during a move, one row a recorded cycle (n): times, positions and following errors (n, m),
    consistency residual (n,), predicted internal force (n,), measured force along each axis (n, m; NaN = none), largest
    measured internal force at a ball since the move was loaded (n,; NaN = none)."""

    t_s: Array
    path_time_s: Array
    position_mm: Array
    following_error_mm: Array
    residual_mm: Array
    internal_force_n: Array
    force_n: Array
    measured_force_n: Array


@dataclass(frozen=True)
class StopTimes:
    """A stop in loop time: the finding or request that asked for it, the first command that differs for it, and when
    the read-backs showed all axes at rest. NaN where that was not seen."""

    found_s: float
    commanded_s: float
    rest_s: float


@dataclass(frozen=True, eq=False)
class MoveResult:
    """How a move ended: `done`, `stopped` (on request, on the path) or `fault` (with its `cause`).

    `path_time_s` is where on the plan it ended, `commanded_mm` (m,) the last commanded axis positions, `stop` the times
    of the stop that ended it, None where the plan ran to its end. `reaction` names how all axes were stopped ("" where
    nothing stopped them), `also` what was found behind the first cause.
    """

    result: str
    path_time_s: float
    commanded_mm: Array
    trace: Trace
    max_following_error_mm: Array
    max_residual_mm: float
    max_internal_force_n: float
    cause: Exception | None = None
    stop: StopTimes | None = None
    reaction: str = ""
    also: tuple[Exception, ...] = ()


@dataclass(frozen=True)
class Alarm:
    """A fault as a person sees it and as the journal keeps it."""

    code: int
    message: str
    where: str = ""
    value: float | str | None = None
    limit: float | str | None = None
    remedy: str = ""
    t_s: float = field(default=float("nan"))
    stop: StopTimes | None = None
