"""A laser tracker behind a gateway that speaks the line protocol (docs/line-protocol.md), written from that page alone.

It shares nothing with the driver: checksum and grammar are its own. One request runs at a time; a later `$MEA` or
`$STP` abandons the one that runs. Faults are attributes of `faults`, to be set while it runs.
"""

from __future__ import annotations

import asyncio
import re
from dataclasses import dataclass

import numpy as np

from sim.tracker.crc import checksum
from sim.tracker.faults import FaultyOptics, FaultySender, OpticsFaults, WireFaults
from sim.tracker.optics import Array, Optics, Shot
from sim.wires.pacing import DeviceEnd

HEARTBEAT_S = 0.4
PROTOCOL = 1
INPUT_LIMIT = 4096
IDENTITY = ("Simulated", "Laser tracker", "LT-0001", "1.0")

VALID, INACCURATE, OCCLUDED, CHANGED, SECOND_FACE = (1 << n for n in range(5))
UNKNOWN_COMMAND, BAD_ARGUMENT, NO_TARGET = 1, 2, 10

_REQUEST = re.compile(rb"\$([A-Z]{3},(\d{1,5})((?:,[^,*$\r\n]*)*))\*([0-9A-F]{4})\r")
_TARGET = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.\-]{0,31}")


@dataclass
class LineFaults(OpticsFaults, WireFaults):
    """Run-time faults; each stays until it is set back."""

    slow_s: float = 0.0
    """so much longer a measurement takes; the heartbeats go on"""
    stale: bool = False
    """answers a measurement with the coordinates and the time of the one before"""
    wrong_seq: bool = False
    """points carry the number of the request before"""
    wrong_target: str = ""
    """points name this target, whichever was asked for"""
    zero: bool = False
    """coordinates exactly zero, flagged valid"""
    extra_flags: int = 0
    """bits added to the flags of a point"""
    clear_flags: int = 0
    """bits removed from the flags of a point"""
    clock_us: int = 0
    """added to the device's clock: a jump"""


class LineTrackerDevice:
    """The device on `wire`, measuring with `optics` on the time of `loop`; `seed` drives its garbage only."""

    def __init__(self, optics: Optics, wire: DeviceEnd, loop: asyncio.AbstractEventLoop, seed: int = 0) -> None:
        self.faults = LineFaults()
        self.requests = 0
        self._optics, self._loop = FaultyOptics(optics, self.faults), loop
        self._out = FaultySender(wire, loop, self.faults, seed)
        self._input = b""
        self._beats = 0
        self._timers: list[asyncio.TimerHandle] = []
        self._last: dict[str, tuple[int, str]] = {}
        self._previous: tuple[int, str] | None = None
        wire.on_bytes = self._receive

    def close(self) -> None:
        """Abandon what runs."""
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()

    def _receive(self, data: bytes) -> None:
        *lines, self._input = (self._input + data).split(b"\n")
        self._input = self._input[-INPUT_LIMIT:]
        for line in lines:
            match = _REQUEST.search(line)
            if match and int(match[4], 16) == checksum(match[1]):
                fields = match[3].decode("ascii", "replace").split(",")[1:]
                self._obey(match[1][:3].decode("ascii"), int(match[2]), fields)

    def _obey(self, kind: str, seq: int, fields: list[str]) -> None:
        self.requests += 1
        if kind == "VER" and not fields:
            self._send("IDN", seq, PROTOCOL, *IDENTITY)
        elif kind == "STP" and not fields:
            self.close()
            self._send("ACK", seq)
        elif kind == "GET" and len(fields) == 1:
            self._recall(seq, fields[0])
        elif kind == "MEA" and len(fields) in (2, 3):
            self._start(seq, fields)
        elif kind in ("VER", "STP", "GET", "MEA"):
            self._send("ERR", seq, BAD_ARGUMENT, "number of fields")
        else:
            self._send("ERR", seq, UNKNOWN_COMMAND, f"{kind} is not offered")

    def _recall(self, seq: int, target: str) -> None:
        if target in self._last:
            t_us, rest = self._last[target]
            self._send("PNT", seq, t_us, rest)
        else:
            self._send("ERR", seq, NO_TARGET, "not measured since power-up")

    def _start(self, seq: int, fields: list[str]) -> None:
        target, count, face = fields[0], fields[1], (fields[2:] or ["1"])[0]
        if not _TARGET.fullmatch(target) or not re.fullmatch(r"[1-9]\d?", count) or face not in ("1", "2"):
            self._send("ERR", seq, BAD_ARGUMENT, "target, count 1..99 or face")
            return
        self.close()
        duration_s = int(count) * self._optics.measure_s + self.faults.slow_s
        finish = self._loop.call_later(duration_s, self._finish, seq, target, int(count), int(face))
        self._timers = [finish, self._loop.call_later(HEARTBEAT_S, self._beat)]

    def _beat(self) -> None:
        self._beats = (self._beats + 1) % 65536
        self._send("HBT", self._beats, self._clock_us(), 1)
        self._timers[1] = self._loop.call_later(HEARTBEAT_S, self._beat)

    def _clock_us(self) -> int:
        return round(self._loop.time() * 1e6) + self.faults.clock_us

    def _finish(self, seq: int, target: str, count: int, face: int) -> None:
        self.close()
        shots = [self._optics.shoot(target, self._loop.time(), face) for _ in range(count)]
        if any(shot.status == "no-target" for shot in shots):
            self._send("ERR", seq, NO_TARGET, "no reflector found")
            return
        fresh = (self._clock_us(), self._point_fields(target, shots, face))
        t_us, rest = self._previous if self.faults.stale and self._previous is not None else fresh
        rest = ",".join([self.faults.wrong_target or target, *rest.split(",")[1:]])
        self._previous = (t_us, rest)
        self._last[target] = (t_us, rest)
        self._send("PNT", seq - 1 if self.faults.wrong_seq else seq, t_us, rest)

    def _point_fields(self, target: str, shots: list[Shot], face: int) -> str:
        p_mm: Array = np.mean([shot.p_T_mm for shot in shots], axis=0)
        sigma_mm: Array = np.max([shot.sigma_mm for shot in shots], axis=0)
        if self.faults.zero:
            p_mm = np.zeros(3)
        flags = VALID | (SECOND_FACE if face == 2 else 0)
        if any(shot.status == "inaccurate" for shot in shots):
            flags |= INACCURATE
        flags = (flags | self.faults.extra_flags) & ~self.faults.clear_flags
        um = [round(float(v) * 1000.0) for v in (*p_mm, *sigma_mm)]
        return ",".join(map(str, [target, *um, flags]))

    def _send(self, kind: str, *fields: object) -> None:
        body = ",".join(map(str, (kind, *fields))).encode("ascii")
        crc = checksum(body) ^ (0x0001 if self.faults.bad_crc else 0)
        self._out.send(b"$" + body + b"*" + f"{crc:04X}".encode("ascii") + b"\r\n")
