"""Run-time faults that all simulated serial instruments share: what goes wrong on the line, what in the optics.

Each attribute is set while the device runs and stays until it is set back; the devices' own faults are subclasses.
"""

from __future__ import annotations

import asyncio
import random
from dataclasses import dataclass, field

import numpy as np

from sim.tracker.optics import Array, Optics, Shot
from sim.wires.pacing import DeviceEnd

S_PER_H = 3600.0


@dataclass
class WireFaults:
    """What happens to each line on its way to the host."""

    silent: bool = False
    """sends nothing at all, as if switched off"""
    drop_next: int = 0
    """so many lines from now on are lost; counts down"""
    drop_share: float = 0.0
    """this share of the lines is lost, at random"""
    late_s: float = 0.0
    """delay of every line"""
    twice: bool = False
    """every line is sent two times"""
    garbage_bytes: int = 0
    """so many random bytes before every line"""
    cut_to: int | None = None
    """only the first so many bytes of a line leave"""
    flip_bit: int | None = None
    """this bit of every line arrives inverted, counted from its first byte's lowest, modulo its length"""
    bad_crc: bool = False
    """every line carries a wrong checksum, where the protocol has one"""


@dataclass
class OpticsFaults:
    """What the instrument sees wrongly, while its line is in order."""

    blocked: set[str] = field(default_factory=set)
    """reflectors to which the beam is broken"""
    wrong_reflector: dict[str, str] = field(default_factory=dict)
    """reflector asked for -> reflector that is measured in its place"""
    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """added to every point, in the station frame: somebody has pushed the pillar"""
    drift_mm_per_h: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """the same, growing from the first shot that feels it"""
    scale: float = 1.0
    """every coordinate times this: a wrong unit"""
    frozen: bool = False
    """every shot repeats the coordinates of the one before, under a fresh time"""


class FaultySender:
    """The device's way to its wire, through its faults; `seed` drives garbage and losses only."""

    def __init__(self, wire: DeviceEnd, loop: asyncio.AbstractEventLoop, faults: WireFaults, seed: int) -> None:
        self._wire, self._loop, self._faults = wire, loop, faults
        self._noise = random.Random(seed)

    def send(self, line: bytes) -> None:
        """Send one whole line, or what the faults leave of it."""
        faults = self._faults
        if faults.drop_next > 0:
            faults.drop_next -= 1
            return
        lost = faults.drop_share > 0.0 and self._noise.random() < faults.drop_share
        if faults.silent or lost:
            return
        if faults.flip_bit is not None:
            line = flipped(line, faults.flip_bit)
        line = self._noise.randbytes(faults.garbage_bytes) + line[: faults.cut_to]
        line = line * 2 if faults.twice else line
        if faults.late_s > 0.0:
            self._loop.call_later(faults.late_s, self._wire.write, line)
        else:
            self._wire.write(line)


def flipped(line: bytes, bit: int) -> bytes:
    """`line` with one bit inverted, `bit` modulo its length."""
    at, place = divmod(bit % (8 * len(line)), 8)
    return line[:at] + bytes([line[at] ^ 1 << place]) + line[at + 1 :]


@dataclass(frozen=True)
class _Seen:
    """A shot as the faults let it be seen."""

    status: str
    name: str
    p_T_mm: Array
    sigma_mm: Array


class FaultyOptics:
    """The optics seen through their faults; satisfies `sim.tracker.optics.Optics`."""

    def __init__(self, optics: Optics, faults: OpticsFaults) -> None:
        self._optics, self._faults = optics, faults
        self._drifts_from_s: float | None = None
        self._last_mm: Array | None = None

    @property
    def measure_s(self) -> float:
        """Time that one point takes."""
        return self._optics.measure_s

    def shoot(self, name: str, t_s: float, face: int = 1) -> Shot:
        """Measure the reflector `name`, or the one that is taken for it."""
        if name in self._faults.blocked:
            return _Seen("no-target", name, np.zeros(3), np.zeros(3))
        return self._seen(name, self._optics.shoot(self._faults.wrong_reflector.get(name, name), t_s, face), t_s)

    def shoot_towards(self, direction_T: Array, t_s: float, face: int = 1) -> Shot:
        """Measure the reflector nearest to the aim, or the one that is taken for it."""
        shot = self._optics.shoot_towards(direction_T, t_s, face)
        if shot.name in self._faults.blocked:
            return _Seen("no-target", shot.name, np.zeros(3), np.zeros(3))
        other = self._faults.wrong_reflector.get(shot.name)
        return self._seen(shot.name, shot if other is None else self._optics.shoot(other, t_s, face), t_s)

    def _seen(self, name: str, shot: Shot, t_s: float) -> Shot:
        if shot.status == "no-target":
            return shot
        p_mm = (shot.p_T_mm + np.array(self._faults.shift_mm) + self._drift_mm(t_s)) * self._faults.scale
        if self._faults.frozen and self._last_mm is not None:
            p_mm = self._last_mm
        self._last_mm = p_mm
        return _Seen(shot.status, name, p_mm, shot.sigma_mm)

    def _drift_mm(self, t_s: float) -> Array:
        rate = np.array(self._faults.drift_mm_per_h)
        if not np.any(rate):
            self._drifts_from_s = None
            return np.zeros(3)
        self._drifts_from_s = t_s if self._drifts_from_s is None else self._drifts_from_s
        drift: Array = rate * (t_s - self._drifts_from_s) / S_PER_H
        return drift
