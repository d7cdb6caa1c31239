"""A simulated NDI camera: the Combined API (ASCII) over a serial line, around a scene of tools and markers.

As a real one it keeps its line speed, answers 10 (not initialised) before INIT, gives handles to tools, takes their
definitions block by block, counts its exposures from power-up and tells the last one when it is asked. Faults are
attributes of `faults`, to be set while it runs.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from sim.tracker.crc import checksum
from sim.tracker.faults import FaultySender, WireFaults
from sim.tracker.ndi_exposure import Exposure, Scene, expose, stray_text, tool_text
from sim.wires.pacing import BITS_PER_BYTE, SpeedEnd

INPUT_LIMIT = 4096
POWER_UP_BAUD = 9600
RESET_S = 0.4
BAUDS = {"0": 9600, "1": 14400, "2": 19200, "3": 38400, "4": 57600, "5": 115200, "6": 921600, "7": 1228739, "A": 230400}
VERSION = "Simulated camera control\nNDI S/N: SIM-0001\nCharacterization Date: 01/02/26\nFreeze Tag: 1.002.003\n"
OCCUPIED, INITIALISED, ENABLED = 0x01, 0x10, 0x20

_CHECKED = re.compile(r"([A-Z]+):(.*)([0-9A-F]{4})")
_PLAIN = re.compile(r"([A-Z]+)(?: (.*))?")


@dataclass
class NdiFaults(WireFaults):
    """Run-time faults; each stays until it is set back."""

    missing: set[str] = field(default_factory=set)
    """tools that the camera does not see"""
    outside: set[str] = field(default_factory=set)
    """tools seen outside the volume in which the accuracy holds"""
    errors: dict[str, int] = field(default_factory=dict)
    """command -> error code in place of its answer"""
    ignores: set[str] = field(default_factory=set)
    """commands that are answered by OKAY and not carried out"""
    frozen: bool = False
    """the exposures stand still"""
    stale: bool = False
    """the exposures count up and show what the one before them showed"""
    occluded: bool = False
    """nothing is seen: no tool, no marker"""
    swapped: dict[str, str] = field(default_factory=dict)
    """tool -> the tool whose place it is told at"""
    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """added to every place, in the camera's frame: somebody has pushed it"""
    system_status: int = 0
    """bits of the system status"""


class Refused(Exception):
    """The command is answered by ERROR and this code."""

    def __init__(self, code: int) -> None:
        self.code = code
        super().__init__(f"{code:02X}")


@dataclass
class _Handle:
    """A place for one tool; `tool` is its name in the scene once its definition is known."""

    tool: str = ""
    rom: bytearray = field(default_factory=bytearray)
    status: int = OCCUPIED


class NdiCamera:
    """The camera on `wire`, seeing `scene`. `roms`: definition -> tool of the scene; `plugged`: tools on its ports."""

    kind = "camera"

    def __init__(
        self,
        scene: Scene,
        wire: SpeedEnd,
        loop: asyncio.AbstractEventLoop,
        roms: dict[bytes, str],
        plugged: tuple[str, ...] = (),
        seed: int = 0,
    ) -> None:
        self.faults = NdiFaults()
        self.rate_hz = 60.0
        self.noise_mm = 0.05
        self._scene, self._wire, self._loop, self._seed = scene, wire, loop, seed
        self._out = FaultySender(wire, loop, self.faults, seed)
        self._roms, self._plugged = roms, plugged
        self._commands: dict[str, Callable[[str], str]] = {
            "INIT": self._init,
            "COMM": self._comm,
            "VER": lambda params: VERSION,
            "ECHO": lambda params: params,
            "PHSR": self._search,
            "PHRQ": self._request,
            "PVWR": self._write_rom,
            "PINIT": self._initialise,
            "PENA": self._enable,
            "PDIS": self._disable,
            "PHF": self._free,
            "PHINF": self._information,
            "TSTART": self._start,
            "TSTOP": self._stop,
            "TX": self._tracking_data,
        }
        wire.on_bytes, wire.on_break = self._receive, self.reset
        self._power_up()

    def reset(self) -> None:
        """A break, or the mains: everything is forgotten, the line runs at its first speed, and it says so."""
        self._power_up()
        self._loop.call_later(RESET_S, self._reply, "RESET")

    def _power_up(self) -> None:
        self._wire.set_baud(POWER_UP_BAUD)
        self._baud = POWER_UP_BAUD
        self._input = b""
        self._ready = self._tracking = False
        self._handles: dict[str, _Handle] = {f"{i + 1:02X}": _Handle(tool) for i, tool in enumerate(self._plugged)}
        self._on_since_s = self._loop.time()
        self._last = Exposure(0, {}, [])

    # line -------------------------------------------------------------------------------------------------------
    def _receive(self, data: bytes) -> None:
        *lines, self._input = (self._input + data).split(b"\r")
        self._input = self._input[-INPUT_LIMIT:]
        for line in lines:
            if line:
                self._obey(line.decode("latin-1"))

    def _obey(self, text: str) -> None:
        try:
            name, params = _command(text)
            answer = self._answer(name, params)
        except Refused as refused:
            answer = f"ERROR{refused.code:02X}"
        except ValueError:
            answer = "ERROR07"
        self._reply(answer)

    def _answer(self, name: str, params: str) -> str:
        if name == "RESET":
            self._power_up()
            return "RESET"
        if name in self.faults.errors:
            raise Refused(self.faults.errors[name])
        if name not in self._commands:
            raise Refused(0x01)
        if not self._ready and name not in ("INIT", "COMM", "VER", "ECHO"):
            raise Refused(0x10)
        if (name == "TX") != self._tracking and name in ("TX", "TSTART", "PINIT", "PENA", "PHRQ", "PVWR"):
            raise Refused(0x0C)
        if name in self.faults.ignores:
            return "OKAY"
        return self._commands[name](params)

    def _reply(self, text: str) -> None:
        raw = text.encode("ascii")
        self._out.send(raw + b"%04X\r" % (checksum(raw) ^ (1 if self.faults.bad_crc else 0)))

    # commands ---------------------------------------------------------------------------------------------------
    def _init(self, params: str) -> str:
        self._ready, self._tracking = True, False
        return "OKAY"

    def _comm(self, params: str) -> str:
        if len(params) != 5 or params[0] not in BAUDS or params[1:] != "0000":
            raise Refused(0x06)
        baud = BAUDS[params[0]]
        # The answer leaves at the speed of the question.
        self._loop.call_later(10 * BITS_PER_BYTE / self._baud, self._switch, baud)
        return "OKAY"

    def _switch(self, baud: int) -> None:
        self._baud = baud
        self._wire.set_baud(baud)

    def _search(self, params: str) -> str:
        def wanted(handle: _Handle) -> bool:
            is_ready, is_on = handle.status & INITIALISED, handle.status & ENABLED
            if params == "01":
                return not handle.status & OCCUPIED
            if params == "02":
                return bool(handle.status & OCCUPIED) and not is_ready
            return bool(is_ready and not is_on) if params == "03" else bool(is_on)

        listed = {k: h for k, h in self._handles.items() if params in ("", "00") or wanted(h)}
        return f"{len(listed):02X}" + "".join(f"{key}{handle.status:03X}" for key, handle in listed.items())

    def _request(self, params: str) -> str:
        key = next(f"{n:02X}" for n in range(1, 256) if f"{n:02X}" not in self._handles)
        self._handles[key] = _Handle()
        return key

    def _write_rom(self, params: str) -> str:
        handle, at, data = self._handle(params[:2]), int(params[2:6], 16), bytes.fromhex(params[6:])
        if len(data) != 64:
            raise Refused(0x07)
        handle.rom[at : at + 64] = data
        return "OKAY"

    def _initialise(self, params: str) -> str:
        handle = self._handle(params)
        if not handle.tool:
            handle.tool = self._roms.get(bytes(handle.rom).rstrip(b"\0"), "")
        if not handle.tool:
            raise Refused(0x13)
        handle.status |= INITIALISED
        return "OKAY"

    def _enable(self, params: str) -> str:
        handle = self._handle(params[:2])
        if params[2:] not in ("S", "D", "B"):
            raise Refused(0x09)
        if not handle.status & INITIALISED:
            raise Refused(0x0E)
        handle.status |= ENABLED
        return "OKAY"

    def _disable(self, params: str) -> str:
        self._handle(params).status &= ~ENABLED
        return "OKAY"

    def _free(self, params: str) -> str:
        self._handle(params)
        del self._handles[params]
        return "OKAY"

    def _information(self, params: str) -> str:
        if params[2:] not in ("", "0001", "0004"):
            raise Refused(0x23)
        handle = self._handle(params[:2])
        if params[2:] == "0004":
            return handle.tool[:20].ljust(20)
        return f"01000000{'Simulated':<12}00100000001{handle.status & 0xFF:02X}"

    def _handle(self, key: str) -> _Handle:
        if key not in self._handles:
            raise Refused(0x08)
        return self._handles[key]

    # tracking ---------------------------------------------------------------------------------------------------
    def _start(self, params: str) -> str:
        self._tracking = True
        return "OKAY"

    def _stop(self, params: str) -> str:
        self._tracking = False
        return "OKAY"

    def _tracking_data(self, params: str) -> str:
        options = int(params or "1", 16)
        if options & ~0x1001:
            raise Refused(0x23)
        number = int((self._loop.time() - self._on_since_s) * self.rate_hz) + 1
        if number != self._last.number and not self.faults.frozen:
            seen = expose(self._scene, number, self._loop.time(), self.noise_mm, self._seed)
            self._last = Exposure(number, self._last.tools, self._last.strays_mm) if self.faults.stale else seen
        listed = {key: handle for key, handle in self._handles.items() if handle.status & INITIALISED}
        tools = "".join(self._tool(key, handle) for key, handle in listed.items())
        markers = [] if self.faults.occluded else [row + self.faults.shift_mm for row in self._last.strays_mm]
        strays = stray_text(markers) if options & 0x1000 else ""
        return f"{len(listed):02X}{tools}{strays}{self.faults.system_status:04X}"

    def _tool(self, key: str, handle: _Handle) -> str:
        if not handle.status & ENABLED:
            return f"{key}DISABLED{handle.status:08X}{self._last.number:08X}\n"
        faults = self.faults
        seen = self._last.tools.get(faults.swapped.get(handle.tool, handle.tool))
        if seen is None or faults.occluded or handle.tool in faults.missing:
            return f"{key}MISSING{handle.status:08X}{self._last.number:08X}\n"
        seen = replace(seen, p_mm=seen.p_mm + faults.shift_mm)
        status = handle.status | (0x40 if handle.tool in faults.outside else 0)
        return f"{key}{tool_text(seen)}{status:08X}{self._last.number:08X}\n"


def _command(text: str) -> tuple[str, str]:
    """Name and parameters of a command in either form."""
    checked = _CHECKED.fullmatch(text)
    if checked:
        if int(checked[3], 16) != checksum(text[:-4].encode("latin-1")):
            raise Refused(0x04)
        return checked[1], checked[2]
    plain = _PLAIN.fullmatch(text)
    if plain is None:
        raise Refused(0x01)
    return plain[1], plain[2] or ""
