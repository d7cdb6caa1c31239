"""A CANopen I/O module (CiA 401): contacts and analogue inputs by TPDO."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable

from docking.config.inputs import CanModule
from docking.errors import DeviceSilent, ReadBackMismatch, WrongIdentity
from docking.ports import CanFrame, CanLink
from docking.types import Identity
from drivers.canopen import codec
from drivers.canopen.sdo import SdoClient
from drivers.inputs import SILENT_AFTER
from drivers.maps.io_modules import CanIoMap, InputPdo, load_can_io
from drivers.maps.objects import ObjectEntry

_COB_MASK = codec.COB_INVALID | 0x7FF


class CanIoModule:
    """`drivers.inputs.InputModule` over one node. `abort_text` words SDO abort codes.

    The module repeats its contacts every `refresh_s` and sends them at every change; it is silent when three repeats
    are missing, or after it has restarted, until it is brought up anew.
    """

    def __init__(self, config: CanModule, link: CanLink, abort_text: Callable[[int], str]) -> None:
        self.name, self._config, self._link = config.name, config, link
        self.on_change: Callable[[], None] = lambda: None
        self._map: CanIoMap = load_can_io(config.map)
        self.where = f"input module {config.name}"
        self._sdo = SdoClient(self.where, config.node, link.send, abort_text)
        self._levels, self._seen_s = b"", float("-inf")
        self._counts: list[int] = []
        self._heard = asyncio.Event()
        self._up = self._silent = False
        self._timer: asyncio.TimerHandle | None = None
        self._loop: asyncio.AbstractEventLoop

    @staticmethod
    def cobs(config: CanModule) -> frozenset[int]:
        """The identifiers that this module sends on."""
        pdos = load_can_io(config.map).pdos.values()
        return frozenset(
            base + config.node for base in (codec.COB_SDO_REPLY, codec.COB_HEARTBEAT, *(pdo.cob for pdo in pdos))
        )

    @property
    def silent(self) -> bool:
        return self._silent or not self._up

    @property
    def channels(self) -> tuple[int, int]:
        return 8 * len(self._levels), len(self._counts)

    def level(self, channel: int) -> bool:
        return bool(self._levels[channel // 8] >> channel % 8 & 1)

    def counts(self, channel: int) -> int | None:
        value = self._counts[channel]
        return None if value == self._map.broken else value

    async def bring_up(self) -> Identity:
        """Prove identity, write and read back how the module is to send, wait for its contacts.

        Raises PortMissing, DeviceSilent, DeviceRefused, BadReply, WrongIdentity, ReadBackMismatch: each names it.
        """
        self._loop = asyncio.get_running_loop()
        self._link.on_frames, self._link.on_lost = self._on_frames, self._on_lost
        await self._link.open()
        self._up = self._silent = False
        self._link.send([codec.nmt(codec.NMT_PRE_OPERATIONAL, self._config.node)])
        identity = await self._identify()
        for name, value in self._map.written:
            await self._write(self._map.objects[name], value)
        await self._map_pdos()
        await self._read_analogue()
        self._heard.clear()
        self._link.send([codec.nmt(codec.NMT_START, self._config.node)])
        await self._first_contacts()
        self._up = True
        self._timer = self._loop.call_later(self._config.refresh_s, self._check)
        return identity

    async def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._up = False
        self._link.close()

    # bring-up ----------------------------------------------------------------------------------------------------
    async def _identify(self) -> Identity:
        objects, read, node = self._map.objects, self._sdo.read, self._config.node
        found = {name: await read(objects[name]) for name in ("vendor", "product", "revision", "serial")}
        profile = await read(objects["device_type"]) & 0xFFFF
        wanted = {"device profile": (profile, self._map.device_profile)}
        wanted |= {name: (found[name], value) for name, value in self._map.identity.items()}
        for what, (value, expected) in wanted.items():
            if value != expected:
                raise WrongIdentity(self.where, f"{what} of node {node}", value=value, limit=expected)
        counts = await read(objects["digital_count"]), await read(objects["analogue_count"])
        for what, count, least in zip(
            ("blocks of 8 contacts", "analogue inputs"),
            counts,
            (self._map.digital_blocks, self._map.analogue_inputs),
            strict=True,
        ):
            if count < least:
                raise WrongIdentity(self.where, f"node {node}", value=f"{count} {what}", limit=f"{least} {what}")
        name, version = [await self._sdo.read_text(objects[name]) for name in ("device_name", "software_version")]
        product = f"{name} {found['product']:08X}h".strip()
        firmware = f"{version} revision {found['revision']:08X}h".strip()
        return Identity(self.where, f"{found['vendor']:08X}h", product, str(found["serial"]), firmware)

    async def _write(self, entry: ObjectEntry, value: int, mask: int = 0xFFFF_FFFF) -> None:
        await self._sdo.write(entry, value)
        found = await self._sdo.read(entry)
        if found & mask != value & mask:
            raise ReadBackMismatch(self.where, f"object {entry.label}", value=found, limit=value)

    async def _map_pdos(self) -> None:
        refresh_ms = round(1e3 * self._config.refresh_s)
        pdos = self._map.pdos
        await self._write(self._map.objects["producer_heartbeat"], refresh_ms)
        await self._map_pdo(pdos["digital"], self._map.digital_blocks, refresh_ms)
        await self._map_pdo(pdos["analogue"], self._map.analogue_inputs, refresh_ms * self._map.analogue_slower)

    async def _map_pdo(self, pdo: InputPdo, count: int, event_ms: int) -> None:
        """Off, described, on again (CiA 301)."""
        cob = ObjectEntry(f"{pdo.name}_cob", pdo.communication, 1, "u32")
        number = ObjectEntry(f"{pdo.name}_mapped", pdo.mapping, 0, "u8")
        await self._write(cob, (pdo.cob + self._config.node) | codec.COB_INVALID, _COB_MASK)
        await self._write(ObjectEntry(f"{pdo.name}_transmission", pdo.communication, 2, "u8"), pdo.transmission)
        await self._write(ObjectEntry(f"{pdo.name}_event_timer", pdo.communication, 5, "u16"), event_ms)
        await self._write(number, 0)
        for sub, word in enumerate(pdo.words(count), start=1):
            await self._write(ObjectEntry(f"{pdo.name}_entry_{sub}", pdo.mapping, sub, "u32"), word)
        await self._write(number, count)
        await self._write(cob, pdo.cob + self._config.node, _COB_MASK)

    async def _read_analogue(self) -> None:
        """Temperatures are there from the start, not after the first slow frame."""
        pdo = self._map.pdos["analogue"]
        subs = range(1, self._map.analogue_inputs + 1)
        entries = [ObjectEntry(f"analogue_{sub}", pdo.object, sub, "i16") for sub in subs]
        self._counts = [await self._sdo.read(entry) for entry in entries]

    async def _first_contacts(self) -> None:
        limit_s = SILENT_AFTER * self._config.refresh_s
        try:
            async with asyncio.timeout(limit_s):
                await self._heard.wait()
        except TimeoutError as error:
            cause = f"node {self._config.node} sends no contacts"
            raise DeviceSilent(self.where, cause, limit=limit_s) from error

    # frames ------------------------------------------------------------------------------------------------------
    def _on_frames(self, batch: list[CanFrame]) -> None:
        node, pdos = self._config.node, self._map.pdos
        for cob, data in batch:
            if cob == codec.COB_SDO_REPLY + node:
                self._sdo.on_reply(data)
            elif cob == pdos["digital"].cob + node and len(data) == self._map.digital_blocks:
                self._take_contacts(data)
            elif cob == pdos["analogue"].cob + node and len(data) == 2 * self._map.analogue_inputs:
                self._take_counts(list(struct.unpack(f"<{self._map.analogue_inputs}h", data)))
            elif cob == codec.COB_HEARTBEAT + node and data == b"\0" and self._up:
                self._fall_silent()

    def _take_contacts(self, data: bytes) -> None:
        self._seen_s = self._loop.time()
        self._heard.set()
        changed = data != self._levels or self._silent
        self._levels, self._silent = data, False
        if changed and self._up:
            self.on_change()

    def _take_counts(self, counts: list[int]) -> None:
        changed = counts != self._counts
        self._counts = counts
        if changed and self._up:
            self.on_change()

    def _check(self) -> None:
        self._timer = self._loop.call_later(self._config.refresh_s, self._check)
        if not (self._loop.time() - self._seen_s <= SILENT_AFTER * self._config.refresh_s):
            self._fall_silent()

    def _on_lost(self, reason: str) -> None:
        """The refresh time runs out: axes on the same wire tell first that it is gone."""

    def _fall_silent(self) -> None:
        if not self._silent:
            self._silent = True
            self.on_change()
