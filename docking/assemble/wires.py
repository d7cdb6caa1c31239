"""The near ends of a cell's wires, at the addresses of the cell file or of simulated devices."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from docking.config import CellFile
from docking.ports import CanLink, SerialLink
from docking.transcript import TranscribedCan, TranscribedSerial, Transcript
from drivers.canopen.channels import ChannelledCan
from drivers.canopen.nodes import channel_of_node
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
    bus, paths = cell.bus, found.get("can")
    if isinstance(paths, str):
        paths = {bus.channel: paths}
    interface = bus.interface if paths is None else "docking-unix"
    at = {channel: channel for channel in bus.channels} if paths is None else paths
    links = {channel: CanBusLink(interface, at[channel], bus.bitrate) for channel in bus.channels}
    return can_of(cell, links), addresses


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
