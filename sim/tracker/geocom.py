"""A motorised total station that speaks GeoCOM (ASCII) with its own framing, checksum and geometry.

Procedures: those that a coordinate measurement needs; any other answers 3081 (not available). The instrument keeps
an aim, a face, its corrections and the last distance, as a real one does. Faults are attributes of `faults`, to be set
while it runs; `head` is its optics and mechanics.
"""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field

from sim.tracker.crc import checksum
from sim.tracker.faults import FaultyOptics, FaultySender, OpticsFaults, WireFaults
from sim.tracker.geocom_head import FULL_TURN, Air, Head
from sim.tracker.optics import Optics
from sim.wires.pacing import DeviceEnd

INPUT_LIMIT = 4096
OK, BAD_PARAMETER, ABORTED = 0, 2, 8
ACCURACY_NOT_GUARANTEED, ANGLES_ONLY, BUSY = 1284, 1285, 1293
CANNOT_DECODE, NOT_AVAILABLE, BAD_CHECKSUM = 3080, 3081, 3101
NO_REFLECTOR, ATR_OFF = 8710, 8714
SIGMA_ANGLE_RAD = 2.4e-6
SIGMA_TILT_RAD = 2.4e-6
WAVELENGTH_UM = 0.658
MOTOR = frozenset({9027, 9028, 9029, 9037})

_REQUEST = re.compile(r"(%R1Q,(\d+)(?:,(\d+))?)(?:,(\d+))?(:(.*))")


@dataclass
class GeocomFaults(OpticsFaults, WireFaults):
    """Run-time faults; each stays until it is set back."""

    wrong_trid: bool = False
    """replies carry the transaction number of the request before"""
    com_code: int = 0
    """communication code of every reply"""
    codes: dict[int, int] = field(default_factory=dict)
    """procedure -> return code in place of OK; parameters stay"""
    missing: set[int] = field(default_factory=set)
    """procedures that this firmware does not have"""
    measure_code: int = 0
    """return code of a measurement in place of OK (1283 and 1284 still return the values)"""
    stale_distance: bool = False
    """DoMeasure keeps the distance of the measurement before and the clear command does nothing"""
    zero: bool = False
    """the distance reads exactly zero with return code OK"""
    turn_s: float = 0.0
    """so long every motorised function takes"""
    ignores: set[int] = field(default_factory=set)
    """settings that are acknowledged and not taken, by the procedure that sets them"""
    sigma_angle_rad: float = SIGMA_ANGLE_RAD
    """what the instrument says of the accuracy of its angles"""
    carriage_return_only: bool = False
    """replies end without their line feed"""
    clock_s: float = 0.0
    """added to the instrument's clock: a jump"""


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
        self.head = Head(FaultyOptics(optics, self.faults))
        self._loop = loop
        self._out = FaultySender(wire, loop, self.faults, seed)
        self._input = b""
        self._digits = 15
        self._wavelength_um = WAVELENGTH_UM
        self._previous_trid = 0
        self._turning: tuple[asyncio.TimerHandle, _Call] | None = None
        self._procedures: dict[int, Callable[[tuple[str, ...]], Answer]] = {
            0: lambda params: (OK, ()),
            107: self._set_precision,
            108: lambda params: (OK, (str(self._digits),)),
            110: lambda params: (OK, ("1", "0", "0")),
            2003: self._angles_in_full,
            2008: self._do_measure,
            2023: lambda params: (OK, (self._text(self.head.prism_mm / 1000.0),)),
            2024: self._set_prism,
            2026: lambda params: (OK, (str(self.head.face - 1),)),
            2028: self._set_air,
            2029: self._get_air,
            2107: lambda params: (OK, self._angles()),
            5003: lambda params: (OK, (str(self.serial_number),)),
            5004: lambda params: (OK, (f'"{self.name}"',)),
            5034: lambda params: (OK, ("1", "0", "0")),
            9027: self._make_positioning,
            9028: self._change_face,
            9029: self._search,
            9037: self._fine_adjust,
            18005: self._set_atr,
        }
        self._measurements: dict[int, Callable[[], tuple[str, ...]]] = {
            2082: self._coordinates,
            2108: lambda: (*self._angles(), self._distance()),
            2167: self._full,
            17017: lambda: (*self._angles(), self._distance()),
        }
        wire.on_bytes = self._receive

    # lines ------------------------------------------------------------------------------------------------------
    def _receive(self, data: bytes) -> None:
        *lines, self._input = (self._input + data).split(b"\n")
        self._input = self._input[-INPUT_LIMIT:]
        for line in lines:
            text = line.decode("latin-1").strip()
            if text == "c":
                self._abort()
            elif text:
                self._obey(text)

    def _abort(self) -> None:
        """The motor stops where it is; the function that ran answers that it was aborted."""
        if self._turning is not None:
            timer, call = self._turning
            timer.cancel()
            self._turning = None
            self._reply(call, OK, (ABORTED, ()))
        self._out.send(b"?\r\n")

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
            if call.rpc in self.faults.missing:
                self._reply(call, NOT_AVAILABLE, (OK, ()))
            elif call.rpc in self._measurements:
                self._measure(call)
            elif call.rpc in MOTOR and self.faults.turn_s > 0.0:
                self._turning = (self._loop.call_later(self.faults.turn_s, self._turned, call), call)
            elif call.rpc in self._procedures:
                self._reply(call, OK, self._procedures[call.rpc](call.params))
            else:
                self._reply(call, NOT_AVAILABLE, (OK, ()))
        except (ValueError, IndexError):
            self._reply(call, OK, (BAD_PARAMETER, ()))

    def _turned(self, call: _Call) -> None:
        self._turning = None
        try:
            self._reply(call, OK, self._procedures[call.rpc](call.params))
        except (ValueError, IndexError):
            self._reply(call, OK, (BAD_PARAMETER, ()))

    def _reply(self, call: _Call, com: int, answer: Answer) -> None:
        trid = self._previous_trid if self.faults.wrong_trid else call.trid
        self._previous_trid = call.trid
        code = self.faults.codes.get(call.rpc, answer[0])
        head = f"%R1P,{self.faults.com_code or com},{trid}"
        tail = ":" + ",".join((str(code), *answer[1]))
        crc = ""
        if call.has_crc:
            crc = f",{checksum((head + tail).encode('ascii')) ^ (1 if self.faults.bad_crc else 0)}"
        end = "\r" if self.faults.carriage_return_only else "\r\n"
        self._out.send((head + crc + tail + end).encode("ascii"))

    # settings ---------------------------------------------------------------------------------------------------
    def _set_precision(self, params: tuple[str, ...]) -> Answer:
        digits = int(params[0])
        if not 0 <= digits <= 15:
            return BAD_PARAMETER, ()
        self._digits = digits
        return OK, ()

    def _set_atr(self, params: tuple[str, ...]) -> Answer:
        self.head.atr = params[0] == "1"
        return OK, ()

    def _set_prism(self, params: tuple[str, ...]) -> Answer:
        metres = float(params[0])
        if not -1.0 < metres < 1.0:
            return BAD_PARAMETER, ()
        if 2024 not in self.faults.ignores:
            self.head.prism_mm = metres * 1000.0
        return OK, ()

    def _set_air(self, params: tuple[str, ...]) -> Answer:
        wavelength, pressure, dry, wet = (float(p) for p in params)
        if not (500.0 < pressure < 1500.0 and -40.0 <= wet <= dry <= 60.0):
            return BAD_PARAMETER, ()
        if 2028 not in self.faults.ignores:
            self._wavelength_um, self.head.air = wavelength, Air(pressure, dry, wet)
        return OK, ()

    def _get_air(self, params: tuple[str, ...]) -> Answer:
        air = self.head.air
        return OK, tuple(self._text(v) for v in (self._wavelength_um, air.pressure_hpa, air.dry_c, air.wet_c))

    # motors -----------------------------------------------------------------------------------------------------
    def _make_positioning(self, params: tuple[str, ...]) -> Answer:
        hz, v = float(params[0]), float(params[1])
        if not (math.isfinite(hz) and 0.0 <= v < FULL_TURN):
            return BAD_PARAMETER, ()
        self.head.turn(hz, v)
        return self._seek() if params[3] == "1" else (OK, ())

    def _change_face(self, params: tuple[str, ...]) -> Answer:
        self.head.change_face()
        return self._seek() if params[1] == "1" else (OK, ())

    def _fine_adjust(self, params: tuple[str, ...]) -> Answer:
        if not (float(params[0]) > 0.0 and float(params[1]) > 0.0):
            return BAD_PARAMETER, ()
        return self._seek()

    def _search(self, params: tuple[str, ...]) -> Answer:
        window = float(params[0]), float(params[1])
        if not (0.0 < window[0] <= FULL_TURN and 0.0 < window[1] <= FULL_TURN):
            return BAD_PARAMETER, ()
        if not self.head.atr:
            return ATR_OFF, ()
        return (OK if self.head.search(window, self._loop.time()) else NO_REFLECTOR), ()

    def _seek(self) -> Answer:
        if not self.head.atr:
            return ATR_OFF, ()
        return (OK if self.head.seek(self._loop.time()) else NO_REFLECTOR), ()

    # measurements -----------------------------------------------------------------------------------------------
    def _do_measure(self, params: tuple[str, ...]) -> Answer:
        command = int(params[0])
        self.head.keeps_distance = self.faults.stale_distance
        if command == 1:
            self.head.start_distance(self._loop.time())
        elif command in (0, 3):
            self.head.clear_distance()
        else:
            return BAD_PARAMETER, ()
        return OK, ()

    def _measure(self, call: _Call) -> None:
        """Wait for the distance up to the wait time of the call; MeasDistanceAngle starts one and waits for it."""
        first = int(call.params[0])
        if call.rpc == 17017:
            self._do_measure(("1",))
            wait_s = self.head.optics.measure_s
        else:
            wait_s = first / 1000.0
        rest_s = min(wait_s, max(0.0, self.head.distance.due_s - self._loop.time()))
        self._loop.call_later(rest_s, self._answer_measurement, call)

    def _answer_measurement(self, call: _Call) -> None:
        shot = self.head.finish_distance(self._loop.time())
        tail = call.params[:1] if call.rpc == 17017 else ()
        if shot is None or shot.status == "no-target":
            self._reply(call, OK, (ANGLES_ONLY, (*self._without_distance(call.rpc), *tail)))
            return
        code = ACCURACY_NOT_GUARANTEED if shot.status == "inaccurate" else OK
        self._reply(call, OK, (self.faults.measure_code or code, (*self._measurements[call.rpc](), *tail)))

    def _without_distance(self, rpc: int) -> tuple[str, ...]:
        """What a measurement returns when only the angles are known: every length reads zero."""
        zero = self._text(0.0)
        if rpc == 2082:
            return (zero, zero, zero, "0") * 2
        return (*self._angles(), *self._accuracies(), zero, "0") if rpc == 2167 else (*self._angles(), zero)

    def _angles(self) -> tuple[str, str]:
        return self._text(self.head.hz), self._text(self.head.v)

    def _accuracies(self) -> tuple[str, ...]:
        """Accuracy of the angles, cross and length tilt, accuracy of the tilts."""
        sigma = self.faults.sigma_angle_rad
        return self._text(sigma), self._text(0.0), self._text(0.0), self._text(SIGMA_TILT_RAD)

    def _angles_in_full(self, params: tuple[str, ...]) -> Answer:
        sigma, cross, length, sigma_tilt = self._accuracies()
        now = str(self._milliseconds(self._loop.time()))
        tilts = (cross, length, sigma_tilt, now)
        return OK, (*self._angles(), sigma, now, *tilts, str(self.head.face - 1))

    def _distance(self) -> str:
        return self._text(0.0 if self.faults.zero else self.head.distance.slope_m)

    def _full(self) -> tuple[str, ...]:
        taken = self._milliseconds(self.head.distance.taken_s)
        return (*self._angles(), *self._accuracies(), self._distance(), str(taken))

    def _coordinates(self) -> tuple[str, ...]:
        """East, north, height and time, once as measured and once as followed since; the mount does not follow."""
        slope = 0.0 if self.faults.zero else self.head.distance.slope_m
        across = slope * math.sin(self.head.v)
        east, north = across * math.sin(self.head.hz), across * math.cos(self.head.hz)
        taken = str(self._milliseconds(self.head.distance.taken_s))
        point = (self._text(east), self._text(north), self._text(slope * math.cos(self.head.v)), taken)
        return point * 2

    def _milliseconds(self, t_s: float) -> int:
        """The instrument's clock: milliseconds since it was switched on, in 32 bits."""
        return round((t_s + self.faults.clock_s) * 1000.0) % 2**32

    def _text(self, value: float) -> str:
        return f"{value:.{self._digits}f}"
