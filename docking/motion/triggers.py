"""What can go wrong while axes are powered, by name: the rows of the table that decides how the axes stop."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from docking.errors import DockingError


class Trigger(Enum):
    """Why a reaction is asked for."""

    FOLLOWING_ERROR = "following error over its limit"
    COUPLING = "read-backs part from a rigid figure"
    PREDICTED_FORCE = "internal force predicted from the read-backs"
    PREDICTED_WARP = "warp predicted from the read-backs"
    MEASURED_FORCE = "internal force measured by the load cells"
    MEASURED_WARP = "warp measured by the load cells"
    OVERLOAD = "a ball carries more than its rating or than expected"
    UNDERLOAD = "a ball carries less than expected"
    STUCK = "an axis does not follow its command"
    DRIFT = "an axis moves without a command"
    LIMIT_SWITCH = "an axis reports a limit"
    ENCODER_JUMP = "an encoder jumps"
    PASSIVE_AXIS = "a passive axis is not where the component takes it"
    FEEDBACK_MISSING = "an axis does not report"
    ALL_MISSING = "no axis reports"
    FORCE_MISSING = "a load cell does not report"
    DRIVE_WARNING = "a drive sends an emergency message and goes on"
    DRIVE_FAULT = "a drive is in fault"
    AXIS_OFF = "a driven axis is no longer enabled"
    NODE_RESTARTED = "a node restarted"
    HEARTBEAT_LOST = "a node's heartbeat stopped"
    FOREIGN_SENDER = "somebody else sends on the controller's identifiers"
    LINK_LOST = "the bus is gone"
    TICK_LATE = "a control cycle came late"
    LEASE_LOST = "the cell process has not renewed its lease"
    EMERGENCY_STOP = "the emergency stop is pressed"
    PERMISSIVE_LOST = "a permissive input fell"
    PROTECTIVE_STOP = "a gate or scanner asks for a stop"
    INPUTS_SILENT = "a module of inputs is silent"
    BRAKE = "a brake closes in a move"
    LIVE_DEVIATION = "the part is not where the plan has it"
    POSE_UNCERTAIN = "where the part is in its move is not known well enough"
    OPERATOR_STOP = "the operator asks for a stop"
    DEFECT = "an error of the program itself"
    STOP_OVERDUE = "a stop on the path has not ended in time"
    QUICK_STOP_OVERDUE = "a quick stop has not ended in time"


@dataclass(frozen=True)
class Finding:
    """One trigger with the error that names device, value and limit."""

    trigger: Trigger
    error: DockingError
