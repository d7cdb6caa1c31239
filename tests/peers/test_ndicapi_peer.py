"""ndicapi, NDI's protocol in a C library written by others, drives the simulated camera over a pseudo-terminal."""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np
import pytest

from sim.tracker.ndi import NdiCamera
from sim.wires.pty_serial import PtySerial
from tests.fakes.camera_scene import ROM_A, ROM_B, FakeScene

pytestmark = [pytest.mark.peer, pytest.mark.wires]


def drive(path: str) -> dict[str, Any]:
    """What a user of the library does: initialise, change the speed, load a tool, enable, track, read."""
    import ndicapy as ndi

    device = ndi.ndiOpen(path)
    seen: dict[str, Any] = {}
    try:
        for command in ("INIT:", "COMM:50000", "VER:4"):
            seen[command] = ndi.ndiCommand(device, command)
        ndi.ndiCommand(device, "PHRQ:********01****")
        handle = ndi.ndiGetPHRQHandle(device)
        seen["requested"] = handle
        rom = ROM_A.ljust(192, b"\0")
        for at in range(0, len(rom), 64):
            ndi.ndiCommand(device, f"PVWR:{handle:02X}{at:04X}{rom[at : at + 64].hex().upper()}")
        seen["waiting"] = ndi.ndiCommand(device, "PHSR:02")
        for known in (1, handle):
            ndi.ndiCommand(device, f"PINIT:{known:02X}")
            ndi.ndiCommand(device, f"PENA:{known:02X}D")
        seen["still waiting"] = ndi.ndiCommand(device, "PHSR:02")
        seen["part"] = ndi.ndiCommand(device, "PHINF:010004")
        ndi.ndiCommand(device, "TSTART:")
        ndi.ndiCommand(device, "TX:1001")
        for known in (1, handle):
            # The library takes a handle as one byte.
            seen["transform", known] = ndi.ndiGetTXTransform(device, bytes([known]))
            seen["frame", known] = ndi.ndiGetTXFrame(device, bytes([known]))
        seen["strays"] = [ndi.ndiGetTXPassiveStray(device, i) for i in range(ndi.ndiGetTXNumberOfPassiveStrays(device))]
        seen["status"] = ndi.ndiGetTXSystemStatus(device)
        try:
            ndi.ndiCommand(device, "PINIT:01")
        except OSError as error:
            seen["refused"] = str(error)
        ndi.ndiCommand(device, "TSTOP:")
    finally:
        ndi.ndiClose(device)
    return seen


async def test_ndicapi_tracks_tools_and_markers() -> None:
    loop = asyncio.get_running_loop()
    terminal = PtySerial(loop, 9600)
    terminal.open()
    scene = FakeScene()
    camera = NdiCamera(scene, terminal, loop, {ROM_A: "nose", ROM_B: "ring"}, plugged=("ring",))
    camera.noise_mm = 0.0
    seen = await asyncio.to_thread(drive, terminal.path)
    terminal.close()
    assert (seen["INIT:"], seen["COMM:50000"]) == ("OKAY", "OKAY")
    assert "S/N: SIM-0001" in seen["VER:4"]
    assert (seen["requested"], seen["waiting"], seen["still waiting"]) == (2, "0201001" + "02001", "00")
    assert seen["part"].strip() == "ring"
    for handle, tool in ((1, "ring"), (2, "nose")):
        rotation, p_mm = scene.tools[tool]
        w, x, y, z, *rest = seen["transform", handle]
        np.testing.assert_allclose(rest[:3], p_mm, atol=0.0051)
        # Rodrigues from the quaternion, against the scene's matrix: the trace gives w.
        assert 4.0 * w * w - 1.0 == pytest.approx(float(np.trace(rotation)), abs=2e-3)
        assert 2.0 * (x * y + w * z) == pytest.approx(float(rotation[1, 0]), abs=2e-3)
        assert seen["frame", handle] > 0
    np.testing.assert_allclose(seen["strays"], scene.strays, atol=0.0051)
    assert seen["status"] == 0
    assert "current mode" in seen["refused"]
