"""The drive state machine of CiA 402 as a simulated drive has it: states, and where a controlword leads."""

from __future__ import annotations

from enum import IntEnum


class Stage(IntEnum):
    """States, each with the statusword bits 0..6 that report it."""

    SWITCH_ON_DISABLED = 0x40
    READY = 0x21
    SWITCHED_ON = 0x23
    OPERATION = 0x27
    QUICK_STOP = 0x07
    FAULT_REACTION = 0x0F
    FAULT = 0x08


def transition(stage: Stage, word: int) -> Stage | None:
    """Next state for a controlword, None to stay."""
    enable, off = word & 0x0F == 0x0F, not word & 2
    halt, shutdown, on = word & 6 == 2, word & 7 == 6, word & 0x0F == 7
    if stage is Stage.SWITCH_ON_DISABLED:
        return Stage.READY if shutdown else None
    if stage in (Stage.READY, Stage.SWITCHED_ON) and (off or halt):
        return Stage.SWITCH_ON_DISABLED
    if stage is Stage.READY:
        return Stage.SWITCHED_ON if on or enable else None
    if stage is Stage.SWITCHED_ON:
        return Stage.READY if shutdown else Stage.OPERATION if enable else None
    if stage is Stage.OPERATION:
        if off or halt:
            return Stage.SWITCH_ON_DISABLED if off else Stage.QUICK_STOP
        return Stage.READY if shutdown else Stage.SWITCHED_ON if on else None
    if stage is Stage.QUICK_STOP:
        return Stage.SWITCH_ON_DISABLED if off else Stage.OPERATION if enable else None
    return None
