"""A gateway that puts a measuring instrument behind the tracker line protocol (docs/line-protocol.md).

    python line_gateway.py /dev/ttyUSB0 points.csv

Copy this file to the computer that runs the instrument's software and replace `PointsFromFile` by a class that calls
that software: the rest knows the wire, not the instrument. It needs Python 3.11 and pyserial, nothing else.

One request runs at a time. While the instrument measures, heartbeats tell the host that somebody is still there. What
arrives broken is dropped and never answered; a measurement that the host gives up is aborted on the instrument, too.
"""

from __future__ import annotations

import argparse
import csv
import re
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import serial

PROTOCOL_VERSION = 1
HEARTBEAT_S = 0.3
POLL_S = 0.02
LINE_MAX = 200
VALID, DEGRADED, SECOND_FACE = 1, 2, 16
UNKNOWN_REQUEST, BAD_ARGUMENT, NO_REFLECTOR, INSTRUMENT_FAULT = 1, 2, 10, 20
IDLE, MEASURING = 0, 1

REQUEST = re.compile(rb"\$([A-Z]{3},(0|[1-9]\d{0,4})((?:,[^,*$\r\n]*)*))\*([0-9A-F]{4})\r")
TARGET = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.\-]{0,31}")
COUNT = re.compile(r"[1-9]\d?")


@dataclass(frozen=True)
class Measured:
    """One point in the instrument's station frame, z upwards: coordinates and their standard deviations, mm."""

    xyz_mm: tuple[float, float, float]
    sigma_mm: tuple[float, float, float]
    degraded: bool = False


class NotFound(Exception):
    """There is no reflector where it should be, or the beam is broken."""


class Instrument(Protocol):
    """What a gateway asks of the software of an instrument. `measure` may block; `abort` is called from elsewhere."""

    vendor: str
    product: str
    serial_number: str
    firmware: str
    faces: tuple[int, ...]

    def measure(self, target: str, count: int, face: int) -> Measured:
        """Aim at `target`, average `count` readings. Raises NotFound."""
        ...

    def abort(self) -> None: ...


class PointsFromFile:
    """Stands in for an instrument: the lines NAME,x,y,z (mm) of a file, after as long as a reading takes."""

    vendor, product, serial_number, firmware = "Example", "Points from a file", "1", "1"
    faces: tuple[int, ...] = (1, 2)

    def __init__(self, path: Path, reading_s: float = 0.5) -> None:
        with path.open(newline="") as file:
            rows = [row for row in csv.reader(file) if len(row) == 4]
        self._points = {name: (float(x), float(y), float(z)) for name, x, y, z in rows}
        self._reading_s = reading_s
        self._aborted = False

    def measure(self, target: str, count: int, face: int) -> Measured:
        """The coordinates of the file; raises NotFound for a name that it does not hold."""
        self._aborted = False
        ready_s = time.monotonic() + count * self._reading_s
        while time.monotonic() < ready_s and not self._aborted:
            time.sleep(POLL_S)
        if target not in self._points:
            raise NotFound
        return Measured(self._points[target], (0.02, 0.02, 0.02))

    def abort(self) -> None:
        self._aborted = True


def crc16_arc(data: bytes) -> int:
    """CRC-16/ARC: 0xBB3D over b"123456789"."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc


def line(kind: str, *fields: object) -> bytes:
    """One line of the protocol."""
    body = ",".join(map(str, (kind, *fields))).encode("ascii")
    return b"$%b*%04X\r\n" % (body, crc16_arc(body))


@dataclass
class _Running:
    """The measurement that runs."""

    seq: int
    target: str
    face: int
    result: Future[Measured]


class Gateway:
    """The wire's side: requests in, replies out. `poll` is called again and again."""

    def __init__(self, instrument: Instrument, port: serial.Serial) -> None:
        self._instrument, self._port = instrument, port
        self._worker = ThreadPoolExecutor(1)
        self._input = b""
        self._running: _Running | None = None
        self._last: dict[str, tuple[object, ...]] = {}
        self._beats = 0
        self._beat_at_s = 0.0
        self._started_s = time.monotonic()

    def poll(self) -> None:
        """Take what has come in, answer what is done, beat while something runs."""
        *lines, rest = (self._input + self._port.read(max(1, self._port.in_waiting))).split(b"\n")
        self._input = rest[-LINE_MAX:]
        for text in lines:
            # A dollar sign opens a line wherever it stands: what came before it is noise.
            match = REQUEST.fullmatch(text[text.rfind(b"$") :])
            if match and crc16_arc(match[1]) == int(match[4], 16):
                self._obey(match[1][:3].decode(), int(match[2]), match[3].decode("ascii", "replace").split(",")[1:])
        if self._running is not None and self._running.result.done():
            self._answer(self._running)
        elif self._running is not None and time.monotonic() >= self._beat_at_s:
            self._beat()

    def _obey(self, kind: str, seq: int, fields: list[str]) -> None:
        tool = self._instrument
        if kind == "VER":
            self._send("IDN", seq, PROTOCOL_VERSION, tool.vendor, tool.product, tool.serial_number, tool.firmware)
        elif kind == "STP":
            self._give_up()
            self._send("ACK", seq)
        elif kind == "MEA":
            self._start(seq, fields)
        elif kind == "GET" and len(fields) == 1 and fields[0] in self._last:
            self._send("PNT", seq, *self._last[fields[0]])
        elif kind == "GET":
            self._send("ERR", seq, NO_REFLECTOR, "not measured yet")
        else:
            self._send("ERR", seq, UNKNOWN_REQUEST, f"{kind} is not offered")

    def _start(self, seq: int, fields: list[str]) -> None:
        target, count, face = (*fields, "1")[:3] if len(fields) in (2, 3) else ("", "", "")
        faces = [str(f) for f in self._instrument.faces]
        if not (TARGET.fullmatch(target) and COUNT.fullmatch(count) and face in faces):
            self._send("ERR", seq, BAD_ARGUMENT, "target, count or face")
            return
        self._give_up()
        result = self._worker.submit(self._instrument.measure, target, int(count), int(face))
        self._running = _Running(seq, target, int(face), result)
        self._beat()

    def _give_up(self) -> None:
        """The host wants nothing of the measurement that runs any more."""
        if self._running is not None:
            self._running = None
            self._instrument.abort()

    def _answer(self, run: _Running) -> None:
        self._running = None
        try:
            found = run.result.result()
        except NotFound:
            self._send("ERR", run.seq, NO_REFLECTOR, "no reflector found")
            return
        except Exception as error:  # noqa: BLE001 - whatever the instrument's software raises, the host has to hear
            words = re.sub(r"[^ -~]|[$*,]", " ", str(error))[:80]
            self._send("ERR", run.seq, INSTRUMENT_FAULT, words or type(error).__name__)
            return
        flags = VALID | (DEGRADED if found.degraded else 0) | (SECOND_FACE if run.face == 2 else 0)
        um = [round(value * 1000.0) for value in (*found.xyz_mm, *found.sigma_mm)]
        self._last[run.target] = (self._clock_us(), run.target, *um, flags)
        self._send("PNT", run.seq, *self._last[run.target])

    def _beat(self) -> None:
        self._beats = (self._beats + 1) % 65536
        self._beat_at_s = time.monotonic() + HEARTBEAT_S
        self._send("HBT", self._beats, self._clock_us(), MEASURING if self._running else IDLE)

    def _clock_us(self) -> int:
        return round((time.monotonic() - self._started_s) * 1e6)

    def _send(self, kind: str, *fields: object) -> None:
        self._port.write(line(kind, *fields))


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Gives the points of a file to a docking cell, as an instrument would."
    )
    parser.add_argument("port", help="any pyserial URL")
    parser.add_argument("points", type=Path, help="lines NAME,x,y,z in mm, station frame")
    parser.add_argument("--baud", type=int, default=115200)
    given = parser.parse_args()
    with serial.serial_for_url(given.port, baudrate=given.baud, timeout=POLL_S) as port:
        gateway = Gateway(PointsFromFile(given.points), port)
        while True:
            gateway.poll()


if __name__ == "__main__":
    main()
