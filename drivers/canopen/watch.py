"""Watches the nodes beside the cyclic data: emergencies, heartbeats, restarts, foreign senders."""

from __future__ import annotations

import struct
from typing import Final

from docking.types import FaultKind
from drivers.canopen import codec
from drivers.canopen.nodes import AxisNode
from drivers.maps.objects import ObjectMap

NODE_RESTARTED: Final = 0x1_0001
HEARTBEAT_LOST: Final = 0x1_0002
NODE_NOT_OPERATIONAL: Final = 0x1_0003
FOREIGN_SENDER: Final = 0x1_0004
SILENT_FAULT: Final = 0x1_0005
"""Codes above 16 bits are found by the controller; the others are emergency codes that a drive sent."""

Fault = tuple[str, int, str]

_KINDS: Final = {
    NODE_RESTARTED: FaultKind.NODE_RESTARTED,
    NODE_NOT_OPERATIONAL: FaultKind.NODE_RESTARTED,
    HEARTBEAT_LOST: FaultKind.HEARTBEAT_LOST,
    FOREIGN_SENDER: FaultKind.FOREIGN_SENDER,
}


class NodeWatch:
    """Keeps the most severe fault of any node, the first among equals, until `rearm`.

    `seen_s` holds each node's last heartbeat (loop time), `reported` the (index, code) of all emergency messages since
    `rearm`, of conditions that have gone, too.
    """

    def __init__(self, nodes: tuple[AxisNode, ...], omap: ObjectMap, heartbeat_s: float) -> None:
        self.worst: Fault | None = None
        self._worst_index = 0
        self.timeout_s = 3.0 * heartbeat_s
        self.seen_s: list[float | None] = [None] * len(nodes)
        self.emergencies: dict[int, int] = {}
        self.reported: set[tuple[int, int]] = set()
        self._nodes, self._map = nodes, omap
        self._armed = False
        self._states: list[int] = [codec.STATE_BOOT_UP] * len(nodes)

    def rearm(self) -> None:
        """Forget what was kept and watch from here on."""
        self.worst, self._armed = None, True
        self.reported.clear()

    def disarm(self) -> None:
        """Stop judging (bring-up and closing change node states on purpose)."""
        self._armed = False

    def missing_heartbeat(self, now_s: float) -> AxisNode | None:
        """The first node whose heartbeat is not alive and operational."""
        for node, seen, state in zip(self._nodes, self.seen_s, self._states, strict=True):
            if seen is None or not (now_s - seen <= self.timeout_s) or state != codec.STATE_OPERATIONAL:
                return node
        return None

    def on_heartbeat(self, index: int, data: bytes, now_s: float) -> None:
        """Boot-up message or heartbeat of one node."""
        if len(data) != 1:
            return
        state = data[0] & 0x7F
        self.seen_s[index], self._states[index] = now_s, state
        if state == codec.STATE_BOOT_UP:
            self._note(index, NODE_RESTARTED, "the drive restarted: its position is no longer trusted")
        elif state != codec.STATE_OPERATIONAL:
            self._note(index, NODE_NOT_OPERATIONAL, f"the node left the operational state (now {state})")

    def on_emergency(self, index: int, data: bytes) -> None:
        """Emergency message of one node; code 0 reports that its errors are gone."""
        try:
            message = codec.parse_emergency(data)
        except struct.error:
            return
        if message.code == 0:
            self.emergencies.pop(index, None)
            return
        self.emergencies[index] = message.code
        self.reported.add((index, message.code))
        self._note(index, message.code, self._map.emergency_text(message.code))

    def on_foreign(self, index: int) -> None:
        """Someone else sent a set-point frame that only this controller may send."""
        self._note(index, FOREIGN_SENDER, "another sender uses this axis' set-point identifier")

    def check(self, now_s: float) -> None:
        """Note nodes whose heartbeat stopped."""
        for index, seen in enumerate(self.seen_s):
            if seen is not None and not (now_s - seen <= self.timeout_s):
                self._note(index, HEARTBEAT_LOST, f"no heartbeat for {now_s - seen:.3f} s")

    def verdict(self, in_fault: tuple[int, ...]) -> tuple[Fault | None, FaultKind]:
        """What to report while the drives `in_fault` are in fault: a complaint of one that goes on comes last."""
        if self.worst is not None and self.worst[1] in _KINDS:
            return self.worst, _KINDS[self.worst[1]]
        if in_fault and self._worst_index not in in_fault:
            return self.fault_of(in_fault[0]), FaultKind.DRIVE_FAULT
        if in_fault:
            return self.worst or self.fault_of(in_fault[0]), FaultKind.DRIVE_FAULT
        return self.worst, FaultKind.DRIVE_WARNING

    def fault_of(self, index: int) -> Fault:
        """What is known about a drive that reports the fault state."""
        code = self.emergencies.get(index)
        if code is None:
            return self._nodes[index].name, SILENT_FAULT, "the drive is in fault and sent no emergency message"
        return self._nodes[index].name, code, self._map.emergency_text(code)

    def _note(self, index: int, code: int, text: str) -> None:
        # What a drive complains of must not hide that a node restarted, fell silent or is not alone.
        graver = self.worst is None or (code in _KINDS and self.worst[1] not in _KINDS)
        if self._armed and graver:
            self.worst, self._worst_index = (self._nodes[index].name, code, text), index
