"""`docking devices --prove-watchdogs` at a terminal, over real wires."""

from __future__ import annotations

import asyncio
import json
import threading

import pytest

from docking.cli import call
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
