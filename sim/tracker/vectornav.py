"""A simulated VectorNav sensor on a moving body: ASCII protocol, registers, asynchronous output, errors of its own.

What it measures is worked out from the body's pose over the last FILTER_S: a parabola through the places gives the
acceleration, the turn over the span the rate. Faults are attributes of `faults`, to be set while it runs.
"""

from __future__ import annotations

import asyncio
import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sim.tracker.faults import FaultySender, WireFaults
from sim.wires.pacing import DeviceEnd

Array = NDArray[np.float64]
Pose = Callable[[float], tuple[Array, Array]]
"""Loop time -> rotation (3, 3) and origin (3,) mm of the body in W."""

GRAVITY_W = np.array([0.0, 0.0, -9.80665])
TO_SENSOR = np.diag([1.0, -1.0, -1.0])
"""The sensor's axes in the body: x along x, y to the right, z down."""
FILTER_S = 0.2
INPUT_LIMIT = 1024
RATES = (1, 2, 4, 5, 10, 20, 25, 40, 50, 100, 200)
KINDS = {14: "VNYMR", 19: "VNIMU"}
LINE_BITS = 1300
"""What a sample takes on the line."""
READ_ONLY = frozenset({1, 3, 4})

_LINE = re.compile(rb"\$((VN[A-Z]{3})((?:,[^,*$]*)*))\*([0-9A-F]{4}|[0-9A-FX]{2})")


@dataclass
class InertialErrors:
    """Errors of the sensor; the noise is one standard deviation a sample."""

    force_bias_m_s2: tuple[float, float, float] = (0.02, -0.015, 0.03)
    force_noise_m_s2: float = 0.01
    rate_bias_rad_s: tuple[float, float, float] = (1e-4, -5e-5, 2e-5)
    rate_noise_rad_s: float = 5e-4
    clock_ppm: float = 20.0
    scale: float = 0.0
    misalignment_rad: float = 0.0
    late_s: float = 0.0
    """`scale` by which force and rate are too large; turn of the sensor about (1, 1, 1) against its stated mounting;
    by how much its stamps are later than what it felt"""


@dataclass
class InertialFaults(WireFaults):
    """Run-time faults; each stays until it is set back."""

    ignores: set[int] = field(default_factory=set)
    """registers that are acknowledged and not taken"""
    frozen: bool = False
    """every sample repeats the measurements of the one before, under a fresh time"""
    clock_us: int = 0
    """added to the clock: a jump"""


class VectorNavSensor:
    """The sensor on `wire`, fixed to the body whose `pose` it feels; `seed` drives its noise."""

    kind = "inertial"

    def __init__(self, pose: Pose, wire: DeviceEnd, loop: asyncio.AbstractEventLoop, seed: int = 0) -> None:
        self.faults = InertialFaults()
        self.errors = InertialErrors()
        self.crc16 = False
        self._pose, self._loop = pose, loop
        self._out = FaultySender(wire, loop, self.faults, seed)
        self._rng = np.random.default_rng([seed, 19])
        self._input = b""
        self._registers = {
            1: "VN-SIM",
            3: "0100012345",
            4: "2.1.0.0",
            5: "115200",
            6: "14",
            7: "40",
            30: "0,0,0,0,1,0,1",
        }
        self._on_since_s = loop.time()
        self._felt: deque[tuple[float, Array, Array]] = deque()
        self._filtered: deque[tuple[float, tuple[float, ...]]] = deque()
        self._values: tuple[float, ...] = ()
        wire.on_bytes = self._receive
        self._next_s = loop.time()
        self._timer = loop.call_soon(self._tick)

    def close(self) -> None:
        """Switch it off."""
        self._timer.cancel()

    # commands ---------------------------------------------------------------------------------------------------
    def _receive(self, data: bytes) -> None:
        *lines, self._input = (self._input + data).split(b"\n")
        self._input = self._input[-INPUT_LIMIT:]
        for line in lines:
            match = _LINE.search(line)
            if match is None:
                continue
            if match[4] not in (b"XX", self._checksum(match[1])):
                self._error(3)
                continue
            self._obey(match[2].decode("ascii"), match[3].decode("latin-1").split(",")[1:])

    def _obey(self, command: str, fields: list[str]) -> None:
        if command not in ("VNRRG", "VNWRG"):
            self._error(4)
        elif not fields or not fields[0].isdecimal():
            self._error(5)
        elif int(fields[0]) not in self._registers:
            self._error(8)
        elif command == "VNRRG":
            self._send(f"VNRRG,{fields[0]},{self._registers[int(fields[0])]}")
        else:
            self._write(int(fields[0]), fields[1:])

    def _write(self, register: int, fields: list[str]) -> None:
        if register in READ_ONLY:
            self._error(9)
            return
        if not fields:
            self._error(5)
            return
        if not self._allows(register, fields):
            self._error(7)
            return
        if register == 7 and int(fields[0]) * LINE_BITS > int(self._registers[5]):
            self._error(12)
            return
        value = ",".join(fields)
        if register not in self.faults.ignores:
            self._registers[register] = value
        self._send(f"VNWRG,{register},{value}")

    def _allows(self, register: int, fields: list[str]) -> bool:
        if not all(f.isdecimal() for f in fields):
            return False
        first = int(fields[0])
        if register == 6:
            return first == 0 or first in KINDS
        return first in RATES if register == 7 else register != 30 or len(fields) == 7

    def _error(self, code: int) -> None:
        self._send(f"VNERR,{code:02X}")

    def _checksum(self, body: bytes) -> bytes:
        if not self.crc16:
            total = 0
            for byte in body:
                total ^= byte
            return b"%02X" % total
        register = 0
        for byte in body:
            register ^= byte << 8
            for _ in range(8):
                register = (register << 1) ^ (0x11021 if register & 0x8000 else 0)
        return b"%04X" % register

    def _send(self, text: str) -> None:
        body = text.encode("ascii")
        crc = self._checksum(body)
        if self.faults.bad_crc:
            crc = b"%0*X" % (len(crc), int(crc, 16) ^ 1)
        self._out.send(b"$" + body + b"*" + crc + b"\r\n")

    # measurements -----------------------------------------------------------------------------------------------
    def _tick(self) -> None:
        now_s = self._loop.time()
        kind = KINDS.get(int(self._registers[6].split(",")[0]))
        if kind is not None:
            self._feel(now_s)
            self._send(self._sample(kind, now_s))
        self._next_s += 1.0 / int(self._registers[7].split(",")[0])
        self._next_s = max(self._next_s, now_s)
        self._timer = self._loop.call_at(self._next_s, self._tick)

    def _feel(self, now_s: float) -> None:
        rotation, p_mm = self._pose(now_s)
        self._felt.append((now_s, np.array(rotation), np.array(p_mm)))
        while now_s - self._felt[0][0] > FILTER_S:
            self._felt.popleft()

    def _sample(self, kind: str, now_s: float) -> str:
        rotation = self._felt[-1][1] @ TO_SENSOR
        if not (self.faults.frozen and self._values):
            self._filtered.append((now_s, self._measure(rotation)))
            while len(self._filtered) > 1 and self._filtered[1][0] <= now_s - self.errors.late_s:
                self._filtered.popleft()
            self._values = self._filtered[0][1]
        force, rate = self._values[:3], self._values[3:]
        field_gauss = rotation.T @ np.array([0.25, 0.0, -0.4])
        numbers = [*force, *rate]
        if kind == "VNYMR":
            # Seen in a frame with z down, as the sensor tells its attitude.
            ypr = Rotation.from_matrix(TO_SENSOR @ rotation).as_euler("ZYX", degrees=True)
            head = ",".join(f"{v:+08.3f}" for v in ypr)
            text = f"{kind},{head},{_numbers(field_gauss, 4)},{_numbers(numbers[:3], 3)},{_numbers(numbers[3:], 6)}"
        else:
            head = f"{_numbers(field_gauss, 4)},{_numbers(numbers[:3], 3)},{_numbers(numbers[3:], 6)}"
            text = f"{kind},{head},+21.5,+101.325"
        return text + self._time_text(now_s)

    def _time_text(self, now_s: float) -> str:
        if self._registers[30].split(",")[0] != "2":
            return ""
        run_s = (now_s - self._on_since_s) * (1.0 + self.errors.clock_ppm * 1e-6)
        return f",T{(round(run_s * 1e6) + self.faults.clock_us) % 2**32}"

    def _measure(self, rotation: Array) -> tuple[float, ...]:
        """Specific force and turning rate (6,) in the sensor's axes, with its errors."""
        errors = self.errors
        wrong = (1.0 + errors.scale) * _turned(errors.misalignment_rad)
        force = wrong @ rotation.T @ (self._acceleration_m_s2() - GRAVITY_W) + np.array(errors.force_bias_m_s2)
        rate = wrong @ TO_SENSOR.T @ self._rate_rad_s() + np.array(errors.rate_bias_rad_s)
        force = force + errors.force_noise_m_s2 * self._rng.standard_normal(3)
        rate = rate + errors.rate_noise_rad_s * self._rng.standard_normal(3)
        return tuple(float(v) for v in (*force, *rate))

    def _acceleration_m_s2(self) -> Array:
        if len(self._felt) < 3:
            return np.zeros(3)
        t_s = np.array([t for t, _, _ in self._felt]) - self._felt[-1][0]
        places_m = np.array([p for _, _, p in self._felt]) * 1e-3
        parabola = np.polyfit(t_s, places_m - places_m[-1], 2)
        acceleration: Array = 2.0 * parabola[0]
        return acceleration

    def _rate_rad_s(self) -> Array:
        """In the body's axes."""
        (first_s, first, _), (last_s, last, _) = self._felt[0], self._felt[-1]
        if not last_s > first_s:
            return np.zeros(3)
        rate: Array = Rotation.from_matrix(first.T @ last).as_rotvec() / (last_s - first_s)
        return rate


def _turned(angle_rad: float) -> Array:
    """(3, 3): what a sensor turned by `angle_rad` about (1, 1, 1) shows of a vector in its stated axes."""
    result: Array = Rotation.from_rotvec(-angle_rad / np.sqrt(3.0) * np.ones(3)).as_matrix()
    return result


def _numbers(values: Array | list[float], digits: int) -> str:
    return ",".join(f"{float(v):+0{digits + 4}.{digits}f}" for v in values)
