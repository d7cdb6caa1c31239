"""A cell whose positioners share one serial line: it docks in virtual time, answers on a pseudo-terminal, and each
fault of the line ends as it should."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from docking.assemble.commissioning import Proving, devices_text, find_devices
from docking.assemble.looking import LookRequest
from docking.assemble.requests import RunRequest, WireChoice
from docking.assemble.runs import dry_run
from docking.config.load import load_cell
from docking.errors import BadArgument, BadReply, DeviceSilent, LinkLost
from docking.transcript import read_transcript
from drivers.links.serial_port import SerialPort
from drivers.modbus_positioners import ModbusPositioners
from drivers.modbus_rtu import crc16
from sim.virtual_time import run_virtual
from sim.wires.pacing import character_bits
from sim.wires.virtual_serial import VirtualSerial
from tests.support.rtu_cell import rtu_files

IN_MOVE = 'schema_version = 1\nname = "n"\n[[event]]\nat_state = "move"\nstage = "dock"\ns = 0.5\n'


def run(folder: Path, event: str = "") -> dict[str, Any]:
    """Summary of a dry run, with an event at half of the last move."""
    scenario = None
    if event:
        scenario = folder / "scenario.toml"
        scenario.write_text(IN_MOVE + event, "utf-8")
    return dry_run(RunRequest(rtu_files(folder), None, 1, None, None, "en", scenario), lambda text: None)


def test_it_docks(tmp_path: Path) -> None:
    summary = run(tmp_path)
    assert summary["outcome"] == "docked"
    assert summary["true_max_feature_error_mm"] <= summary["tolerance_mm"]
    assert summary["max_consistency_residual_mm"] <= 0.01


@pytest.mark.parametrize(
    ("event", "code", "where"),
    [
        ('device = "B"\nfault = "damaged"\n', DeviceSilent.code, "positioner B"),
        ('device = "B"\nfault = "stale"\nvalues = { count = 1 }\n', BadReply.code, "positioner C"),
        ('device = "modbus"\nfault = "unplug"\n', LinkLost.code, "/dev/ttyUSB1"),
    ],
)
def test_a_line_that_fails_in_a_move_stops_it(tmp_path: Path, event: str, code: int, where: str) -> None:
    """A frame bears no number: what came too much is found out by the next unit that is asked."""
    summary = run(tmp_path, event)
    assert summary["outcome"] == "fault"
    assert summary["alarms"][0]["code"] == code, summary["alarms"]
    assert where in summary["alarms"][0]["message"]


def test_an_answer_that_comes_late_once_is_waited_for(tmp_path: Path) -> None:
    """The line stays silent until it has come and is thrown away; then the controller is asked again."""
    summary = run(tmp_path, 'device = "B"\nfault = "late"\nvalues = { late_s = 0.08, count = 1 }\n')
    assert summary["outcome"] == "docked", summary["alarms"]


def test_a_line_that_is_too_slow_for_its_cell_is_refused(tmp_path: Path) -> None:
    """Segments, never set-points: one poll of four units takes 95 ms at 115200 bit/s, 340 ms at 19200."""

    async def main(poll_s: float, baud: int) -> None:
        cell = load_cell(rtu_files(tmp_path, "8N1", baud, poll_s))
        ModbusPositioners(cell, link=None)

    run_virtual(lambda: main(0.1, 115200))
    for poll_s, baud, key in ((0.05, 115200, "bus.poll_s"), (0.5, 19200, "bus.segment_s")):
        with pytest.raises(BadArgument) as refused:
            run_virtual(lambda p=poll_s, b=baud: main(p, b))  # type: ignore[misc]
        assert refused.value.where == key


@pytest.mark.wires
def test_devices_answer_on_a_terminal_and_every_byte_is_kept(tmp_path: Path) -> None:
    transcript = tmp_path / "line.txt"
    request = LookRequest(rtu_files(tmp_path), WireChoice(sim=True, wires=None), transcript=transcript)
    report = find_devices(request, Proving(settings=True))
    assert report["ok"], devices_text(report)
    plcs = [row for row in report["devices"] if row["where"].startswith("positioner")]
    assert [row["address"] for row in plcs] == [f"/dev/ttyUSB1 unit {unit}" for unit in (1, 2, 3, 4)]
    assert all(row["serial"] and "armed" in row["watchdog"] for row in plcs)
    heard = b"".join(line.data for line in read_transcript(transcript) if line.wire == "modbus" and not line.sent)
    assert heard[0] == 1
    assert crc16(heard[: 5 + heard[2]]) == 0, "a whole frame leaves no remainder"


@pytest.mark.parametrize(("framing", "bits"), [("8N1", 10), ("8E1", 11), ("8O1", 11), ("8N2", 11)])
def test_parity_and_stop_bits_take_their_time(framing: str, bits: int) -> None:
    assert character_bits(framing) == bits

    async def main() -> float:
        loop = asyncio.get_running_loop()
        wire = VirtualSerial(loop, 19200, bits=bits)
        arrived: asyncio.Future[float] = loop.create_future()
        wire.far.on_bytes = lambda data: arrived.set_result(loop.time())
        await wire.near.open()
        begun_s = loop.time()
        wire.near.write(bytes(100))
        return await arrived - begun_s

    assert run_virtual(main) == pytest.approx(100 * bits / 19200)


@pytest.mark.parametrize(
    ("framing", "parity", "stop_bits"), [("8N1", "N", 1), ("8E1", "E", 1), ("8O1", "O", 1), ("8N2", "N", 2)]
)
async def test_the_port_is_set_as_the_cell_says(framing: str, parity: str, stop_bits: int) -> None:
    port = SerialPort("loop://", 19200, "Modbus line", framing)
    await port.open()
    try:
        opened = port._port
        assert opened is not None
        assert (opened.bytesize, opened.parity, opened.stopbits) == (8, parity, stop_bits)
    finally:
        port.close()
