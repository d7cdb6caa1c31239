"""Each axis by itself: does it follow, does it stand where it should, can its encoder be believed?"""

from __future__ import annotations

from collections import deque

import numpy as np

from docking.errors import AxisDrift, AxisStuck, EncoderJump, FollowingErrorTrip
from docking.kinematics import Positioners
from docking.motion.monitors.limits import Margins, Timing, WatchLimits
from docking.motion.triggers import Finding, Trigger
from docking.types import Array, Feedback

SLOWEST, FASTEST = 0.2, 2.0
"""Encoder travel as a fraction of the commanded: under it the axis is stuck, over it the encoder is not believed."""
WINDOW = 5
"""Read-backs over which what an axis was to do and what its encoder shows are compared."""
WINDOW_MM = 0.05
"""Travel that was to be made in the window from which on the encoder must show it."""
HALF = 0.5
JUMP = 2.0
"""An encoder cannot move faster than so many times the largest speed of its axis."""
QUIET_MM, QUIET_SAMPLES = 0.002, 5
"""Axes that were told to stand do stand when they move less between so many read-backs in a row."""
SETTLED_S = 0.3
"""At the latest so long after a move the place where the axes stand is their hold point."""
GAP_CYCLES = 25.0
"""Read-backs farther apart than so many cycles are judged as if they were so far apart."""

_MIDDLE, _SPREAD = (SLOWEST + FASTEST) / 2.0, (FASTEST - SLOWEST) / 2.0
_FLOOR_MM = WINDOW_MM * _MIDDLE / _SPREAD


class Travel:
    """Judges position read-backs (m,) against the commanded ones, sample by sample.

    Passive axes and those that hold a force have no set-point: only their encoders are judged. `max_following_mm` (m,)
    is kept until it is reset.
    """

    def __init__(self, positioners: Positioners, limits: WatchLimits, timing: Timing, margins: Margins) -> None:
        count = len(positioners.axes)
        self._axes, self._limits, self._timing, self._margins = positioners.axes, limits, timing, margins
        self._driven = np.asarray(positioners.driven, dtype=bool)
        self._free = ~self._driven
        self._holds_force = np.flatnonzero(positioners.followers)
        self._unpowered = np.asarray(~positioners.powered, dtype=bool)
        self._any_free = bool(self._free.any())
        v_max = np.asarray(positioners.v_mm_s, dtype=np.float64)
        self._slope = (limits.following_vmax_mm - limits.following_rest_mm) / v_max
        self._jump_mm_s = JUMP * v_max
        self._step, self._asked, self._size, self._far = (np.zeros(count) for _ in range(4))
        self.max_following_mm: Array = np.zeros(count)
        self.forget()

    def forget(self) -> None:
        """Begin again: the axes may have been moved by others meanwhile."""
        self._last: tuple[Array, Array] | None = None
        self._last_s = float("nan")
        self._window: deque[tuple[Array, Array]] = deque(maxlen=WINDOW + 1)
        self._hold: Array | None = None
        self._stood_s, self._quiet = float("nan"), 0
        self._moving = False

    def unchanged(self, t_s: float) -> None:
        """A read-back at `t_s` says what the last one said."""
        self._last_s = t_s

    def held_s(self, t_s: float) -> float:
        """For how long the commands have stood at `t_s`."""
        return t_s - self._stood_s

    def following(self, error_mm: Array, speed_mm_s: Array | float) -> Finding | None:
        """The following error of driven axes against a limit that grows with the speed of the axis."""
        magnitude = np.abs(error_mm)
        np.maximum(self.max_following_mm, magnitude, out=self.max_following_mm)
        limit = self._limits.following_rest_mm + self._slope * np.abs(speed_mm_s)
        magnitude /= limit
        if self._any_free:
            magnitude[self._free] = 0.0
        if self._margins.note("following_error", float(magnitude.max())):
            return None
        k = int(np.argmin(magnitude <= 1.0))
        error = FollowingErrorTrip(self._axes[k], value=float(error_mm[k]), limit=float(limit[k]))
        return Finding(Trigger.FOLLOWING_ERROR, error)

    def judge(self, feedback: Feedback, q_ref_mm: Array, *, moving: bool, led: bool) -> Finding | None:
        """Judge one complete read-back against the set-points (m,) it belongs to.

        `moving` a move runs; `led` the axes follow set-points, none ramps down by itself.
        """
        if moving != self._moving:
            self._moving = moving
            self._set_out(feedback.t_s)
            self._window.clear()
        if not led:
            self._window.clear()
        last, self._last = self._last, (feedback.position_mm, q_ref_mm)
        last_s, self._last_s = self._last_s, feedback.t_s
        if last is None:
            self._stood_s = feedback.t_s
            if moving and led:
                self._window.append((feedback.position_mm, q_ref_mm))
            return None
        cycle = self._timing.cycle_s
        dt_s = min(max(feedback.t_s - last_s, cycle), GAP_CYCLES * cycle)
        np.subtract(feedback.position_mm, last[0], out=self._step)
        jump = self._jump(dt_s)
        if jump is not None:
            return jump
        adrift = self._adrift(feedback.position_mm, q_ref_mm)
        if adrift is not None:
            return adrift
        if not moving:
            return self._stand(feedback, last[0])
        if not led:
            self._set_out(feedback.t_s)
            return None
        np.subtract(q_ref_mm, last[1], out=self._asked)
        if self._asked.any():
            self._set_out(feedback.t_s)
            return self._stuck(feedback.following_error_mm, dt_s) or self._compare(feedback.position_mm, q_ref_mm)
        # A move that is held: the axes stand as they do without one.
        return self._stand(feedback, last[0]) or self._compare(feedback.position_mm, q_ref_mm)

    def _set_out(self, t_s: float) -> None:
        """The axes are asked to move, or were until now: where they will stand is not known yet."""
        self._hold, self._stood_s, self._quiet = None, t_s, 0

    def _jump(self, dt_s: float) -> Finding | None:
        np.abs(self._step, out=self._size)
        self._size /= self._jump_mm_s
        if self._margins.note("encoder_jump", float(self._size.max()) / dt_s):
            return None
        k = int(np.argmin(self._size <= dt_s))
        return self._disbelieve(k, float(self._step[k]), float(self._jump_mm_s[k]) * dt_s)

    def _adrift(self, position_mm: Array, q_ref_mm: Array) -> Finding | None:
        """An axis that holds a force goes where the component goes; anywhere else it has lost its ball and runs."""
        if not len(self._holds_force):
            return None
        off, limit = (position_mm - q_ref_mm)[self._holds_force], self._limits.adrift_mm
        if self._margins.note("held_axis", float(np.abs(off).max()) / limit):
            return None
        k = int(np.argmin(np.abs(off) <= limit))
        cause = "No set-point leads it: it holds a force."
        error = AxisDrift(self._axes[self._holds_force[k]], cause, value=float(off[k]), limit=limit)
        return Finding(Trigger.DRIFT, error)

    def _disbelieve(self, k: int, moved_mm: float, limit_mm: float, cause: str = "") -> Finding:
        return Finding(Trigger.ENCODER_JUMP, EncoderJump(self._axes[k], cause, value=moved_mm, limit=limit_mm))

    def _stand(self, feedback: Feedback, before_mm: Array) -> Finding | None:
        """Hold point: where the axes stood when they had come to rest."""
        if self._hold is None:
            still = float(np.abs(self._step).max(initial=0.0, where=self._driven)) <= QUIET_MM
            self._quiet = self._quiet + 1 if still else 0
            if self._quiet < QUIET_SAMPLES and not feedback.t_s - self._stood_s >= SETTLED_S:
                return None
            self._hold = before_mm
        np.subtract(feedback.position_mm, self._hold, out=self._far)
        if self._any_free:
            self._far[self._free] = 0.0
        limit = self._limits.standstill_mm
        np.abs(self._far, out=self._size)
        if self._margins.note("standstill", float(self._size.max()) / limit):
            return None
        k = int(np.argmin(self._size <= limit))
        return Finding(Trigger.DRIFT, AxisDrift(self._axes[k], value=float(self._far[k]), limit=limit))

    def _stuck(self, error_mm: Array, dt_s: float) -> Finding | None:
        """An axis hangs back by more than its lag and made less than half of the step that was asked of it."""
        hang, asked = self._far, self._asked
        np.multiply(asked, -self._timing.servo_lag_s / dt_s, out=hang)
        hang += error_mm
        np.abs(hang, out=self._size)
        if self._any_free:
            self._size[self._free] = 0.0
        limit = self._limits.stuck_mm
        if self._size.max() <= limit:
            self._margins.note("stuck", float(self._size.max()) / limit)
            return None
        slow = ~(self._step * asked >= HALF * asked * asked) & (asked != 0.0) & ~(self._size <= limit)
        if not slow.any():
            return None
        k = int(np.argmax(slow))
        return Finding(Trigger.STUCK, AxisStuck(self._axes[k], value=float(self._size[k]), limit=limit))

    def _compare(self, position_mm: Array, q_ref_mm: Array) -> Finding | None:
        """Over some read-backs the encoder must make about the travel that was commanded, and no other."""
        window = self._window
        window.append((position_mm, q_ref_mm))
        if len(window) <= WINDOW:
            return None
        made, asked, off = self._step, self._asked, self._far
        np.subtract(position_mm, window[0][0], out=made)
        np.subtract(q_ref_mm, window[0][1], out=asked)
        np.multiply(asked, -_MIDDLE, out=off)
        off += made
        np.abs(off, out=off)
        np.abs(asked, out=self._size)
        np.maximum(self._size, _FLOOR_MM, out=self._size)
        off /= self._size
        if self._any_free:
            # An axis that holds a force jams as a driven one does: it has to go where the plan takes the component.
            off[self._unpowered] = 0.0
        if self._margins.note("command_against_encoder", float(off.max()) / _SPREAD):
            return None
        k = int(np.argmin(off <= _SPREAD))
        moved, wanted = float(made[k]), float(asked[k])
        cause = f"It was told to move {wanted:+.3f} mm and moved {moved:+.3f} mm."
        if abs(moved) < SLOWEST * abs(wanted):
            error = AxisStuck(self._axes[k], cause, value=abs(wanted - moved), limit=(1.0 - SLOWEST) * abs(wanted))
            return Finding(Trigger.STUCK, error)
        return self._disbelieve(k, moved, FASTEST * max(abs(wanted), WINDOW_MM), cause)
