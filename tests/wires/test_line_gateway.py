"""The example gateway as its own process on one end of a null modem, our driver on the other."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

import numpy as np
import pytest

from docking.errors import DeviceSilent, TargetLost
from drivers.line_tracker import LineTracker
from drivers.links.serial_port import SerialPort
from sim.wires.pty_serial import PtySerial
from tests.wires.test_serial_wires import BAUD, config, covariance

pytestmark = pytest.mark.wires

GATEWAY = Path(__file__).parents[2] / "examples" / "line_gateway.py"
POINTS = "N1,4123.456,-876.05,250\nN2,-3000,5200.25,-410.5\n"


async def test_the_driver_measures_through_the_gateway(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text(POINTS)
    loop = asyncio.get_running_loop()
    ours, theirs = PtySerial(loop, BAUD), PtySerial(loop, BAUD)
    ours.open()
    theirs.open()
    ours.on_bytes, theirs.on_bytes = theirs.write, ours.write
    process = await asyncio.create_subprocess_exec(
        sys.executable, str(GATEWAY), theirs.path, str(tmp_path / "points.csv"), stderr=asyncio.subprocess.PIPE
    )
    tracker = LineTracker(SerialPort(ours.path, BAUD), config("line"), covariance)
    try:
        for attempt in range(10):
            try:
                identity = await tracker.connect()
                break
            except DeviceSilent:
                # The interpreter is still starting.
                assert attempt < 9
        assert (identity.vendor, identity.product) == ("Example", "Points from a file")
        for face in (1, 2):
            reading = await tracker.measure("N1", np.zeros(3), face)
            np.testing.assert_allclose(reading.p_T_mm, (4123.456, -876.05, 250.0), atol=1e-9)
            assert reading.face == face
        with pytest.raises(TargetLost, match="no reflector"):
            await tracker.measure("N9", np.zeros(3))
        given_up = asyncio.ensure_future(tracker.measure("N1", np.zeros(3)))
        await asyncio.sleep(0.1)
        given_up.cancel()
        await asyncio.gather(given_up, return_exceptions=True)
        theirs.write(b"noise without an end $VER,1*0000\r\n")
        reading = await tracker.measure("N2", np.zeros(3))
        np.testing.assert_allclose(reading.p_T_mm, (-3000.0, 5200.25, -410.5), atol=1e-9)
        assert tracker.bad_lines == 0
    finally:
        await tracker.close()
        process.kill()
        await process.communicate()
        ours.close()
        theirs.close()
