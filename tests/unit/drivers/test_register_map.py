"""The driver's register map against the simulated PLC's table, which is written down apart from it."""

from __future__ import annotations

import struct

from drivers.register_map import load_map
from sim.plc import registers as reg


def test_blocks_stand_where_the_plc_has_them() -> None:
    blocks = load_map("positioner_plc").blocks
    sizes = {name: (block.address, 2 * block.count) for name, block in blocks.items()}
    assert sizes == {
        "command": (reg.COMMAND_AT, reg.COMMAND.size),
        "heartbeat": (reg.HEARTBEAT_AT, 2),
        "segment": (reg.SEGMENT_AT, reg.SEGMENT_BYTES),
        "settings": (reg.SETTINGS_AT, reg.SETTINGS.size),
        "motion": (reg.MOTION_AT, reg.MOTION.size),
        "status": (reg.STATUS_AT, reg.STATUS_HEAD.size + 3 * reg.STATUS_AXIS.size),
        "identity": (reg.IDENTITY_AT, reg.IDENTITY.size),
        "limits": (reg.LIMITS_AT, 3 * reg.LIMITS.size),
    }
    assert reg.HEARTBEAT_AT + 1 == reg.SEGMENT_AT, "heartbeat and segment go in one write"


def test_numbers_mean_the_same() -> None:
    layout = load_map("positioner_plc")
    assert layout.states == {s.value: s.name.lower() for s in reg.State}
    names = {"reset": "FAULT_RESET", "stop": "CLEAR", "quick-stop": "QUICK_STOP"}
    assert {names.get(k, k.upper()): v for k, v in layout.commands.items()} == {c.name: c.value for c in reg.Command}
    for fault in reg.Fault:
        assert fault is reg.Fault.NONE or "not in the map" not in layout.fault(fault)
    for reject in reg.Reject:
        assert reject is reg.Reject.NONE or "not in the map" not in layout.reject(reject)
    assert layout.flags["last_segment"] == reg.FLAG_LAST
    assert (layout.flags["axis_braked"], layout.flags["axis_fault"]) == (reg.AXIS_BRAKED, reg.AXIS_FAULT)
    assert (layout.flags["run_line"], layout.flags["watchdog_armed"]) == (1, 2)
    assert (layout.scale["fraction"], layout.scale["no_force"]) == (reg.FRACTION, reg.NO_FORCE)


def test_status_unpacks_signed_fields_high_word_first() -> None:
    block = load_map("positioner_plc").blocks["status"]
    head = struct.pack(">6HI7H", 1, 2, 5, 0, 4, 0, 0x00012345, 8, 7, 0x8000, 200, 0, 3, 99)
    axes = bytes.fromhex("fffe7960 ff9c fff6 0001") + bytes(10) + bytes.fromhex("000186a0 0064 8000 0004")
    fields, rows = block.unpack(head + axes)
    assert fields["plan_id"] == 0x12345
    assert fields["fraction"] == 0x8000
    assert rows[0] == (-100000, -100, -10, 1)
    assert rows[2] == (100000, 100, -32768, 4)


def test_crc_is_the_one_the_map_names() -> None:
    assert reg.crc16(b"123456789") == 0x29B1
