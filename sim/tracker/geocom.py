"""A motorised total station that speaks GeoCOM (ASCII) with its own framing, checksum and geometry.

Procedures: those that a coordinate measurement needs; any other answers 3081 (not available). The instrument keeps
an aim, a face and the last distance, as a real one does. Faults are attributes of `faults`, to be set while it runs.
"""

from __future__ import annotations

import asyncio
import math
import random
import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim.tracker.crc import checksum
from sim.tracker.optics import Optics, Shot
from sim.wires.pacing import DeviceEnd

INPUT_LIMIT = 4096
FRESH_S = 2.0
OK, BAD_PARAMETER, ABORTED = 0, 2, 8
ACCURACY_NOT_GUARANTEED, ANGLES_ONLY, BUSY = 1284, 1285, 1293
CANNOT_DECODE, NOT_AVAILABLE, BAD_CHECKSUM = 3080, 3081, 3101
NO_REFLECTOR, ATR_OFF = 8710, 8714
FULL_TURN = 2.0 * math.pi

_REQUEST = re.compile(r"(%R1Q,(\d+)(?:,(\d+))?)(?:,(\d+))?(:(.*))")


@dataclass
class GeocomFaults:
    """Run-time faults; each stays until it is set back."""

    silent: bool = False
    """answers nothing, as if switched off"""
    garbage_bytes: int = 0
    """so many random bytes before every reply"""
    wrong_trid: bool = False
    """replies carry the transaction number of the request before"""
    com_code: int = 0
    """communication code of every reply"""
    measure_code: int = 0
    """return code of GetSimpleMea in place of OK (1283 and 1284 still return the values)"""
    stale_distance: bool = False
    """DoMeasure keeps the distance of the measurement before and the clear command does nothing"""
    zero: bool = False
    """the distance reads exactly zero with return code OK"""
    late_s: float = 0.0
    """delay of every reply"""
    cut_to: int | None = None
    """only the first so many bytes of a reply leave"""
    carriage_return_only: bool = False
    """replies end without their line feed"""
    bad_crc: bool = False
    """replies in the checksum form carry a wrong one"""


Answer = tuple[int, tuple[str, ...]]


@dataclass(frozen=True)
class _Call:
    """One decoded request."""

    rpc: int
    trid: int
    has_crc: bool
    params: tuple[str, ...]


class GeocomStation:
    """The station on `wire`, measuring with `optics` on the time of `loop`; `seed` drives its garbage only."""

    serial_number = 366001
    name = "SIM TS60"

    def __init__(self, optics: Optics, wire: DeviceEnd, loop: asyncio.AbstractEventLoop, seed: int = 0) -> None:
        self.faults = GeocomFaults()
        self.requests = 0
        self._optics, self._wire, self._loop = optics, wire, loop
        self._noise = random.Random(seed)
        self._input = b""
        self._digits = 15
        self._previous_trid = 0
        self._hz, self._v = 0.0, 0.5 * math.pi
        self._atr = True
        self._ready_at_s = math.inf
        self._shot: Shot | None = None
        self._found: tuple[float, Shot] | None = None
        self._slope_m = 0.0
        self._procedures: dict[int, Callable[[tuple[str, ...]], Answer]] = {
            0: lambda params: (OK, ()),
            107: self._set_precision,
            108: lambda params: (OK, (str(self._digits),)),
            110: lambda params: (OK, ("1", "0", "0")),
            5003: lambda params: (OK, (str(self.serial_number),)),
            5004: lambda params: (OK, (f'"{self.name}"',)),
            5034: lambda params: (OK, ("1", "0", "0")),
            2008: self._do_measure,
            2026: lambda params: (OK, (str(self._face() - 1),)),
            2107: lambda params: (OK, self._angles()),
            9027: self._make_positioning,
            9028: self._change_face,
            9037: self._fine_adjust,
            18005: self._set_atr,
        }
        wire.on_bytes = self._receive

    def _receive(self, data: bytes) -> None:
        *lines, self._input = (self._input + data).split(b"\n")
        self._input = self._input[-INPUT_LIMIT:]
        for line in lines:
            text = line.decode("latin-1").strip()
            if text:
                self._obey(text)

    def _obey(self, text: str) -> None:
        match = _REQUEST.fullmatch(text)
        if match is None:
            self._reply(_Call(0, 0, False, ()), CANNOT_DECODE, (OK, ()))
            return
        params = tuple(match[6].split(",")) if match[6] else ()
        call = _Call(int(match[2]), int(match[3] or 0), match[4] is not None, params)
        if match[4] is not None and int(match[4]) != checksum((match[1] + match[5]).encode("latin-1")):
            self._reply(call, BAD_CHECKSUM, (OK, ()))
            return
        self.requests += 1
        self._run(call)

    def _run(self, call: _Call) -> None:
        try:
            if call.rpc in (2108, 17017):
                self._measurement(call)
            elif call.rpc in self._procedures:
                self._reply(call, OK, self._procedures[call.rpc](call.params))
            else:
                self._reply(call, NOT_AVAILABLE, (OK, ()))
        except (ValueError, IndexError):
            self._reply(call, OK, (BAD_PARAMETER, ()))

    def _set_precision(self, params: tuple[str, ...]) -> Answer:
        digits = int(params[0])
        if not 0 <= digits <= 15:
            return BAD_PARAMETER, ()
        self._digits = digits
        return OK, ()

    def _set_atr(self, params: tuple[str, ...]) -> Answer:
        self._atr = params[0] == "1"
        return OK, ()

    def _make_positioning(self, params: tuple[str, ...]) -> Answer:
        hz, v = float(params[0]), float(params[1])
        if not (math.isfinite(hz) and 0.0 <= v < FULL_TURN):
            return BAD_PARAMETER, ()
        self._hz, self._v, self._found = hz % FULL_TURN, v, None
        return self._seek() if params[3] == "1" else (OK, ())

    def _change_face(self, params: tuple[str, ...]) -> Answer:
        self._hz, self._v, self._found = (self._hz + math.pi) % FULL_TURN, FULL_TURN - self._v, None
        return self._seek() if params[1] == "1" else (OK, ())

    def _fine_adjust(self, params: tuple[str, ...]) -> Answer:
        if not (float(params[0]) > 0.0 and float(params[1]) > 0.0):
            return BAD_PARAMETER, ()
        return self._seek()

    def _seek(self) -> Answer:
        """Find the reflector near the aim and put the cross-hairs on it."""
        if not self._atr:
            return ATR_OFF, ()
        shot = self._shoot()
        if shot.status == "no-target":
            return NO_REFLECTOR, ()
        self._aim_at(shot)
        self._found = (self._loop.time(), shot)
        return OK, ()

    def _do_measure(self, params: tuple[str, ...]) -> Answer:
        command = int(params[0])
        if command == 1:
            self._ready_at_s = self._loop.time() + self._optics.measure_s
            self._shot = None
        elif command in (0, 3):
            self._ready_at_s, self._shot = math.inf, None
        else:
            return BAD_PARAMETER, ()
        return OK, ()

    def _measurement(self, call: _Call) -> None:
        """GetSimpleMea waits for the distance up to its wait time; MeasDistanceAngle starts one and waits for it."""
        first, tail = int(call.params[0]), tuple[str, ...]()
        if call.rpc == 17017:
            self._do_measure(("1",))
            wait_s, tail = self._optics.measure_s, (str(first),)
        else:
            wait_s = first / 1000.0
        rest_s = min(wait_s, max(0.0, self._ready_at_s - self._loop.time()))
        self._loop.call_later(rest_s, self._answer_measurement, call, tail)

    def _answer_measurement(self, call: _Call, tail: tuple[str, ...]) -> None:
        if self._shot is None and self._loop.time() >= self._ready_at_s - 1e-9:
            self._shot = self._take_found() or self._shoot()
            if self._shot.status != "no-target":
                self._aim_at(self._shot)
                self._keep_distance(self._shot)
        if self._shot is None or self._shot.status == "no-target":
            self._reply(call, OK, (ANGLES_ONLY, (*self._angles(), self._text(0.0), *tail)))
            return
        code = ACCURACY_NOT_GUARANTEED if self._shot.status == "inaccurate" else OK
        slope_m = 0.0 if self.faults.zero else self._slope_m
        values = (*self._angles(), self._text(slope_m), *tail)
        self._reply(call, OK, (self.faults.measure_code or code, values))

    def _keep_distance(self, shot: Shot) -> None:
        if not (self.faults.stale_distance and self._slope_m > 0.0):
            self._slope_m = float(np.linalg.norm(shot.p_T_mm)) / 1000.0

    def _take_found(self) -> Shot | None:
        """The reflector of a search just made: aim and distance see the same one, with one chance of a gross error."""
        found, self._found = self._found, None
        fresh = found is not None and self._loop.time() - found[0] <= self._optics.measure_s + FRESH_S
        return found[1] if found is not None and fresh else None

    def _shoot(self) -> Shot:
        sin_v = math.sin(self._v)
        direction = np.array([sin_v * math.sin(self._hz), sin_v * math.cos(self._hz), math.cos(self._v)])
        return self._optics.shoot_towards(direction, self._loop.time(), self._face())

    def _aim_at(self, shot: Shot) -> None:
        """Point at the shot's coordinates (x east, y north, z up), in the face in which the telescope is."""
        east, north, up = (float(c) for c in shot.p_T_mm)
        azimuth = math.pi / 2.0 - math.atan2(north, east)
        zenith = math.acos(up / math.sqrt(east * east + north * north + up * up))
        second = self._face() == 2
        self._hz = (azimuth + (math.pi if second else 0.0)) % FULL_TURN
        self._v = FULL_TURN - zenith if second else zenith

    def _face(self) -> int:
        return 1 if self._v <= math.pi else 2

    def _angles(self) -> tuple[str, str]:
        return self._text(self._hz), self._text(self._v)

    def _text(self, value: float) -> str:
        return f"{value:.{self._digits}f}"

    def _reply(self, call: _Call, com: int, answer: Answer) -> None:
        trid = self._previous_trid if self.faults.wrong_trid else call.trid
        self._previous_trid = call.trid
        head = f"%R1P,{self.faults.com_code or com},{trid}"
        tail = ":" + ",".join((str(answer[0]), *answer[1]))
        crc = ""
        if call.has_crc:
            crc = f",{checksum((head + tail).encode('ascii')) ^ (1 if self.faults.bad_crc else 0)}"
        end = "\r" if self.faults.carriage_return_only else "\r\n"
        line = (head + crc + tail + end).encode("ascii")[: self.faults.cut_to]
        line = self._noise.randbytes(self.faults.garbage_bytes) + line
        if not self.faults.silent:
            self._loop.call_later(self.faults.late_s, self._wire.write, line)
