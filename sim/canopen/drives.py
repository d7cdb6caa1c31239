"""The simulated power stages: CiA 402 states, brakes, set-point generators, monitoring; all axes of a cell at once.

One cycle of an undisturbed move touches whole arrays only. Axes whose brake moves or that ramp down by themselves are
worked one by one; `busy` says that there are such axes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from docking.types import Array
from sim.canopen.homing import HOMING, Homing
from sim.canopen.parameters import BoolArray, ForceTargets, Parameters
from sim.canopen.profile import PP, Profile
from sim.canopen.settings import DriveSettings
from sim.canopen.stages import Stage, transition

__all__ = ["CSP", "CST", "FOLLOWING_ERROR", "HOST_LOST", "IP", "SYNC_LOST", "Drives", "Stage"]

IP: Final = 7
CSP: Final = 8
CST: Final = 10
FOLLOWING_ERROR: Final = 0x8611
HOST_LOST: Final = 0x8130
SYNC_LOST: Final = 0x8700

_FOLLOWS, _WINDOW, _BRAKE, _LIMIT = 1 << 12, 1 << 13, 1 << 14, 1 << 11
_INTERPOLATE = 1 << 4
_OWN_BITS = 1 << 10 | 1 << 12 | 1 << 13
_REMOTE_AND_VOLTAGE = 1 << 9 | 1 << 4


_POWERED = (Stage.OPERATION, Stage.QUICK_STOP, Stage.FAULT_REACTION)
_RAMPING = (Stage.QUICK_STOP, Stage.FAULT_REACTION)


class Drives:
    """m power stages. `emergency(index, code)` is called when one trips."""

    def __init__(
        self, start_mm: Array, cycle_s: float, settings: DriveSettings, emergency: Callable[[int, int], None]
    ) -> None:
        count = len(start_mm)
        self.parameters = Parameters(count)
        self.cycle_s = cycle_s
        self.stages: list[Stage] = [Stage.SWITCH_ON_DISABLED] * count
        self.controlwords: list[int] = [0] * count
        self.modes: list[int] = [0] * count
        self.powered: BoolArray = np.zeros(count, np.bool_)
        self.braked: BoolArray = np.ones(count, np.bool_)
        self.following: BoolArray = np.zeros(count, np.bool_)
        self.forces = ForceTargets(count, self.parameters)
        self.profile = Profile(count)
        self.targets: Array = start_mm.copy()
        self.homing = Homing(count, settings.homed, settings.zero_off_mm)
        self.statuswords: NDArray[np.uint16] = np.zeros(count, np.uint16)
        self.error_codes: list[int] = [0] * count
        self.busy = False
        self.changed = True
        self._settings, self._emergency = settings, emergency
        self._start: Array = start_mm.copy()
        self._goal: Array = start_mm.copy()
        self._now: Array = start_mm.copy()
        self._speed: Array = np.zeros(count)
        self._standing_mm: Callable[[], Array] = lambda: self._now
        self._limited: BoolArray = np.zeros(count, np.bool_)
        self._switched: BoolArray = np.zeros(count, np.bool_)
        self._seized_brakes: dict[int, bool] = {}
        self._own_stops: set[int] = set()
        self._brake_due: dict[int, tuple[float, bool]] = {}
        self._over_since: dict[int, float] = {}
        self._moving_limit = False
        for index in range(count):
            self._report(index)

    # set-points --------------------------------------------------------------------------------------------------
    def advance(self, t_s: float, since_s: float, dt_s: float, standing_mm: Callable[[], Array]) -> Array:
        """Set-points (m,) reached at `t_s`, `since_s` after the last SYNC and `dt_s` after the last step.

        A drive reaches its target one cycle after the SYNC that brought it, in a straight line. `standing_mm()` gives
        the encoder positions, asked only while something special happens.
        """
        self._standing_mm = standing_mm
        if self.forces.pressing.any() and dt_s > 0.0:
            self.forces.note(standing_mm(), dt_s)
        if since_s >= 0.75 * self.cycle_s:
            self._now = self._goal
        else:
            self._now = self._start + (self._goal - self._start) * (since_s / self.cycle_s)
        if self.busy:
            self._work(t_s, dt_s, standing_mm())
        return self._now

    def note_targets(self, rows: NDArray[np.intp], target_mm: Array) -> None:
        """Targets (r,) that an edge of the controlword at the same SYNC may make drives go to by themselves."""
        if PP in self.modes:
            self.targets[rows] = target_mm - self.homing.shift_mm[rows]

    def latch(self, rows: NDArray[np.intp], target_mm: Array) -> None:
        """Take targets (r,) for the axes `rows` (r,) at a SYNC; axes that do not follow keep standing."""
        limits = self.parameters
        wanted = np.minimum(np.maximum(target_mm, limits.low_mm[rows]), limits.high_mm[rows])
        if self._moving_limit or wanted.tobytes() != target_mm.tobytes():
            self._note_limits(rows, wanted != target_mm)
        if self.homing.shift_mm.any():
            wanted = wanted - self.homing.shift_mm[rows]
        goal = self._now.copy()
        active = self.following[rows]
        goal[rows] = wanted if active.all() else np.where(active, wanted, goal[rows])
        self._start, self._goal = self._now, goal

    def stay(self) -> None:
        """A SYNC without anything different: the goal stays, also for a SYNC that came early."""
        self._start = self._now

    def coast(self, t_s: float, dt_s: float, standing_mm: Callable[[], Array]) -> Array:
        """Set-points of a step that the drives take on their own, without SYNC."""
        if self._settings.sync_loss == "extrapolate" and self.following.any():
            step = (self._goal - self._start) * (dt_s / self.cycle_s)
            limits = self.parameters
            ahead = np.minimum(np.maximum(self._now + step, limits.low_mm), limits.high_mm)
            now = np.where(self.following, ahead, self._now)
            self._start, self._goal, self._now = now - (self._goal - self._start), now, now
        else:
            self.stay()
        if self.busy:
            self._work(t_s, dt_s, standing_mm())
        return self._now

    def monitor(self, t_s: float, following_error_mm: Array) -> None:
        """Trip every following axis whose error stays outside its window for longer than its time."""
        over = (np.abs(following_error_mm) > self.parameters.window_mm) & self.following
        if not self._over_since and not over.any():
            return
        for index in range(len(over)):
            if not over[index]:
                self._over_since.pop(index, None)
                continue
            since = self._over_since.setdefault(index, t_s)
            if t_s - since >= self.parameters.window_s[index]:
                self._over_since.pop(index)
                self.trip(index, FOLLOWING_ERROR, t_s)

    # states ------------------------------------------------------------------------------------------------------
    def select(self, index: int, mode: int) -> None:
        """Change the mode of operation of one axis (6060h)."""
        if mode != self.modes[index]:
            self.modes[index] = mode
            self._report(index)

    def control(self, index: int, word: int, t_s: float) -> None:
        """Apply a controlword (CiA 402 transitions 2 to 16)."""
        before, self.controlwords[index] = self.controlwords[index], word
        stage = self.stages[index]
        if stage is Stage.FAULT:
            if word & ~before & 0x80:
                self.error_codes[index] = 0
                self._emergency(index, 0)
                self._enter(index, Stage.SWITCH_ON_DISABLED, t_s)
            return
        target = transition(stage, word)
        if index in self._own_stops:
            # A drive that has stopped by itself wants to be told anew, not to hear the same word once more.
            if word == before:
                return
            self._own_stops.discard(index)
        if target is Stage.QUICK_STOP:
            self.quick_stop(index, t_s)
        elif target is not None:
            self._enter(index, target, t_s)
        elif self.modes[index] == IP and not word & _INTERPOLATE and self.following[index]:
            self._rest(index)
        elif self.modes[index] == PP and stage is Stage.OPERATION:
            self.profile.control(index, before, word, float(self.targets[index]))
            self._report(index)
        elif self.modes[index] == HOMING and stage is Stage.OPERATION:
            self.homing.control(index, before, word, float(self._standing_mm()[index]))
            self._report(index)

    def stop_by_itself(self, index: int, t_s: float) -> None:
        """Ramp one enabled axis down for a reason of the drive's own."""
        if self.stages[index] is Stage.OPERATION:
            self._own_stops.add(index)
            self.quick_stop(index, t_s)

    def quick_stop(self, index: int, t_s: float) -> None:
        """Ramp one enabled axis down; what follows depends on 605Ah."""
        if self.stages[index] is Stage.OPERATION:
            self._begin_ramp(index, Stage.QUICK_STOP, t_s)

    def lose_sync(self, t_s: float) -> None:
        """No SYNC comes any more: do what the settings say."""
        for index, stage in enumerate(self.stages):
            if stage is not Stage.OPERATION:
                continue
            if self._settings.sync_loss == "fault":
                self.trip(index, SYNC_LOST, t_s)
            elif self._settings.sync_loss == "quick-stop":
                self._emergency(index, SYNC_LOST)
                self.quick_stop(index, t_s)

    def trip(self, index: int, code: int, t_s: float, torque_lost: bool = False) -> None:
        """A drive fault: emergency, ramp down where the drive still can, brake, FAULT."""
        if self.stages[index] in (Stage.FAULT, Stage.FAULT_REACTION):
            return
        self.error_codes[index] = code
        self._emergency(index, code)
        moving = self.stages[index] in (Stage.OPERATION, Stage.QUICK_STOP)
        if not moving or torque_lost or self.parameters.fault_option[index] == 0:
            self._enter(index, Stage.FAULT, t_s)
        else:
            self._begin_ramp(index, Stage.FAULT_REACTION, t_s)

    def disable_voltage(self, index: int, t_s: float) -> None:
        """Take the torque away at once."""
        if self.stages[index] not in (Stage.FAULT, Stage.FAULT_REACTION):
            self._enter(index, Stage.SWITCH_ON_DISABLED, t_s)

    def limit_switch(self, index: int, on: bool) -> None:
        """A limit switch of one axis opens or closes; bit 11 tells of it."""
        self._switched[index] = on
        self._report(index)

    def seize_brake(self, index: int, closed: bool | None) -> None:
        """From its next order on a brake ends up closed or open whatever it is told; None heals it."""
        if closed is None:
            self._seized_brakes.pop(index, None)
        else:
            self._seized_brakes[index] = closed

    def _begin_ramp(self, index: int, stage: Stage, t_s: float) -> None:
        if self.stages[index] is Stage.OPERATION:
            speed = (self._goal[index] - self._start[index]) / self.cycle_s
            own = self.forces.speed_mm_s(index) if self.forces.pressing[index] else self.profile.speed(index)
            self._speed[index] = speed if self.following[index] else own
        self._enter(index, stage, t_s)

    def _enter(self, index: int, stage: Stage, t_s: float, *, hold: bool = False) -> None:
        """Change state; brakes and torque follow.

        The torque lasts until the brake has closed after 'disable operation' and, with `hold`, after own ramps.
        """
        before, self.stages[index] = self.stages[index], stage
        if stage is Stage.OPERATION:
            if before is not Stage.QUICK_STOP:
                self._brake(index, False, t_s)
            self.powered[index] = True
        elif stage not in _POWERED:
            keep = bool(self.powered[index]) and (stage is Stage.SWITCHED_ON or hold)
            self.powered[index] = keep and not self.braked[index]
            closing = self._brake_due.get(index, (t_s, False))[1]
            if not closing and (not self.braked[index] or index in self._brake_due):
                self._brake(index, True, t_s)
        if stage is not Stage.OPERATION:
            if self.forces.release(index):
                # An axis that pressed holds the position that the component has taken it to.
                self._now = self._now.copy()
                self._now[index] = self._standing_mm()[index]
            self.homing.leave(index)
            self.profile.leave(index)
            self.following[index] = False
            self._goal = self._goal.copy()
            self._goal[index] = self._now[index]
        self.busy = True
        self._report(index)

    def _brake(self, index: int, close: bool, t_s: float) -> None:
        delay = self._settings.brake_close_s if close else self._settings.brake_open_s
        self._brake_due[index] = (t_s + delay, close)

    def _work(self, t_s: float, dt_s: float, standing_mm: Array) -> None:
        """The axes that do something special: moving brakes, own ramps, waiting for torque-off."""
        now, kept = self._now.copy(), self.following.copy()
        for index, (due, close) in list(self._brake_due.items()):
            if t_s >= due - 1e-9:
                del self._brake_due[index]
                self.braked[index] = self._seized_brakes.get(index, close)
                self._report(index)
        for index, stage in enumerate(self.stages):
            if stage in _RAMPING:
                now[index] = self._ramp(index, dt_s, float(now[index]))
                self._finish_ramp(index, t_s)
            elif stage is Stage.OPERATION and not self._leads(index):
                self._move_alone(index, dt_s, now, standing_mm)
            elif stage is not Stage.OPERATION:
                if index not in self._brake_due:
                    self.powered[index] = False
                if not self.powered[index]:
                    now[index] = standing_mm[index]
        self._now = now
        self._goal = np.where(kept & self.following, self._goal, now)
        self._start = np.where(kept & self.following, self._start, now)
        self.busy = bool(self._brake_due) or any(self._pending(index) for index in range(len(self.stages)))

    def _move_alone(self, index: int, dt_s: float, now: Array, standing_mm: Array) -> None:
        """One step of an enabled axis that follows no set-points: `now` (m,) gets where it is to be."""
        by_itself = {HOMING: self.homing.step, PP: self.profile.step}.get(self.modes[index])
        if by_itself is None or self.braked[index] or index in self._brake_due:
            now[index] = standing_mm[index]
            self._begin_following(index)
            return
        before_mm, word = float(now[index]), int(self.statuswords[index])
        now[index] = by_itself(index, dt_s, before_mm)
        if now[index] != before_mm or word & _OWN_BITS != self._own_bits(index):
            self._report(index)

    def _pending(self, index: int) -> bool:
        stage = self.stages[index]
        if stage is Stage.OPERATION:
            return not self._leads(index)
        # An axis without torque may be driven back or float: its set-point goes with it.
        return stage in _RAMPING and not (stage is Stage.QUICK_STOP and self._speed[index] == 0.0)

    def _leads(self, index: int) -> bool:
        """True while an axis obeys its set-points or its target force."""
        return bool(self.following[index] or self.forces.pressing[index])

    def _begin_following(self, index: int) -> None:
        if self.braked[index] or index in self._brake_due:
            return
        mode = self.modes[index]
        if not mode or not self._settings.supported_modes >> (mode - 1) & 1:
            return
        if mode == CSP or (mode == IP and self.controlwords[index] & _INTERPOLATE):
            self.following[index] = True
        elif mode == CST:
            self.forces.take(index)
        self._report(index)

    def _rest(self, index: int) -> None:
        """Interpolation was switched off: the axis holds its last point."""
        self.following[index] = False
        self._goal = self._goal.copy()
        self._goal[index] = self._now[index]
        self.busy = True
        self._report(index)

    def _ramp(self, index: int, dt_s: float, now_mm: float) -> float:
        """Exact distance of a uniform deceleration over one step."""
        speed = float(self._speed[index])
        decel = float(self.parameters.decel_mm_s2[index])
        time_s = min(dt_s, abs(speed) / decel)
        slowed = speed - np.sign(speed) * decel * time_s
        self._speed[index] = 0.0 if time_s < dt_s else slowed
        return now_mm + 0.5 * (speed + float(slowed)) * time_s

    def _finish_ramp(self, index: int, t_s: float) -> None:
        if self._speed[index] != 0.0:
            return
        if self.stages[index] is Stage.FAULT_REACTION:
            self._enter(index, Stage.FAULT, t_s, hold=True)
        elif self.parameters.quick_stop_option[index] < 5:
            self._enter(index, Stage.SWITCH_ON_DISABLED, t_s, hold=True)

    def _note_limits(self, rows: NDArray[np.intp], limited: BoolArray) -> None:
        self._limited[rows] = limited
        self._moving_limit = bool(limited.any())
        for index in rows:
            self._report(int(index))

    def _own_bits(self, index: int) -> int:
        """What a mode that moves by itself says in bits 10, 12 and 13."""
        if self.modes[index] == HOMING:
            return self.homing.bits(index)
        return self.profile.bits(index) if self.modes[index] == PP else 0

    def _report(self, index: int) -> None:
        """Compose the statusword."""
        word = int(self.stages[index]) | _REMOTE_AND_VOLTAGE
        word |= _FOLLOWS if self._leads(index) else 0
        word |= _LIMIT if self._limited[index] or self._switched[index] else 0
        word |= _BRAKE if self.braked[index] else 0
        word |= _WINDOW if self.error_codes[index] == FOLLOWING_ERROR else 0
        word |= self._own_bits(index)
        self.statuswords[index] = word
        self.changed = True
