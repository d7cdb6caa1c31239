"""Looks at a CAN bus: who answers, what drives and I/O modules say of themselves. Reads only.

Where a controller sends SYNC the cyclic frames are listened to; elsewhere the values are read by SDO. A running
controller hears answers that it did not ask for; it drops them.
"""

from __future__ import annotations

import asyncio
import math
import struct
from collections.abc import Mapping

from docking.config.cell import CellFile
from docking.config.inputs import CanModule
from docking.errors import DockingError
from docking.ports import CanFrame, CanLink
from docking.types import Identity
from drivers.canopen import cia402, codec
from drivers.canopen.identity import DriveProof
from drivers.canopen.nodes import AxisNode, axis_nodes, can_bus_of
from drivers.canopen.sdo import SdoClient
from drivers.look import AxisValue, Found, Stopwatch
from drivers.maps.io_modules import load_can_io
from drivers.maps.objects import ObjectEntry, load_object_map

LISTEN_S = 0.3
"""How long the bus is listened to before anything is asked."""
ANSWER_S = 0.3
ROUND_TRIPS = 10
HIGHEST_NODE = 127
NETWORK_STATES = {0: "boot-up", 4: "stopped", 5: "operational", 127: "pre-operational"}
_READ_BACK = struct.Struct("<Hih")


class _Timed(SdoClient):
    """An SDO client that keeps how long its answers took."""

    watch: Stopwatch

    async def read_bytes(self, entry: ObjectEntry) -> bytes:
        return await self.watch.time(super().read_bytes(entry))


class BusLook:
    """The bus of a cell. `syncs` counts the SYNCs heard, `heard` holds the newest frame of each identifier."""

    def __init__(self, cell: CellFile, link: CanLink) -> None:
        self._cell, self._bus, self._link = cell, can_bus_of(cell), link
        self._map = load_object_map(self._bus.map)
        self.nodes = axis_nodes(cell, self._map.host_node)
        self.modules = [m for m in cell.inputs.modules if isinstance(m, CanModule)] if cell.inputs else []
        self.syncs = 0
        self.heard: dict[int, bytes] = {}
        self._clients: dict[int, _Timed] = {}
        self._open = False

    async def open(self) -> None:
        """Join the bus and listen for a while. Raises PortMissing."""
        self._link.on_frames = self._arrived
        await self._link.open()
        self._open = True
        await asyncio.sleep(LISTEN_S)

    def close(self) -> None:
        if self._open:
            self._open = False
            self._link.close()

    @property
    def controlled(self) -> bool:
        """True where a controller sends SYNC."""
        return self.syncs > 1

    def _arrived(self, batch: list[CanFrame]) -> None:
        for cob, data in batch:
            self.syncs += cob == codec.COB_SYNC
            self.heard[cob] = data
            client = self._clients.get(cob - codec.COB_SDO_REPLY)
            if client is not None:
                client.on_reply(data)

    def _client(self, where: str, node: int) -> _Timed:
        client = self._clients.get(node)
        if client is None:
            client = _Timed(where, node, self._link.send, self._map.abort_text, ANSWER_S)
            client.watch = Stopwatch()
            self._clients[node] = client
        return client

    # who is there ------------------------------------------------------------------------------------------------
    async def answering(self) -> tuple[int, ...]:
        """Every node number that answers, of all that there can be."""
        names = {node.node: node.name for node in self.nodes} | {m.node: m.name for m in self.modules}
        entry = self._map.objects["device_type"]

        async def ask(node: int) -> int:
            try:
                await self._client(names.get(node, f"node {node}"), node).read(entry)
            except DockingError:
                return 0
            return node

        found = await asyncio.gather(*(ask(node) for node in range(1, HIGHEST_NODE)))
        return tuple(node for node in found if node)

    async def find(self) -> tuple[Found, ...]:
        """Every axis and module of the cell, then every node that belongs to none of them."""
        there = await self.answering()
        drives = [await self._drive(node) for node in self.nodes]
        modules = [await self._module(module) for module in self.modules]
        known = {node.node for node in self.nodes} | {module.node for module in self.modules}
        others = [await self._stranger(node) for node in there if node not in known]
        return (*drives, *modules, *others)

    async def _drive(self, node: AxisNode) -> Found:
        sdo, objects = self._client(node.name, node.node), self._map.objects
        address, identity, problem = f"node {node.node}", None, None
        state = watchdog = units = ""
        try:
            word = await sdo.read(objects["statusword"])
            state = f"{cia402.decode(word).value}, {self._network_state(node.node)}"
            watchdog = await self._watchdog(sdo)
            counts = await sdo.read(objects["position"])
            units = f"{self._bus.counts_per_mm:g} counts/mm, stands at {counts / self._bus.counts_per_mm:.3f} mm"
            for _ in range(ROUND_TRIPS):
                await sdo.read(objects["statusword"])
            proof = DriveProof(node, self._bus, self._map, sdo)
            identity = await proof.who()
            await proof.scale()
        except DockingError as error:
            problem = error
            identity = identity or await self._said(node.name, sdo)
        return Found(node.name, address, identity, state, units, watchdog, tuple(sdo.watch.taken_s), problem)

    async def _watchdog(self, sdo: SdoClient) -> str:
        objects = self._map.objects
        consumer = await sdo.read(objects["consumer_heartbeat"])
        beat_ms = await sdo.read(objects["producer_heartbeat"])
        host, wait_ms = consumer >> 16 & 0x7F, consumer & 0xFFFF
        guard = f"stops {wait_ms} ms after node {host}" if host and wait_ms else "off until the bring-up sets it"
        return f"{guard}; own heartbeat {f'{beat_ms} ms' if beat_ms else 'off'}"

    async def _module(self, module: CanModule) -> Found:
        where, layout = f"input module {module.name}", load_can_io(module.map)
        sdo = self._client(where, module.node)
        identity, problem, units = None, None, ""
        try:
            contacts = 8 * await sdo.read(layout.objects["digital_count"])
            units = f"{contacts} contacts, {await sdo.read(layout.objects['analogue_count'])} analogue inputs"
            identity = await self._said(where, sdo)
        except DockingError as error:
            problem = error
        state = self._network_state(module.node) if problem is None else ""
        beat = f"repeats every {1e3 * module.refresh_s:.0f} ms once brought up"
        return Found(where, f"node {module.node}", identity, state, units, beat, tuple(sdo.watch.taken_s), problem)

    async def _stranger(self, node: int) -> Found:
        where = f"node {node}"
        sdo = self._client(where, node)
        identity = await self._said(where, sdo)
        return Found("not in the cell", where, identity, self._network_state(node), "", "", tuple(sdo.watch.taken_s))

    async def _said(self, where: str, sdo: SdoClient) -> Identity | None:
        """What a node says of itself, whether it is the right one or not; None where it does not."""
        objects = self._map.objects
        try:
            numbers = [await sdo.read(objects[name]) for name in ("vendor", "product", "revision", "serial")]
            name, version = [await sdo.read_text(objects[name]) for name in ("device_name", "software_version")]
        except DockingError:
            return None
        vendor, product, revision, serial = numbers
        firmware = f"{version} revision {revision:08X}h".strip()
        return Identity(where, f"{vendor:08X}h", f"{name} {product:08X}h".strip(), str(serial), firmware)

    def _network_state(self, node: int) -> str:
        beat = self.heard.get(codec.COB_HEARTBEAT + node, b"")
        return NETWORK_STATES.get(beat[0] & 0x7F, f"state {beat[0]}") if beat else "no heartbeat"

    # values ------------------------------------------------------------------------------------------------------
    async def axes(self) -> tuple[AxisValue, ...]:
        """Where every axis stands: from the cyclic frames, or by SDO where nobody asks for them."""
        if self.controlled:
            return tuple(self._listened(node) for node in self.nodes)
        return tuple([await self._asked(node) for node in self.nodes])

    def _listened(self, node: AxisNode) -> AxisValue:
        data = self.heard.get(self._map.pdos["read_back"].cob + node.node, b"")
        if len(data) != _READ_BACK.size:
            return AxisValue(node.name, "silent", math.nan, math.nan, math.nan)
        word, position, error = _READ_BACK.unpack(data)
        force = self.heard.get(self._map.pdos["force"].cob + node.node, b"")
        counts = int.from_bytes(force, "little", signed=True) if len(force) == 2 else None
        per_mm = self._bus.counts_per_mm
        return AxisValue(
            node.name, cia402.decode(word).value, position / per_mm, error / per_mm, self._newtons(node, counts)
        )

    async def _asked(self, node: AxisNode) -> AxisValue:
        sdo, objects = self._client(node.name, node.node), self._map.objects
        try:
            word = await sdo.read(objects["statusword"])
            position, error = await sdo.read(objects["position"]), await sdo.read(objects["following_error"])
            counts = await sdo.read(objects["force"]) if node.load_cell else None
        except DockingError as problem:
            return AxisValue(node.name, str(problem), math.nan, math.nan, math.nan)
        per_mm = self._bus.counts_per_mm
        return AxisValue(
            node.name, cia402.decode(word).value, position / per_mm, error / per_mm, self._newtons(node, counts)
        )

    def _newtons(self, node: AxisNode, counts: int | None) -> float:
        known = counts is not None and counts != -32768 and node.load_cell
        return counts * self._map.newton_per_count if known and counts is not None else math.nan

    async def inputs(self) -> Mapping[str, tuple[bytes, tuple[int | None, ...]]]:
        """Levels and counts of every I/O module; empty where it does not answer."""
        found: dict[str, tuple[bytes, tuple[int | None, ...]]] = {}
        for module in self.modules:
            layout, sdo = load_can_io(module.map), self._client(f"input module {module.name}", module.node)
            blocks = [ObjectEntry("contacts", 0x6000, sub, "u8") for sub in range(1, layout.digital_blocks + 1)]
            words = [ObjectEntry("analogue", 0x6401, sub, "i16") for sub in range(1, layout.analogue_inputs + 1)]
            try:
                levels = bytes([await sdo.read(entry) for entry in blocks])
                counts = [await sdo.read(entry) for entry in words]
            except DockingError:
                found[module.name] = (b"", ())
                continue
            found[module.name] = (levels, tuple(None if value == layout.broken else value for value in counts))
        return found
