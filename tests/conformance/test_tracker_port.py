"""The tracker port: the same checks on the fake, on simulated devices in virtual time, over ptys, and on hardware."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import numpy as np
import pytest

from docking.assemble.controller import tracker_of
from docking.config.load import load_cell
from docking.geometry import pose_from_vector
from drivers.geocom_tracker import GeocomTracker
from drivers.line_tracker import LineTracker
from drivers.links.serial_port import SerialPort
from sim.tracker.geocom import GeocomStation
from sim.tracker.line import LineTrackerDevice
from sim.virtual_time import run_virtual
from sim.wires.pty_serial import PtySerial
from tests.conformance.tracker_checks import CHECKS, Subject
from tests.fakes.tracker import FakeTracker
from tests.fakes.tracker_optics import POINTS, FakeOptics
from tests.support.tracker_bench import BAUD, PROTOCOLS, SIGMA_MM, TrackerBench, bench_config

Check = Callable[[Subject], Awaitable[None]]
NEAR = {name: np.array(p) + 8.0 for name, p in POINTS.items()}
HIDDEN = ("N9", np.array([0.0, -8000.0, 900.0]))

checks = pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)


@checks
def test_the_fake(check: Check) -> None:
    async def main() -> None:
        await check(Subject(FakeTracker(), NEAR, HIDDEN))

    run_virtual(main)


@checks
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_the_simulated_device_in_virtual_time(check: Check, protocol: str) -> None:
    async def main() -> None:
        bench = TrackerBench(protocol)
        bench.optics.noise_mm = 0.02
        await check(Subject(bench.tracker, NEAR, HIDDEN))
        await bench.tracker.close()

    run_virtual(main)


@checks
@pytest.mark.wires
@pytest.mark.parametrize("protocol", ["line", "geocom"])
async def test_the_simulated_device_over_a_pty(check: Check, protocol: str) -> None:
    loop = asyncio.get_running_loop()
    terminal = PtySerial(loop, BAUD)
    terminal.open()
    driver, device = (LineTracker, LineTrackerDevice) if protocol == "line" else (GeocomTracker, GeocomStation)
    device(FakeOptics(measure_s=0.05, noise_mm=0.02), terminal, loop)
    tracker = driver(SerialPort(terminal.path, BAUD), bench_config(protocol, 3.0), lambda p: SIGMA_MM**2 * np.eye(3))
    await check(Subject(tracker, NEAR, HIDDEN))
    await tracker.close()
    terminal.close()


@checks
@pytest.mark.hardware
async def test_the_real_device(check: Check, request: pytest.FixtureRequest) -> None:
    """Reference points as the cell file has them, seen from its approximate station; nothing is behind the station."""
    cell = load_cell(Path(request.config.getoption("--hardware")))
    X_TW = pose_from_vector(cell.tracker.station_pose).inverse()
    points = {point.name: X_TW.apply(np.array(point.xyz_mm)) for point in cell.tracker.ers}
    behind = -np.mean(list(points.values()), axis=0)
    tracker = tracker_of(cell, SerialPort(cell.tracker.port, cell.tracker.baud))
    await check(Subject(tracker, points, ("NOWHERE", behind)))
    await tracker.close()
