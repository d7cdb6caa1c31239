"""Frames byte by byte, the statusword table, the controlword table, the object map."""

import struct

import pytest

from drivers.canopen import cia402, codec
from drivers.canopen.cia402 import DriveState, Goal, decode, next_controlword
from drivers.maps.objects import load_object_map


def test_set_point_frame_layout() -> None:
    import numpy as np

    row = np.array([(0x000F, -123456, 8)], codec.SET_POINT)
    assert row.tobytes() == struct.pack("<Hib", 0x000F, -123456, 8)
    assert codec.SET_POINT.itemsize == 7
    assert codec.READ_BACK.itemsize == 8


def test_sdo_requests_match_cia_301_examples() -> None:
    assert codec.sdo_read(0x1018, 1) == bytes.fromhex("4018100100000000")
    assert codec.sdo_write(0x1017, 0, struct.pack("<H", 100)) == bytes.fromhex("2b17100064000000")
    assert codec.sdo_write(0x6060, 0, b"\x08") == bytes.fromhex("2f60600008000000")
    assert codec.sdo_write(0x607A, 0, struct.pack("<i", -1)) == bytes.fromhex("237a6000ffffffff")
    assert codec.sdo_write(0x1008, 0, b"hello") == bytes.fromhex("2108100005000000")
    assert codec.sdo_write_segment(b"hello", 0, True) == b"\x05hello\x00\x00"
    assert codec.sdo_write_segment(b"1234567", 1, False) == b"\x101234567"


@pytest.mark.parametrize(
    ("frame", "kind", "data"),
    [
        ("4f60600008000000", "upload", b"\x08"),
        ("4b41600040020000", "upload", b"\x40\x02"),
        ("436460004ef3ffff", "upload", b"\x4e\xf3\xff\xff"),
        ("031a2b3c4d5e6f70", "upload-segment", bytes.fromhex("1a2b3c4d5e6f")),
        ("6017100000000000", "download", b""),
        ("8018100111000906", "abort", b""),
        ("ffffffffffffffff", "unknown", b""),
    ],
)
def test_sdo_answers(frame: str, kind: str, data: bytes) -> None:
    reply = codec.parse_sdo(bytes.fromhex(frame))
    assert reply.kind == kind
    assert reply.data == data


def test_abort_code_and_address() -> None:
    reply = codec.parse_sdo(bytes.fromhex("8018100111000906"))
    assert reply.address == (0x1018, 1)
    assert reply.code == 0x0609_0011
    assert codec.parse_sdo(b"short").kind == "unknown"


def test_emergency() -> None:
    assert codec.parse_emergency(bytes.fromhex("1186110102030405")) == (0x8611, 0x11, b"\x01\x02\x03\x04\x05")


@pytest.mark.parametrize(
    ("word", "state"),
    [
        (0x0000, DriveState.NOT_READY),
        (0x0240, DriveState.SWITCH_ON_DISABLED),
        (0x0250, DriveState.SWITCH_ON_DISABLED),
        (0x0231, DriveState.READY),
        (0x0233, DriveState.SWITCHED_ON),
        (0x1237, DriveState.OPERATION_ENABLED),
        (0x0217, DriveState.QUICK_STOP_ACTIVE),
        (0x021F, DriveState.FAULT_REACTION),
        (0x0218, DriveState.FAULT),
        (0x0238, DriveState.FAULT),
        (0x0203, DriveState.UNKNOWN),
    ],
)
def test_statusword_table(word: int, state: DriveState) -> None:
    assert decode(word) is state


def test_every_statusword_has_exactly_one_state() -> None:
    for word in range(0x80):
        rows = [state for mask, value, state in cia402.MASKS if word & mask == value]
        assert len(rows) <= 1
        assert decode(word) is (rows[0] if rows else DriveState.UNKNOWN)


def test_enabling_goes_step_by_step() -> None:
    path = [DriveState.SWITCH_ON_DISABLED, DriveState.READY, DriveState.SWITCHED_ON, DriveState.OPERATION_ENABLED]
    assert [next_controlword(s, Goal.ENABLED, True) for s in path] == [0x06, 0x07, 0x0F, 0x0F]
    assert next_controlword(DriveState.FAULT, Goal.ENABLED, True) == 0x00, "faults are never reset by enabling"


def test_disabling_keeps_the_torque_until_the_brake_is_closed() -> None:
    assert next_controlword(DriveState.OPERATION_ENABLED, Goal.DISABLED, False) == 0x07
    assert next_controlword(DriveState.SWITCHED_ON, Goal.DISABLED, False) == 0x07
    assert next_controlword(DriveState.SWITCHED_ON, Goal.DISABLED, True) == 0x06
    assert next_controlword(DriveState.READY, Goal.DISABLED, True) == 0x00
    assert next_controlword(DriveState.QUICK_STOP_ACTIVE, Goal.DISABLED, False) == 0x0F


def test_object_map() -> None:
    omap = load_object_map("cia402")
    assert omap.pdos["set_points"].words == (0x60400010, 0x607A0020, 0x60600008)
    assert omap.pdos["read_back"].words == (0x60410010, 0x60640020, 0x60F40010)
    assert omap.pdos["force"].transmission == 10
    assert omap.emergency_text(0x8611) == "following error outside its window"
    assert omap.emergency_text(0x8699) == "monitoring fault"
    assert omap.emergency_text(0xFF01) == "maker's own fault"
    assert omap.abort_text(0x06090011) == "sub-index does not exist"
    assert dict(omap.written)["quick_stop_option"] == 6
