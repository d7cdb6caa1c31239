"""The near ends of a cell's wires, at the addresses of the cell file or of simulated devices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from docking.config import CellFile
from docking.ports import CanLink, SerialLink
from docking.transcript import TranscribedSerial, Transcript
from drivers.links.can_bus import CanBusLink
from drivers.links.serial_port import SerialPort

Addresses = dict[str, tuple[str, int]]


@dataclass(frozen=True)
class Wires:
    """The near ends of a cell's wires: a serial line, a CAN bus, the addresses of positioner PLCs and Modbus inputs."""

    serial: SerialLink
    can: CanLink | None = None
    modbus: Addresses | None = None


def transcribed_line(cell: CellFile, transcript: Transcript | None) -> SerialLink | None:
    """The serial line of all positioners with its bytes in the transcript; None where there is no such thing."""
    bus = cell.bus
    if transcript is None or bus.kind == "canopen" or bus.line is None:
        return None
    return TranscribedSerial(SerialPort(bus.line, bus.baud, "Modbus line"), transcript, "modbus")


def near_bus(cell: CellFile, found: dict[str, Any]) -> tuple[CanLink | None, Addresses | None]:
    """The positioners' wire: a CAN bus, or the addresses of PLCs; with those of Modbus inputs (None: as in the cell
    file)."""
    listed = found.get("modbus")
    addresses = {name: (str(host), int(port)) for name, (host, port) in listed.items()} if listed else None
    if cell.bus.kind != "canopen":
        return None, addresses
    if "can" in found:
        return CanBusLink("docking-unix", found["can"], cell.bus.bitrate), addresses
    return CanBusLink(cell.bus.interface, cell.bus.channel, cell.bus.bitrate), addresses
