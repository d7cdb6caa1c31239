"""One simulated CANopen node: network state, object dictionary, heartbeat."""

from __future__ import annotations

from typing import Final, Protocol

from sim.canopen.dictionary import CYCLIC_RPDO, CYCLIC_TPDO, FORCE_RPDO, FORCE_TPDO, INTERPOLATION_RPDO, Dictionary
from sim.canopen.sdo_server import SdoServer
from sim.canopen.settings import DriveSettings
from sim.wires.can_frames import CanFrame

INITIALISING: Final = 0
STOPPED: Final = 4
OPERATIONAL: Final = 5
PRE_OPERATIONAL: Final = 127


class Host(Protocol):
    """What a node needs of its group."""

    def live(self, index: int, obj: int, sub: int) -> int | None: ...

    def changed(self, index: int, obj: int, sub: int, value: int) -> None: ...

    def reset_node(self, node: Node) -> None: ...


class Node:
    """`index` is the axis' place in the cell, `number` its node id."""

    def __init__(self, index: int, number: int, settings: DriveSettings, host: Host) -> None:
        self.index, self.number = index, number
        self.host, self.host_timeout_s = 0, 0.0
        self._settings, self._group = settings, host
        self.forget()

    def forget(self) -> None:
        """Back to the factory's object dictionary."""
        self.state = INITIALISING
        self.beat_s = 0.0
        self.next_beat_s: float | None = None
        self.dictionary = Dictionary(
            self.number,
            self._settings,
            lambda obj, sub: self._group.live(self.index, obj, sub),
            lambda obj, sub, value: self._group.changed(self.index, obj, sub, value),
            lambda: self.state == OPERATIONAL,
        )
        self.server = SdoServer(self.dictionary)

    def number_of(self, obj: int, sub: int = 0) -> int:
        return self.dictionary.number(obj, sub)

    def listens(self) -> tuple[tuple[int, str], ...]:
        """Identifiers addressed to this node, and what they carry."""
        return (0x600 + self.number, "sdo"), (0x200 + self.number, "set-point")

    def refresh_host(self) -> None:
        """Take over 1016h: `host` is the node id whose heartbeat this node monitors, 0 for none."""
        consumer = self.number_of(0x1016, 1)
        self.host, wait_s = consumer >> 16 & 0x7F, (consumer & 0xFFFF) * 1e-3
        self.host_timeout_s = max(0.0, wait_s + self._settings.watchdog_offset_s(self.number)) if wait_s else 0.0

    @property
    def answers_sdo(self) -> bool:
        return self.state in (OPERATIONAL, PRE_OPERATIONAL)

    @property
    def takes_set_points(self) -> bool:
        layouts = (CYCLIC_RPDO, INTERPOLATION_RPDO)
        return self.state == OPERATIONAL and any(self.dictionary.mapped(0x1400, layout) for layout in layouts)

    @property
    def takes_forces(self) -> bool:
        return self.state == OPERATIONAL and self.dictionary.mapped(0x1400, FORCE_RPDO)

    @property
    def reports(self) -> bool:
        return self.state == OPERATIONAL and self.dictionary.mapped(0x1800, CYCLIC_TPDO)

    @property
    def reports_force(self) -> bool:
        return self.state == OPERATIONAL and self.dictionary.mapped(0x1801, FORCE_TPDO)

    def boot_up(self) -> CanFrame:
        """Become pre-operational and say so."""
        self.state = PRE_OPERATIONAL
        return 0x700 + self.number, b"\x00"

    def command(self, command: int) -> None:
        """NMT command: 01h start, 02h stop, 80h pre-operational, 81h and 82h reset."""
        states = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL}
        if command in states:
            self.state = states[command]
        elif command in (0x81, 0x82):
            self._group.reset_node(self)

    def beat_due(self, now_s: float) -> bool:
        return self.next_beat_s is not None and not now_s < self.next_beat_s - 1e-9

    def heartbeat(self, now_s: float) -> CanFrame:
        """The heartbeat due now; sets the next one."""
        self.next_beat_s = now_s + self.beat_s
        return 0x700 + self.number, bytes((self.state,))
