"""The near ends of a cell's wires, at the addresses of the cell file or of simulated devices."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from docking.config import CellFile
from docking.config.cell import ModbusBus
from docking.live import LiveStreams
from docking.ports import CanLink, SerialLink
from docking.transcript import TranscribedCan, TranscribedSerial, Transcript
from drivers.canopen.channels import ChannelledCan
from drivers.canopen.nodes import channel_of_node
from drivers.links.can_bus import CanBusLink
from drivers.links.serial_port import SerialPort

Addresses = dict[str, tuple[str, int]]
LINE = "modbus"
"""Name of the positioners' serial line in transcripts and scenarios."""


@dataclass(frozen=True)
class NearBus:
    """The positioners' wire: a CAN bus, the serial line of all, or the addresses of PLCs; with those of Modbus inputs
    (None: as in the cell file)."""

    can: CanLink | None = None
    modbus: Addresses | None = None
    line: SerialLink | None = None

    def transcribed(self, transcript: Transcript | None) -> NearBus:
        """The same with all frames and bytes in the transcript; TCP connections are heard by their own taps."""
        if transcript is None:
            return self
        can = transcribed_can(self.can, transcript) if self.can is not None else None
        line = TranscribedSerial(self.line, transcript, LINE) if self.line is not None else None
        return NearBus(can, self.modbus, line)


@dataclass(frozen=True)
class Wires(NearBus):
    """The near ends of a cell's wires: the positioners' and the instrument's serial line; `streams`: the sensors that
    follow the part in a move, where the cell has `[live]`."""

    serial: SerialLink = field(kw_only=True)
    streams: LiveStreams | None = field(default=None, kw_only=True)


def near_bus(cell: CellFile, found: dict[str, Any]) -> NearBus:
    """The near end of the positioners' wire, at the addresses of the cell file or of simulated devices."""
    listed = found.get("modbus")
    addresses = {name: (str(host), int(port)) for name, (host, port) in listed.items()} if listed else None
    if cell.bus.kind != "canopen":
        return NearBus(modbus=addresses, line=_near_line(cell.bus, found))
    bus, paths = cell.bus, found.get("can")
    if isinstance(paths, str):
        paths = {bus.channel: paths}
    interface = bus.interface if paths is None else "docking-unix"
    at = {channel: channel for channel in bus.channels} if paths is None else paths
    links = {channel: CanBusLink(interface, at[channel], bus.bitrate) for channel in bus.channels}
    return NearBus(can_of(cell, links), addresses)


def _near_line(bus: ModbusBus, found: dict[str, Any]) -> SerialLink | None:
    if bus.line is None:
        return None
    if "line" in found:
        # The pseudo-terminal of simulated devices has no parity to set, and says so.
        return SerialPort(str(found["line"]), bus.baud, "Modbus line")
    return SerialPort(bus.line, bus.baud, "Modbus line", bus.framing)


def can_of(cell: CellFile, links: Mapping[str, CanLink]) -> CanLink:
    """One link for all CAN buses of a cell: the only one, or all of them behind one face. `links` by channel."""
    if len(links) == 1:
        return next(iter(links.values()))
    return ChannelledCan(links, channel_of_node(cell))


def transcribed_can(link: CanLink, transcript: Transcript) -> CanLink:
    """The link with every frame in the transcript, each bus under its own name."""
    if isinstance(link, ChannelledCan):
        return link.wrapped(lambda name, one: TranscribedCan(one, transcript, f"can:{name}"))
    return TranscribedCan(link, transcript)
