"""Who a drive is, what it can do and how it counts: everything that is compared and never written."""

from __future__ import annotations

import math

from docking.config.cell import CanBus, DriveScale
from docking.errors import ReadBackMismatch, WrongIdentity
from docking.types import Identity
from drivers.canopen.nodes import AxisNode
from drivers.canopen.sdo import SdoClient
from drivers.maps.objects import ObjectMap

_WHO = ("vendor", "product", "revision", "serial")


class DriveProof:
    """Reads of one drive against the cell file and the object map. Every error names the axis and the object."""

    def __init__(self, node: AxisNode, bus: CanBus, omap: ObjectMap, sdo: SdoClient) -> None:
        self._node, self._bus, self._map, self._sdo = node, bus, omap, sdo
        self._holds_force = node.force_n is not None
        self.position_mode = next(mode for mode in omap.position_modes if mode.rests is bus.profile_position)

    async def who(self) -> Identity:
        """Prove device profile, vendor, product, revision and serial number, that nobody else answers, and the mode.

        Raises WrongIdentity, DeviceSilent, DeviceRefused, BadReply.
        """
        self._expect("device_type", await self._read("device_type") & 0xFFFF, self._map.device_profile)
        found = {name: await self._read(name) for name in _WHO}
        self.refuse_twin()
        stated = self._bus.identity
        wanted = {"vendor": stated.vendor, "product": stated.product, "revision": stated.revision}
        wanted["serial"] = self._node.axis.serial_number
        for name, value in (*self._map.identity.items(), *wanted.items()):
            if value is not None:
                self._expect(name, found[name], value)
        await self._prove_mode()
        product = f"{await self._text('device_name')} {found['product']:08X}h".strip()
        firmware = f"{await self._text('software_version')} revision {found['revision']:08X}h".strip()
        return Identity(self._node.name, f"{found['vendor']:08X}h", product, str(found["serial"]), firmware)

    async def scale(self) -> None:
        """Prove in which direction the drive counts and, where the cell states it, how much a millimetre is.

        Position units of a screw revolution are 6092h:01 / 6092h:02, motor revolutions of it 6091h:01 / 6091h:02,
        increments of a motor revolution 608Fh:01 / 608Fh:02 (CiA 402-2). Raises ReadBackMismatch, DeviceSilent,
        DeviceRefused, BadReply.
        """
        for name, value in self._map.proved.items():
            found = await self._read(name)
            if found != value:
                raise self._mismatch(name, found, value)
        if self._bus.scale is not None:
            await self._prove_ratios(self._bus.scale)

    def refuse_twin(self) -> None:
        """Raise WrongIdentity where more answers came than were asked for."""
        if self._sdo.stray:
            cause = f"{self._sdo.stray} answers too many: two devices use node number {self._node.node}"
            raise WrongIdentity(self._node.name, cause, value="two devices", limit="one device")

    async def _prove_ratios(self, scale: DriveScale) -> None:
        counts = self._bus.counts_per_mm * scale.mm_per_revolution
        for over, under, wanted in (
            ("encoder_increments", "encoder_revolutions", float(scale.encoder_increments)),
            ("gear_motor_revolutions", "gear_shaft_revolutions", scale.gear[0] / scale.gear[1]),
            ("feed", "feed_shaft_revolutions", counts),
        ):
            dividend, divisor = await self._read(over), await self._read(under)
            ratio = dividend / divisor if divisor else math.nan
            if not (abs(ratio - wanted) <= 1e-9 * wanted):
                raise self._mismatch(over, f"{dividend} / {divisor}", f"{wanted:.12g}")

    async def _prove_mode(self) -> None:
        """The drive must have a mode of the map, and for a held force the rated torque that its unit rests on.

        `position_mode` is the first that it has.
        """
        force_mode = self._map.force_mode
        modes = await self._read("supported_modes")
        if self._holds_force:
            if not modes >> force_mode.supported_mode_bit & 1:
                raise self._without("cyclic synchronous torque", modes, f"mode {force_mode.mode}")
            self._expect("rated_torque", await self._read("rated_torque"), force_mode.rated_torque_mnm)
            return
        known = [mode for mode in self._map.position_modes if mode.rests is self._bus.profile_position]
        supported = [mode for mode in known if modes >> mode.supported_mode_bit & 1]
        if not supported:
            names = " and no ".join(mode.name for mode in known)
            others = [mode.name for mode in self._map.position_modes if modes >> mode.supported_mode_bit & 1]
            if others:
                names += f", only {others[0]}: bus.profile_position says which is wanted, no"
            raise self._without(names, modes, "mode " + " or ".join(str(mode.mode) for mode in known))
        self.position_mode = supported[0]

    def _without(self, names: str, modes: int, wanted: str) -> WrongIdentity:
        cause = f"the drive has no {names} mode"
        return WrongIdentity(self._node.name, cause, value=f"6502h = {modes:08X}h", limit=wanted)

    async def _read(self, name: str) -> int:
        return await self._sdo.read(self._map.objects[name])

    async def _text(self, name: str) -> str:
        return await self._sdo.read_text(self._map.objects[name])

    def _expect(self, name: str, value: int, wanted: int) -> None:
        if value != wanted:
            what, label = name.replace("_", " "), self._map.objects[name].label
            cause = f"object {label} of node {self._node.node}"
            raise WrongIdentity(self._node.name, cause, value=f"{what} {value}", limit=f"{what} {wanted}")

    def _mismatch(self, name: str, found: float | str, wanted: float | str) -> ReadBackMismatch:
        cause = f"object {self._map.objects[name].label}"
        return ReadBackMismatch(self._node.name, cause, value=found, limit=wanted)
