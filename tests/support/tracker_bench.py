"""One tracker driver and one simulated instrument on a paced virtual line: the bench of the tracker's fault rows."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np

from docking.config.cell import ErsPoint, TrackerConfig
from docking.config.instruments import GeocomConfig
from docking.types import Array, Reading
from drivers.geocom_tracker import GeocomTracker
from drivers.line_tracker import LineTracker
from sim.tracker.geocom import GeocomStation
from sim.tracker.line import LineTrackerDevice
from sim.virtual_time import run_virtual
from sim.wires.virtual_serial import VirtualSerial
from tests.fakes.tracker_optics import POINTS, FakeOptics

BAUD = 115200
SIGMA_MM = 0.05
PROTOCOLS = ("line", "geocom", "geocom-crc")


def bench_config(protocol: str, timeout_s: float) -> TrackerConfig:
    """Settings of a two-faced tracker of this protocol."""
    ers = tuple(ErsPoint(name=f"E{i}", xyz_mm=(float(i), 0.0, 0.0), sigma_mm=0.01) for i in range(4))
    return TrackerConfig(
        protocol="line" if protocol == "line" else "geocom",
        port="x",
        device_class="laser-tracker",
        station_pose=(0.0,) * 6,
        ers=ers,
        two_face=True,
        measure_timeout_s=timeout_s,
        geocom=GeocomConfig(checksum=protocol == "geocom-crc"),
    )


class TrackerBench:
    """`tracker` drives `device` over `wire`; `optics` holds three reflectors without noise."""

    def __init__(self, protocol: str, timeout_s: float = 3.0, measure_s: float = 0.1) -> None:
        self.loop = asyncio.get_running_loop()
        self.protocol = protocol
        self.wire = VirtualSerial(self.loop, BAUD)
        self.optics = FakeOptics(measure_s=measure_s, noise_mm=0.0)
        driver, device = (LineTracker, LineTrackerDevice) if protocol == "line" else (GeocomTracker, GeocomStation)
        self.device: Any = device(self.optics, self.wire.far, self.loop)
        self.tracker: Any = driver(self.wire.near, bench_config(protocol, timeout_s), self._covariance)

    @staticmethod
    def _covariance(p_T_mm: Array) -> Array:
        return SIGMA_MM**2 * np.eye(3)

    async def measure(self, name: str) -> Reading:
        """Measure one reflector from near its place."""
        reading: Reading = await self.tracker.measure(name, np.array(POINTS[name]) + 10.0)
        return reading

    async def proves_itself(self) -> None:
        """Every reflector is measured where it is."""
        for name in POINTS:
            assert is_right(await self.measure(name)), name


def is_right(reading: Reading) -> bool:
    """Whether a reading without noise is that of its reflector, within what its own covariance says."""
    off_mm = np.abs(reading.p_T_mm - POINTS[reading.target])
    return bool(np.all(off_mm <= 3.0 * np.sqrt(np.diag(reading.cov_mm2))))


def on_tracker_bench(protocol: str, scenario: Callable[[TrackerBench], Awaitable[None]], **settings: float) -> None:
    """Run a scenario on a connected bench in virtual time."""

    async def main() -> None:
        bench = TrackerBench(protocol, **settings)
        await bench.tracker.connect()
        await scenario(bench)
        await bench.tracker.close()

    run_virtual(main)
