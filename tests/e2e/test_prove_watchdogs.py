"""`docking devices --prove-watchdogs` at a terminal, over real wires."""

from __future__ import annotations

import asyncio
import itertools
import json
import socket
import struct
import threading

import pytest

from docking.cli import call
from docking.transcript import read_transcript
from drivers.links.can_bus import CanBusLink
from tests.support.dry_cell import CELLS
from tests.support.program import served

pytestmark = [pytest.mark.wires, pytest.mark.timeout(60)]


def test_every_drive_misses_the_heartbeat_and_says_when(capsys):
    assert call(["devices", str(CELLS / "lab-can.toml"), "--sim", "--prove-watchdogs", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert len(report["watchdogs_ms"]) == 12
    # 0.28 s in the cell file; a drive may be a tenth later, and this computer a little.
    assert all(200.0 <= ms <= 400.0 for ms in report["watchdogs_ms"].values())


def test_plcs_have_no_such_proof(capsys):
    assert call(["devices", str(CELLS / "lab-modbus.toml"), "--sim", "--prove-watchdogs"]) == 2
    assert "CANopen" in capsys.readouterr().err


def test_plcs_with_another_host_are_left_alone(capsys, tmp_path):
    """To bring them up means to disable them: what they carry would be stopped in the middle of a move."""
    cell = CELLS / "lab-modbus.toml"
    over = threading.Event()

    def host(address: tuple[str, int]) -> None:
        """Keeps positioner C alive by its heartbeat register 0Fh."""
        with socket.create_connection(address) as line:
            for beat in itertools.count(1):
                line.sendall(struct.pack(">HHHBBHHBH", beat & 0xFFFF, 0, 9, 1, 16, 0x0F, 1, 2, beat & 0xFFFF))
                line.recv(64)
                if over.wait(0.05):
                    return

    with served(cell, tmp_path) as wires:
        address = tuple(json.loads(wires.read_text())["modbus"]["C"])
        thread = threading.Thread(target=host, args=(address,))
        thread.start()
        transcript = tmp_path / "bytes.txt"
        there = ["--sim", "--wires", str(wires), "--json", "--transcript", str(transcript)]
        try:
            assert call(["devices", str(cell), *there, "--prove"]) == 1
        finally:
            over.set()
            thread.join()
    report = json.loads(capsys.readouterr().out)
    assert report["bring_up"]["code"] == 1006
    assert "another controller" in report["bring_up"]["message"].lower()
    assert [row["address"] for row in report["devices"] if row["stray"]] == ["heartbeat of a host"]
    functions = {line.data[7] for line in read_transcript(transcript) if line.wire.startswith("modbus:") and line.sent}
    assert functions <= {2, 3, 4}, "only reads"


def test_a_bus_with_another_controller_is_left_alone(capsys, tmp_path):
    cell = CELLS / "lab-can.toml"
    over = threading.Event()

    async def other(path: str) -> None:
        link = CanBusLink("docking-unix", path, 1_000_000)
        heard: list[tuple[int, bytes]] = []
        link.on_frames = heard.extend
        await link.open()
        while not over.is_set():
            link.send([(0x080, b"")])
            await asyncio.sleep(0.02)
        link.close()
        # Nobody was reset or started by NMT.
        assert not [frame for frame in heard if frame[0] == 0]

    with served(cell, tmp_path) as wires:
        path = json.loads(wires.read_text())["can"]
        thread = threading.Thread(target=lambda: asyncio.run(other(path)))
        thread.start()
        try:
            assert call(["devices", str(cell), "--sim", "--wires", str(wires), "--prove-watchdogs", "--json"]) == 1
        finally:
            over.set()
            thread.join()
    report = json.loads(capsys.readouterr().out)
    assert report["bring_up"]["code"] == 1006
    assert report["watchdogs_ms"] is None
