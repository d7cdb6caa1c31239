"""Servo axes, all at once: lag, speed and acceleration limits, brakes, back-driving, what lies behind the motor.

The encoder sits on the motor. Behind it lie screw lead error, backlash, stick-slip and a repeatability that wanders
with the distance travelled; `load_mm` is where the socket really is along its axis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from docking.types import Array

BoolArray = NDArray[np.bool_]

_STILL_MM = 1e-7
_WAVES = 4
_STOPS = 256


@dataclass(frozen=True)
class AxisTruth:
    """Constants of m axes.

    `lag_s` servo time constant; `v_max`, `a_max` what the drive can do; `stroke_mm` (m, 2) hard stops;
    `backlash_mm` full width; `lead` relative lead error; `wander_mm` (m, w) amplitudes, `wave_per_mm` (m, w) and
    `phase` (m, w) of the repeatability; `stick_mm` (stops, m) offset after each stop; `down` (m,) sign of the axis
    direction that gravity pulls to, 0 for level axes; `driven` (m,) axes with a servo.
    """

    lag_s: Array
    v_max: Array
    a_max: Array
    stroke_mm: Array
    backlash_mm: Array
    lead: Array
    wander_mm: Array
    wave_per_mm: Array
    phase: Array
    stick_mm: Array
    down: Array
    brake_mm_s2: float
    back_drive_mm_s2: float
    driven: BoolArray


class AxisBank:
    """State of all axes. Only `step` is called every cycle; everything else is worked out when it is asked for."""

    def __init__(self, truth: AxisTruth, load_mm: Array, carries: Callable[[int], bool]) -> None:
        """Start at rest with the sockets at `load_mm` (m,); `carries(k)` tells whether axis k bears load right now."""
        self.truth = truth
        self._carries = carries
        count = len(load_mm)
        self.travel_mm: Array = np.zeros(count)
        self._stops = 0
        self.motor_mm: Array = (load_mm - self._wander()) / (1.0 + truth.lead)
        self._set: Array = self.motor_mm.copy()
        self._play: Array = self.motor_mm.copy()
        self._half: Array = 0.5 * truth.backlash_mm
        self._first_stick = truth.stick_mm[0].copy()
        self.slip_mm: Array = np.zeros(count)
        self.still = True
        self.jammed: BoolArray = np.zeros(count, dtype=bool)
        self._dragged_mm_s: Array = np.zeros(count)
        self._active: BoolArray = np.zeros(count, dtype=bool)
        self._idle: BoolArray = np.ones(count, dtype=bool)
        self._led: BoolArray = truth.driven
        self._falling: BoolArray = np.zeros(count, dtype=bool)
        self._all_active = False
        self._flags = (b"", b"")
        self._last_target = b""
        self._v_floor, self._a_floor = float(truth.v_max.min()), float(truth.a_max.min())
        self._dt = float("nan")
        self._decay: Array = np.zeros(count)
        self._gain: Array = np.zeros(count)
        self._ramp, self._error, self._delta, self._size, self._edge = (np.zeros(count) for _ in range(5))
        self._last_delta: Array = np.zeros(count)

    @property
    def following_error_mm(self) -> Array:
        """Set-point minus motor position (m,), zero for axes that are not under servo control."""
        result: Array = np.where(self._active | (self.jammed & ~self._idle), self._set - self.motor_mm, 0.0)
        return result

    def load_mm(self) -> Array:
        """Socket position along each axis (m,): lead, backlash, wander, stick-slip and slip added to the motor's."""
        stick = self.truth.stick_mm[self._stops % _STOPS] - self._first_stick
        result: Array = self._play + self.truth.lead * self.motor_mm + self._wander() + stick + self.slip_mm
        return result

    def step(self, dt_s: float, target_mm: Array, powered: BoolArray, braked: BoolArray) -> bool:
        """Advance by `dt_s` while the set-points ramp to `target_mm`; returns True when any motor moved."""
        if not dt_s > 0.0:
            return False
        flags = (powered.tobytes(), braked.tobytes())
        target_bytes = target_mm.tobytes()
        if flags != self._flags:
            self._flags = flags
            self._regroup(powered, braked)
        elif self.still and target_bytes == self._last_target:
            return False
        self._last_target = target_bytes
        if self._all_active and self._glide(dt_s, target_mm):
            return True
        if not self._all_active and self.still and self._nothing_asked(target_mm):
            return False
        return self._struggle(dt_s, target_mm)

    def seize(self, index: int, jammed: bool, dragged_mm_s: float = 0.0) -> None:
        """Jam or free one axis mechanically; a jammed axis is `dragged_mm_s` along whatever servo and brake want."""
        self.jammed[index] = jammed
        self._dragged_mm_s[index] = dragged_mm_s
        self._flags = (b"", b"")
        self.still = False

    def displace(self, index: int, by_mm: float) -> None:
        """Have one axis stand elsewhere, as a stop that was not straight has left it; its encoder says so."""
        for state in (self.motor_mm, self._set, self._play):
            state[index] += by_mm
        self._flags = (b"", b"")

    def weaken(self, index: int, v_mm_s: float, a_mm_s2: float) -> None:
        """Let one axis reach no more than this speed and acceleration."""
        truth = self.truth
        truth.v_max[index], truth.a_max[index] = v_mm_s, a_mm_s2
        self._v_floor, self._a_floor = float(truth.v_max.min()), float(truth.a_max.min())

    def let_go(self, floating: BoolArray) -> None:
        """Servo axes that hold no position from now on (m,): their motors go where the load takes them."""
        self._led = self.truth.driven & ~floating
        self._ramp[~self._led] = 0.0
        self._last_delta[floating] = 0.0
        self._flags = (b"", b"")

    def take_up(self, index: int, speed_mm_s: float) -> None:
        """Begin to hold the position of an axis that is on its way."""
        self._last_delta[index] = speed_mm_s * self._dt if self._dt > 0.0 else 0.0

    def _regroup(self, powered: BoolArray, braked: BoolArray) -> None:
        driven = self._led
        self._idle = ~(powered & driven)
        was_active = self._active
        self._active = powered & driven & ~braked & ~self.jammed
        self._falling = driven & ~powered & ~braked & ~self.jammed & (self.truth.down != 0.0)
        self._all_active = bool(self._active[driven].all()) and bool(driven.any())
        fresh = self._active & ~was_active
        self._set = np.where(fresh | self._idle, self.motor_mm, self._set)
        self.still = self.still and not self._falling.any()

    def _nothing_asked(self, target_mm: Array) -> bool:
        """True when no servo has anything to do and nothing can fall."""
        if self._falling.any():
            return False
        powered = ~self._idle
        asked = np.abs(target_mm - self._set)[powered].max(initial=0.0)
        waiting = np.abs(self._set - self.motor_mm)[self._active].max(initial=0.0)
        return bool(asked == 0.0 and waiting <= _STILL_MM)

    def _prepare(self, dt_s: float) -> None:
        self._dt = dt_s
        lag = self.truth.lag_s
        self._decay = np.exp(-dt_s / lag)
        # A first-order lag answers a ramp with an error that tends to rate * lag.
        self._gain = lag / dt_s * (1.0 - self._decay)

    def _glide(self, dt_s: float, target_mm: Array) -> bool:
        """The normal cycle: every driven axis under servo control and inside its limits. False when it is not."""
        if not abs(dt_s - self._dt) < 1e-9:
            self._prepare(dt_s)
        ramp, error, delta, size = self._ramp, self._error, self._delta, self._size
        np.subtract(target_mm, self._set, out=ramp, where=self._led)
        np.subtract(self._set, self.motor_mm, out=error)
        error *= self._decay
        np.multiply(ramp, self._gain, out=delta)
        error += delta
        np.subtract(self._set, self.motor_mm, out=delta)
        delta += ramp
        delta -= error
        np.abs(delta, out=size)
        peak = float(size.max())
        if not peak <= self._v_floor * dt_s:
            return False
        np.subtract(delta, self._last_delta, out=self._edge)
        np.abs(self._edge, out=self._edge)
        if not float(self._edge.max()) <= self._a_floor * dt_s * dt_s:
            return False
        self._set += ramp
        self._advance(delta, size)
        if peak < _STILL_MM and not ramp.any():
            self._settle()
        return True

    def _advance(self, delta: Array, size: Array) -> None:
        self.motor_mm += delta
        self.travel_mm += size
        self._last_delta, self._delta = delta, self._last_delta
        np.subtract(self.motor_mm, self._half, out=self._edge)
        np.maximum(self._play, self._edge, out=self._play)
        np.add(self.motor_mm, self._half, out=self._edge)
        np.minimum(self._play, self._edge, out=self._play)
        self.still = False

    def _settle(self) -> None:
        self.still = True
        self._last_delta[:] = 0.0
        self._stops += 1

    def _struggle(self, dt_s: float, target_mm: Array) -> bool:
        """The rare cycle: limits reached, axes off, braked, jammed or falling. Works axis by axis."""
        delta = np.zeros_like(self.motor_mm)
        for k in np.flatnonzero(self._led).tolist():
            rate = float(self._last_delta[k]) / dt_s
            if self.jammed[k]:
                rate = float(self._dragged_mm_s[k])
                if not self._idle[k]:
                    self._set[k] = target_mm[k]
            elif self._active[k]:
                rate = self._servo_rate(k, rate, dt_s, float(target_mm[k]))
            elif self._falling[k]:
                rate = self._fall_rate(k, rate, dt_s)
            else:
                rate -= _clip(rate, self.truth.brake_mm_s2 * dt_s)
                if not self._idle[k]:
                    self._set[k] = target_mm[k]
            low, high = self.truth.stroke_mm[k]
            delta[k] = min(max(self.motor_mm[k] + rate * dt_s, low), high) - self.motor_mm[k]
        self._set = np.where(self._idle, self.motor_mm + delta, self._set)
        size = np.abs(delta)
        moving = bool(size.max() >= _STILL_MM)
        self._advance(delta, size)
        waiting = np.abs(self._set - self.motor_mm)[self._active].max(initial=0.0) > _STILL_MM
        if not moving and not waiting and not self._falling.any():
            self._settle()
        return moving

    def _servo_rate(self, k: int, rate: float, dt_s: float, target_mm: float) -> float:
        """Rate of a servo axis towards its ramp, inside its speed and acceleration limits, able to brake in time."""
        ramp_rate = (target_mm - self._set[k]) / dt_s
        self._set[k] = target_mm
        gap = target_mm - self.motor_mm[k]
        decay = float(np.exp(-dt_s / self.truth.lag_s[k]))
        wanted = (gap - (gap - ramp_rate * dt_s) * decay - ramp_rate * self.truth.lag_s[k] * (1.0 - decay)) / dt_s
        a_max, v_max = float(self.truth.a_max[k]), float(self.truth.v_max[k])
        in_time = float(np.sqrt(2.0 * a_max * abs(gap)))
        wanted = ramp_rate + _clip(wanted - ramp_rate, in_time)
        wanted = rate + _clip(wanted - rate, a_max * dt_s)
        return _clip(wanted, v_max)

    def _fall_rate(self, k: int, rate: float, dt_s: float) -> float:
        """A loaded axis without torque or brake is driven back by its load; unloaded, friction holds it."""
        if not self._carries(k):
            return 0.0
        return rate + float(self.truth.down[k]) * self.truth.back_drive_mm_s2 * dt_s

    def _wander(self) -> Array:
        truth = self.truth
        waves = np.sin(truth.wave_per_mm * self.travel_mm[:, None] + truth.phase)
        result: Array = np.einsum("ij,ij->i", truth.wander_mm, waves)
        return result


def _clip(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


def wander_shape(generator: np.random.Generator, count: int, sigma_mm: float) -> tuple[Array, Array, Array]:
    """Amplitudes, wave numbers (1/mm) and phases (count, w) of a wander with standard deviation `sigma_mm`.

    A sum of waves over the travelled distance: the same command reached on another way ends somewhere else.
    """
    waves = 2.0 * np.pi / np.exp(generator.uniform(np.log(0.7), np.log(20.0), (count, _WAVES)))
    phases = generator.uniform(0.0, 2.0 * np.pi, (count, _WAVES))
    return np.full((count, _WAVES), sigma_mm * np.sqrt(2.0 / _WAVES)), waves, phases


def stick_table(generator: np.random.Generator, count: int, size_mm: float) -> Array:
    """(stops, count) offsets at which the axes stick after each stop, uniform in +-size."""
    return size_mm * generator.uniform(-1.0, 1.0, (_STOPS, count))
