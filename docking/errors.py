"""One tree of errors. Each class has a stable code; the words (en, zh) are in `docking/locale/`.

    DockingError
      LinkError     1xxx  wires and devices
      MotionError   2xxx  axes, coupling, stops
      PoseError     3xxx  measuring and fitting
      ConfigError   4xxx  files and arguments
      PlanError     5xxx  planning and convergence
      StateError    6xxx  what may happen when

Every error names the thing (`where`), the `value`, the `limit`, the `cause`; the remedy comes from the catalogue.
"""

from __future__ import annotations

import tomllib
from functools import cache
from importlib import resources
from typing import ClassVar

from docking.types import Alarm, Rejection, StopTimes

Quantity = float | int | str | None

EXIT_OK, EXIT_FAULT, EXIT_USAGE, EXIT_OUT_OF_TOLERANCE, EXIT_STOPPED = 0, 1, 2, 3, 4


@cache
def catalogue(language: str) -> dict[str, dict[str, str]]:
    """The message catalogue of one language: code -> {message, remedy}."""
    text = resources.files("docking.locale").joinpath(f"errors.{language}.toml").read_text("utf-8")
    return tomllib.loads(text)


def _plain(value: Quantity) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


class DockingError(Exception):
    """Base of all errors a user can meet."""

    code: ClassVar[int] = 0
    exit_code: ClassVar[int] = EXIT_FAULT

    def __init__(self, where: str, cause: str = "", *, value: Quantity = None, limit: Quantity = None) -> None:
        self.where, self.cause, self.value, self.limit = where, cause, value, limit
        super().__init__(self.text())

    def text(self, language: str = "en") -> str:
        """The whole message in one language: what, where, value, limit and cause."""
        message = catalogue(language)[str(self.code)]["message"]
        facts = {"where": self.where, "value": _plain(self.value), "limit": _plain(self.limit), "cause": self.cause}
        # A text ends with its cause, which not every error has.
        return message.format(**facts).rstrip()

    def remedy(self, language: str = "en") -> str:
        """What to do about it."""
        return catalogue(language)[str(self.code)]["remedy"]

    def alarm(self, t_s: float = float("nan"), language: str = "en", stop: StopTimes | None = None) -> Alarm:
        """The same facts as a noun for the journal, the report and the JSON output, with the stop that it led to."""
        text, remedy = self.text(language), self.remedy(language)
        return Alarm(self.code, text, self.where, self.value, self.limit, remedy, t_s, stop)


# 1xxx wires and devices ------------------------------------------------------------------------------------------
class LinkError(DockingError):
    """A wire or the device at its far end."""


class PortMissing(LinkError):
    code = 1001


class DeviceSilent(LinkError):
    code = 1002


class WrongIdentity(LinkError):
    code = 1003


class BadReply(LinkError):
    code = 1004


class DeviceRefused(LinkError):
    code = 1005


class LinkLost(LinkError):
    code = 1006


class ReadBackMismatch(LinkError):
    code = 1007


class WatchdogUnproved(LinkError):
    code = 1008


class LoadCellBroken(LinkError):
    code = 1009


# 2xxx motion -----------------------------------------------------------------------------------------------------
class MotionError(DockingError):
    """Axes, coupling and stops."""


class FollowingErrorTrip(MotionError):
    code = 2101


class ConsistencyTrip(MotionError):
    code = 2102


class InternalForceTrip(MotionError):
    code = 2103


class WarpTrip(MotionError):
    code = 2104


class FeedbackMissing(MotionError):
    code = 2105


class DriveFault(MotionError):
    code = 2106


class NotSettled(MotionError):
    code = 2107


class EnableFailed(MotionError):
    code = 2108


class SegmentRejected(MotionError):
    code = 2109


class OutcomeUnknown(MotionError):
    code = 2110


class BallForceTrip(MotionError):
    code = 2111


class PermissiveMissing(MotionError):
    code = 2112


class TickLate(MotionError):
    code = 2113


class AxisNotEnabled(MotionError):
    code = 2114


class MotionProcessLost(MotionError):
    code = 2115


class LeaseLost(MotionError):
    code = 2116


class StopOverdue(MotionError):
    code = 2117


class AxisStuck(MotionError):
    code = 2121


class AxisDrift(MotionError):
    code = 2122


class AxisAtLimit(MotionError):
    code = 2123


class EncoderJump(MotionError):
    code = 2124


class PassiveAxisTrip(MotionError):
    code = 2125


class MeasuredForceTrip(MotionError):
    code = 2126


class MeasuredWarpTrip(MotionError):
    code = 2127


class BallUnloaded(MotionError):
    code = 2128


class LoadCellSilent(MotionError):
    code = 2129


class DriveWarning(MotionError):
    code = 2130


class ForceRose(MotionError):
    code = 2131


class NotRelieved(MotionError):
    code = 2132


class ForeignForce(MotionError):
    code = 2133


class AxisUnreferenced(MotionError):
    code = 2134


class LoadUnexpected(MotionError):
    code = 2135


class HomingFailed(MotionError):
    code = 2136


class HomingRefused(MotionError):
    code = 2137


class EmergencyStop(MotionError):
    code = 2141


class ProtectiveStop(MotionError):
    code = 2142


class PermissiveLost(MotionError):
    code = 2143


class BrakeDisagrees(MotionError):
    code = 2144


class LiveDeviation(MotionError):
    code = 2151


class PoseUncertain(MotionError):
    code = 2152


# 3xxx measuring and fitting --------------------------------------------------------------------------------------
class PoseError(DockingError):
    """Measuring and fitting. `rejected` holds what the screening had found out about single points when it refused."""

    rejected: tuple[Rejection, ...] = ()


class TooFewPoints(PoseError):
    code = 3001


class DegenerateTargets(PoseError):
    code = 3002


class NotCongruent(PoseError):
    code = 3003


class AmbiguousSet(PoseError):
    code = 3004


class FitResidual(PoseError):
    code = 3005


class StationMoved(PoseError):
    code = 3006


class TargetLost(PoseError):
    code = 3007


class CheckPointDisagrees(PoseError):
    code = 3008


class TwoFaceDisagrees(PoseError):
    code = 3009


class UnitMixUp(PoseError):
    code = 3011


class FeatureDisagrees(PoseError):
    code = 3013


class SigmaMissing(PoseError):
    code = 3012


class ComponentDeformed(PoseError):
    code = 3014


class NoRedundancy(NotCongruent):
    code = 3015


class MarkersTooFew(PoseError):
    code = 3041


class MarkersDisagree(PoseError):
    code = 3042


class MapNotBuilt(PoseError):
    code = 3043


class NotLocalised(PoseError):
    code = 3031


class OverlayUncertain(PoseError):
    code = 3032


class DegenerateTrajectory(PoseError):
    code = 3033


class DevicePairsDisagree(PoseError):
    code = 3034


class MapFrameDiffers(PoseError):
    code = 3035


class SensorFrozen(PoseError):
    code = 3051


class TimeJumped(PoseError):
    code = 3052


class SensorSaturated(PoseError):
    code = 3053


class PointsSwapped(PoseError):
    code = 3054


class LeverArmWrong(PoseError):
    code = 3055


class ReferenceShifted(PoseError):
    code = 3056


class TrackingLost(PoseError):
    code = 3057


class AttitudeUnknown(PoseError):
    code = 3058


# 4xxx files and arguments ----------------------------------------------------------------------------------------
class ConfigError(DockingError):
    """Files and arguments."""

    exit_code = EXIT_USAGE


class FileUnreadable(ConfigError):
    code = 4001


class ConfigInvalid(ConfigError):
    """All problems of one file; `problems` holds one text a problem."""

    code = 4002

    def __init__(self, where: str, problems: tuple[str, ...]) -> None:
        self.problems = problems
        super().__init__(where, "\n  - " + "\n  - ".join(problems), value=len(problems))


class BadPointFile(ConfigError):
    code = 4003


class BadArgument(ConfigError):
    code = 4004


class FileUnwritable(ConfigError):
    code = 4005


class ExtraMissing(ConfigError):
    code = 4006


class BadTrajectory(ConfigError):
    code = 4011


class BadMesh(ConfigError):
    code = 4012


class FontMissing(ConfigError):
    code = 4013


class BadMarkerFile(ConfigError):
    code = 4014


class BadRecording(ConfigError):
    code = 4021


# 5xxx planning and convergence -----------------------------------------------------------------------------------
class PlanError(DockingError):
    """Planning and convergence."""


class StrokeExceeded(PlanError):
    code = 5001


class AxisLimitExceeded(PlanError):
    code = 5002


class BallReactionOut(PlanError):
    code = 5003


class CorrectionTooLarge(PlanError):
    code = 5004


class Diverging(PlanError):
    code = 5005


class IterationsExhausted(PlanError):
    code = 5006
    exit_code = EXIT_OUT_OF_TOLERANCE


class FrameImplausible(PlanError):
    code = 5007


class BallSwivelExceeded(PlanError):
    code = 5008


class ToleranceUnprovable(PlanError):
    code = 5009
    exit_code = EXIT_OUT_OF_TOLERANCE


class RiskTooHigh(ToleranceUnprovable):
    code = 5011


class PlanInputInvalid(PlanError):
    code = 5010


class StrainForeseen(PlanError):
    code = 5012


class MateTooNear(PlanError):
    code = 5013


class ApproachRefused(PlanError):
    code = 5014


# 6xxx what may happen when ---------------------------------------------------------------------------------------
class StateError(DockingError):
    """What may happen when."""


class EventRefused(StateError):
    code = 6001


class PlanStale(StateError):
    code = 6002


class StoppedByOperator(StateError):
    code = 6003
    exit_code = EXIT_STOPPED


class JournalCorrupt(StateError):
    code = 6004


class JournalBusy(StateError):
    code = 6005


class JournalUnwritable(StateError):
    code = 6006


class Defect(StateError):
    """An error of the program itself."""

    code = 6007
