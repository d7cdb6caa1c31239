"""The drive state machine of CiA 402 as the controller sees it: statusword -> state, (state, goal) -> controlword."""

from __future__ import annotations

from enum import Enum
from typing import Final

from docking.types import AxisState


class DriveState(Enum):
    """States of the power drive system."""

    UNKNOWN = "unknown"
    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP_ACTIVE = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"


class Goal(Enum):
    """Where the controller wants a drive to be."""

    ENABLED = "enabled"
    DISABLED = "disabled"


DISABLE_VOLTAGE: Final = 0x0000
QUICK_STOP: Final = 0x0002
SHUTDOWN: Final = 0x0006
SWITCH_ON: Final = 0x0007
DISABLE_OPERATION: Final = 0x0007
ENABLE_OPERATION: Final = 0x000F
FAULT_RESET: Final = 0x0080

MASKS: Final = (
    (0x4F, 0x00, DriveState.NOT_READY),
    (0x4F, 0x40, DriveState.SWITCH_ON_DISABLED),
    (0x6F, 0x21, DriveState.READY),
    (0x6F, 0x23, DriveState.SWITCHED_ON),
    (0x6F, 0x27, DriveState.OPERATION_ENABLED),
    (0x6F, 0x07, DriveState.QUICK_STOP_ACTIVE),
    (0x4F, 0x0F, DriveState.FAULT_REACTION),
    (0x4F, 0x08, DriveState.FAULT),
)
"""(mask, value, state) of the statusword, CiA 402-2."""


def _masked(word: int) -> DriveState:
    for mask, value, state in MASKS:
        if word & mask == value:
            return state
    return DriveState.UNKNOWN


_STATES: Final = tuple(_masked(word) for word in range(0x80))

AXIS_STATES: Final = {
    DriveState.UNKNOWN: AxisState.UNKNOWN,
    DriveState.NOT_READY: AxisState.DISABLED,
    DriveState.SWITCH_ON_DISABLED: AxisState.DISABLED,
    DriveState.READY: AxisState.DISABLED,
    DriveState.SWITCHED_ON: AxisState.DISABLED,
    DriveState.OPERATION_ENABLED: AxisState.ENABLED,
    DriveState.QUICK_STOP_ACTIVE: AxisState.STOPPING,
    DriveState.FAULT_REACTION: AxisState.FAULT,
    DriveState.FAULT: AxisState.FAULT,
}

_ENABLE: Final = {
    DriveState.SWITCH_ON_DISABLED: SHUTDOWN,
    DriveState.READY: SWITCH_ON,
    DriveState.SWITCHED_ON: ENABLE_OPERATION,
    DriveState.OPERATION_ENABLED: ENABLE_OPERATION,
    DriveState.QUICK_STOP_ACTIVE: ENABLE_OPERATION,
}


def decode(statusword: int) -> DriveState:
    """State that a statusword (16 bits) reports; UNKNOWN where no row of the table matches."""
    return _STATES[statusword & 0x7F]


def next_controlword(state: DriveState, goal: Goal, brake_closed: bool) -> int:
    """Controlword of the next transition from `state` towards `goal`.

    Disabling never takes the torque from a loaded axis: operation is disabled first, which makes the drive close its
    brake, and the power stage goes off only after the brake reports closed. A drive in quick stop is enabled where it
    stands, because every other way out of that state releases the torque at once. Faults are not reset here.
    """
    if goal is Goal.ENABLED:
        return _ENABLE.get(state, DISABLE_VOLTAGE)
    if state is DriveState.QUICK_STOP_ACTIVE and not brake_closed:
        return ENABLE_OPERATION
    if state is DriveState.OPERATION_ENABLED or (state is DriveState.SWITCHED_ON and not brake_closed):
        return DISABLE_OPERATION
    if state is DriveState.SWITCHED_ON:
        return SHUTDOWN
    return DISABLE_VOLTAGE
