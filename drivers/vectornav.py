"""A VectorNav inertial sensor over serial (ASCII): implements `docking.ports.InertialSensor`.

Bring-up: output off, identity, time stamps and error reports on, rate set; every register written is read back.
Samples carry the sensor's own time; the loop time at which they were taken is worked out from it.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from docking.config.instruments import InertialConfig
from docking.errors import BadReply, DeviceRefused, DeviceSilent, LinkError, LinkLost, ReadBackMismatch
from docking.ports import SerialLink
from docking.sightings import InertialSample
from docking.types import Identity
from drivers.device_clock import DeviceClock
from drivers.garbage import GarbageWatch
from drivers.vectornav_codec import (
    ASYNC_CODES,
    ASYNC_OFF,
    ASYNC_RATE,
    ASYNC_TYPE,
    CRC_DIGITS,
    ERROR_WORDS,
    FIRMWARE,
    MODEL,
    PROTOCOL,
    SERIAL,
    XOR_DIGITS,
    ErrorLine,
    Line,
    MotionLine,
    RegisterLine,
    VectorNavParser,
    encode,
)

REPLY_TIMEOUT_S = 0.5
ATTEMPTS = 3
SILENT_PERIODS = 10
SILENT_MIN_S = 0.5
OLD_S = 2.0
FROZEN_AFTER = 20
FORCE_LIMIT_M_S2 = 160.0
RATE_LIMIT_RAD_S = 35.0
SYNC_IN_TIME = "2"
SEND_ERRORS = "1"
FATAL_ERRORS = frozenset({1, 10})
CLOCK_US = 2**32


def _ignore(_: object) -> None:
    """Default sink until the user sets its own."""


@dataclass
class SampleCounts:
    """What became of lines that are no samples."""

    repeated: int = 0
    old: int = 0
    out_of_range: int = 0
    complaints: int = 0


class VectorNav:
    """`docking.ports.InertialSensor` on `link`. Error `where` is `name`."""

    def __init__(self, link: SerialLink, config: InertialConfig, name: str = "inertial sensor") -> None:
        self.on_sample: Callable[[InertialSample], None] = _ignore
        self.on_lost: Callable[[LinkError], None] = _ignore
        self.counts = SampleCounts()
        self._link, self._config, self._name = link, config, name
        self._parser = VectorNavParser()
        self._garbage = GarbageWatch()
        self._digits = XOR_DIGITS
        self._answer: tuple[tuple[str, int], asyncio.Future[RegisterLine]] | None = None
        self._lost: str | None = "not connected"
        self._streaming = False
        self._watch: asyncio.TimerHandle | None = None
        self._begin()

    @property
    def bad_lines(self) -> int:
        """Lines dropped for framing, checksum or grammar."""
        return self._parser.bad

    async def connect(self) -> Identity:
        """Stop the output, identify, set time stamps and rate, read all back.

        Raises PortMissing, DeviceSilent, DeviceRefused, BadReply, ReadBackMismatch or LinkLost.
        """
        self._link.on_bytes, self._link.on_lost = self._on_bytes, self._on_lost
        await self._link.open()
        self._lost = None
        self._parser.reset()
        self._garbage.reset()
        try:
            await self._find_checksum()
            model, serial, firmware = [await self._text(register) for register in (MODEL, SERIAL, FIRMWARE)]
            await self._set_protocol()
            await self._write(ASYNC_RATE, str(self._config.rate_hz))
        except BaseException:
            await self.close()
            raise
        return Identity(self._name, "VectorNav", model, serial, firmware)

    async def start(self) -> None:
        """Begin to stream; samples go to `on_sample`. Raises as `connect`."""
        self._begin()
        self._streaming = True
        try:
            await self._write(ASYNC_TYPE, str(ASYNC_CODES[self._config.message]))
        except BaseException:
            self._streaming = False
            raise
        self._look_again()

    async def stop(self) -> None:
        """End the stream. Raises as `connect`."""
        self._end()
        await self._write(ASYNC_TYPE, str(ASYNC_OFF))

    async def close(self) -> None:
        """Release the line; what the sensor sends on is not heard."""
        self._end()
        self._link.close()
        self._lost = "closed"
        self._fail(LinkLost(self._name, "closed"))

    def _begin(self) -> None:
        self._clock = DeviceClock()
        self._last_us: int | None = None
        self._device_us = 0
        self._values: tuple[float, ...] = ()
        self._same = 0
        self._heard_at_s = math.nan

    def _end(self) -> None:
        self._streaming = False
        if self._watch is not None:
            self._watch.cancel()
            self._watch = None

    # registers --------------------------------------------------------------------------------------------------
    async def _find_checksum(self) -> None:
        """Stop the output in the form of checksum that the sensor takes; from then on no other form is taken."""
        self._parser.digits = None
        for digits in (XOR_DIGITS, CRC_DIGITS):
            self._digits = digits
            try:
                await self._exchange("VNWRG", ASYNC_TYPE, (str(ASYNC_OFF),))
                break
            except (DeviceSilent, DeviceRefused) as error:
                if digits == CRC_DIGITS or (isinstance(error, DeviceRefused) and error.value != 3):
                    raise
        self._parser.digits = self._digits

    async def _set_protocol(self) -> None:
        """Append the time to every sample, report errors; the checksum stays as it is set in the sensor."""
        fields = (await self._exchange("VNRRG", PROTOCOL)).fields
        if len(fields) != 7:
            raise BadReply(self._name, "seven fields of register 30 expected", value=len(fields))
        if fields[4] == "0":
            raise DeviceRefused(self._name, "its serial checksum is switched off (register 30)", value=0)
        wanted = (SYNC_IN_TIME, "0", *fields[2:6], SEND_ERRORS)
        await self._write(PROTOCOL, *wanted)

    async def _write(self, register: int, *fields: str) -> None:
        """Write a register and read it back."""
        await self._exchange("VNWRG", register, fields)
        kept = (await self._exchange("VNRRG", register)).fields
        # Registers may answer with more than was written: the serial port that they are about.
        if kept[: len(fields)] != fields:
            raise ReadBackMismatch(self._name, f"register {register}", value=",".join(kept), limit=",".join(fields))

    async def _text(self, register: int) -> str:
        return ",".join((await self._exchange("VNRRG", register)).fields)

    async def _exchange(self, command: str, register: int, fields: tuple[str, ...] = ()) -> RegisterLine:
        """One read or write, asked again when the answer is lost: both may be repeated without harm."""
        for _ in range(ATTEMPTS):
            if self._lost is not None:
                raise LinkLost(self._name, self._lost)
            answer: asyncio.Future[RegisterLine] = asyncio.get_running_loop().create_future()
            self._answer = (command, register), answer
            try:
                self._link.write(encode(command, register, *fields, digits=self._digits))
                await asyncio.wait({answer}, timeout=REPLY_TIMEOUT_S)
                if answer.done():
                    return answer.result()
            finally:
                self._answer = None
        cause = f"no answer to {command} {register}; {self.bad_lines} bad lines and {self._parser.noise} bytes of noise"
        raise DeviceSilent(self._name, cause, limit=ATTEMPTS * REPLY_TIMEOUT_S)

    # stream -----------------------------------------------------------------------------------------------------
    def _on_bytes(self, data: bytes) -> None:
        now_s = asyncio.get_running_loop().time()
        bad_before = self._parser.bad
        for line in self._parser.feed(data):
            self._take(line, now_s)
        distrust = self._garbage.count(self._parser.bad - bad_before, now_s)
        if distrust:
            self._fail(BadReply(self._name, "garbage on the line", value=distrust))

    def _take(self, line: Line, now_s: float) -> None:
        if isinstance(line, MotionLine):
            if self._streaming:
                self._heard_at_s = now_s
                self._sample(line, now_s)
        elif isinstance(line, ErrorLine):
            self._complaint(line.code)
        elif isinstance(line, RegisterLine) and self._answer is not None:
            wanted, answer = self._answer
            if wanted == (line.command, line.register) and not answer.done():
                answer.set_result(line)

    def _sample(self, line: MotionLine, now_s: float) -> None:
        if line.time_us is None or line.kind != self._config.message:
            self.counts.out_of_range += 1
            return
        step_us = (line.time_us - self._last_us) % CLOCK_US if self._last_us is not None else 1
        if step_us == 0:
            self.counts.repeated += 1
            return
        if step_us > CLOCK_US // 2:
            self._fail(BadReply(self._name, "its clock ran backwards: it has restarted", value=line.time_us))
            return
        self._device_us += step_us if self._last_us is not None else line.time_us
        self._last_us = line.time_us
        force, rate = _force_and_rate(line)
        if not (max(map(abs, force)) <= FORCE_LIMIT_M_S2 and max(map(abs, rate)) <= RATE_LIMIT_RAD_S):
            self.counts.out_of_range += 1
            return
        if self._is_frozen(force + rate):
            self._fail(BadReply(self._name, f"{FROZEN_AFTER} samples alike: the sensor is frozen", value=force[0]))
            return
        t_s = self._clock.loop_s(self._device_us * 1e-6, now_s)
        if not now_s - t_s <= OLD_S:
            self.counts.old += 1
            return
        turned = np.radians(line.values[:3]) if line.kind == "VNYMR" else np.full(3, np.nan)
        self.on_sample(InertialSample(t_s, now_s, self._device_us * 1e-6, np.array(force), np.array(rate), turned))

    def _is_frozen(self, values: tuple[float, ...]) -> bool:
        self._same = self._same + 1 if values == self._values else 1
        self._values = values
        return self._same >= FROZEN_AFTER

    def _complaint(self, code: int) -> None:
        self.counts.complaints += 1
        refused = DeviceRefused(self._name, ERROR_WORDS.get(code, "unknown error code"), value=code)
        if self._answer is not None and not self._answer[1].done():
            self._answer[1].set_exception(refused)
        elif code in FATAL_ERRORS:
            self._fail(refused)

    def _look_again(self) -> None:
        """Twice in the permitted silence: has anything come?"""
        loop = asyncio.get_running_loop()
        limit_s = max(SILENT_MIN_S, SILENT_PERIODS / self._config.rate_hz)
        if math.isnan(self._heard_at_s):
            self._heard_at_s = loop.time()
        if loop.time() - self._heard_at_s >= limit_s:
            self._fail(DeviceSilent(self._name, f"no sample; {self.bad_lines} bad lines so far", limit=limit_s))
            return
        self._watch = loop.call_later(0.5 * limit_s, self._look_again)

    def _on_lost(self, reason: str) -> None:
        self._lost = reason
        self._fail(LinkLost(self._name, reason))

    def _fail(self, error: LinkError) -> None:
        """The call that waits ends with the error, else the stream does."""
        if self._answer is not None and not self._answer[1].done():
            self._answer[1].set_exception(error)
        elif self._streaming:
            self._end()
            self.on_lost(error)


def _force_and_rate(line: MotionLine) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Specific force (m/s^2) and turning rate (rad/s): behind attitude and magnetic field, or the field alone."""
    at = 6 if line.kind == "VNYMR" else 3
    return line.values[at : at + 3], line.values[at + 3 : at + 6]
