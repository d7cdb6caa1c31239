"""LineTracker against the simulated device over a paced virtual line, in virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import numpy as np
import pytest

from docking.config.cell import ErsPoint, TrackerConfig
from docking.errors import (
    BadReply,
    DeviceRefused,
    DeviceSilent,
    LinkLost,
    PortMissing,
    TargetLost,
    WrongIdentity,
)
from docking.types import Array, Identity, Reading
from drivers.line_tracker import LineTracker
from sim.tracker.crc import checksum
from sim.tracker.line import LineTrackerDevice
from sim.virtual_time import run_virtual
from sim.wires.virtual_serial import VirtualSerial
from tests.fakes.tracker_optics import POINTS, FakeOptics

BAUD = 115200
NEAR = np.zeros(3)


def config(**changes: object) -> TrackerConfig:
    ers = tuple(ErsPoint(name=f"E{i}", xyz_mm=(float(i), 0.0, 0.0), sigma_mm=0.01) for i in range(4))
    base = TrackerConfig(protocol="line", port="x", device_class="laser-tracker", station_pose=(0.0,) * 6, ers=ers)
    return base.model_copy(update=changes)


def covariance(p_T_mm: Array) -> Array:
    """20 um along the line of sight, 50 um across."""
    u = p_T_mm / np.linalg.norm(p_T_mm)
    along = np.outer(u, u)
    result: Array = 0.02**2 * along + 0.05**2 * (np.eye(3) - along)
    return result


class Bench:
    """One tracker, one device, one line."""

    def __init__(self, **changes: object) -> None:
        self.loop = asyncio.get_running_loop()
        self.wire = VirtualSerial(self.loop, BAUD)
        self.optics = FakeOptics()
        self.device = LineTrackerDevice(self.optics, self.wire.far, self.loop)
        self.tracker = LineTracker(self.wire.near, config(**changes), covariance)


def on_bench(scenario: Callable[[Bench], Awaitable[None]], **changes: object) -> None:
    async def main() -> None:
        bench = Bench(**changes)
        await bench.tracker.connect()
        await scenario(bench)
        await bench.tracker.close()

    run_virtual(main)


def test_identity_and_wire_time() -> None:
    async def main() -> tuple[Identity, float]:
        bench = Bench()
        who = await bench.tracker.connect()
        return who, bench.loop.time()

    who, took_s = run_virtual(main)
    assert who == Identity("tracker", "Simulated", "Laser tracker", "LT-0001", "1.0")
    line_bytes = sum(map(len, (b"$STP,1*0000\r\n", b"$ACK,1*0000\r\n", b"$VER,2*0000\r\n")))
    line_bytes += len(b"$IDN,2,1,Simulated,Laser tracker,LT-0001,1.0*0000\r\n")
    assert took_s == pytest.approx(line_bytes * 10 / BAUD)


def test_a_point_in_millimetres_with_its_covariance() -> None:
    async def scenario(bench: Bench) -> None:
        bench.optics.noise_mm = 0.0
        start_s = bench.loop.time()
        reading = await bench.tracker.measure("N1", NEAR)
        np.testing.assert_allclose(reading.p_T_mm, POINTS["N1"], atol=0.0005)
        np.testing.assert_allclose(reading.cov_mm2, covariance(reading.p_T_mm))
        assert (reading.target, reading.face, reading.degraded) == ("N1", 1, False)
        assert 2.0 < reading.t_s - start_s < 2.02
        assert bench.optics.shots == [("N1", pytest.approx(start_s + 2.0, abs=0.01), 1)]

    on_bench(scenario)


def test_a_worse_reported_sigma_enlarges_the_model_as_a_whole() -> None:
    async def scenario(bench: Bench) -> None:
        bench.optics.noise_mm = 0.2
        reading = await bench.tracker.measure("N3", NEAR)
        model = covariance(reading.p_T_mm)
        factor = reading.cov_mm2[0, 0] / model[0, 0]
        np.testing.assert_allclose(reading.cov_mm2, factor * model)
        assert np.min(np.diag(reading.cov_mm2)) >= 0.1995**2 * (1 - 1e-9)

    on_bench(scenario)


def test_degraded_is_kept_and_costs_three_sigma() -> None:
    async def scenario(bench: Bench) -> None:
        bench.optics.status["N2"] = "inaccurate"
        reading = await bench.tracker.measure("N2", NEAR)
        assert reading.degraded
        np.testing.assert_allclose(reading.cov_mm2, 9.0 * covariance(reading.p_T_mm))

    on_bench(scenario)


def test_two_faces() -> None:
    async def scenario(bench: Bench) -> None:
        assert (await bench.tracker.measure("N1", NEAR, face=2)).face == 2
        assert bench.optics.shots[-1][2] == 2
        bench.device.faults.clear_flags = 16
        with pytest.raises(BadReply, match="other face"):
            await bench.tracker.measure("N2", NEAR, face=2)

    on_bench(scenario, two_face=True)


def test_one_face_only() -> None:
    async def scenario(bench: Bench) -> None:
        with pytest.raises(DeviceRefused):
            await bench.tracker.measure("N1", NEAR, face=2)

    on_bench(scenario)


@pytest.mark.parametrize(
    ("fault", "value", "error"),
    [
        ("zero", True, TargetLost),
        ("clear_flags", 1, TargetLost),
        ("extra_flags", 4, TargetLost),
        ("extra_flags", 8, TargetLost),
        ("silent", True, DeviceSilent),
        ("cut_to", 20, DeviceSilent),
        ("bad_crc", True, DeviceSilent),
    ],
)
def test_faults_are_never_points(fault: str, value: object, error: type[Exception]) -> None:
    async def scenario(bench: Bench) -> None:
        setattr(bench.device.faults, fault, value)
        with pytest.raises(error):
            await bench.tracker.measure("N1", NEAR)
        setattr(bench.device.faults, fault, type(bench.device.faults)().__dict__[fault])
        reading = await bench.tracker.measure("N2", NEAR)
        np.testing.assert_allclose(reading.p_T_mm, POINTS["N2"], atol=0.2)

    on_bench(scenario)


def test_a_missing_reflector_is_named() -> None:
    async def scenario(bench: Bench) -> None:
        with pytest.raises(TargetLost) as caught:
            await bench.tracker.measure("N9", NEAR)
        assert caught.value.where == "N9"
        assert "no reflector" in caught.value.cause

    on_bench(scenario)


def test_silence_is_noticed_within_a_second_not_at_the_deadline() -> None:
    async def scenario(bench: Bench) -> None:
        bench.device.faults.silent = True
        start_s = bench.loop.time()
        with pytest.raises(DeviceSilent) as caught:
            await bench.tracker.measure("N1", NEAR)
        assert bench.loop.time() - start_s == pytest.approx(1.0)
        assert caught.value.limit == 1.0

    on_bench(scenario)


def test_a_slow_device_that_is_alive_has_until_the_deadline() -> None:
    async def scenario(bench: Bench) -> None:
        bench.device.faults.slow_s = 11.0
        await bench.tracker.measure("N1", NEAR)
        bench.device.faults.slow_s = 14.0
        start_s = bench.loop.time()
        with pytest.raises(DeviceSilent) as caught:
            await bench.tracker.measure("N1", NEAR)
        assert bench.loop.time() - start_s == pytest.approx(15.0)
        assert caught.value.limit == 15.0

    on_bench(scenario)


def test_a_late_reply_is_dropped_and_counted() -> None:
    async def scenario(bench: Bench) -> None:
        task = asyncio.ensure_future(bench.tracker.measure("N1", NEAR))
        await asyncio.sleep(0.5)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await asyncio.sleep(3.0)
        assert bench.tracker.counts.stale == 1
        reading = await bench.tracker.measure("N1", NEAR)
        assert reading.t_s == pytest.approx(bench.loop.time())

    on_bench(scenario)


def test_an_old_measurement_under_a_fresh_number_is_dropped() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.tracker.measure("N1", NEAR)
        bench.device.faults.stale = True
        with pytest.raises(DeviceSilent):
            await bench.tracker.measure("N2", NEAR)
        assert bench.tracker.counts.old_time == 1

    on_bench(scenario)


def inject(bench: Bench, body: str) -> None:
    raw = body.encode()
    bench.wire.far.write(b"$" + raw + b"*%04X\r\n" % checksum(raw))


def test_another_target_or_number_is_never_taken() -> None:
    async def scenario(bench: Bench) -> None:
        task = asyncio.ensure_future(bench.tracker.measure("N1", NEAR))
        await asyncio.sleep(0.1)
        seq = bench.tracker._seq
        inject(bench, f"PNT,{seq},150000,N2,1,2,3,4,5,6,1")
        inject(bench, f"PNT,{seq - 1},150001,N1,1,2,3,4,5,6,1")
        inject(bench, f"PNT,{seq},150002,N1,nan,2,3,4,5,6,1")
        reading = await task
        np.testing.assert_allclose(reading.p_T_mm, POINTS["N1"], atol=0.2)
        assert (bench.tracker.counts.wrong_target, bench.tracker.counts.stale, bench.tracker.bad_lines) == (1, 1, 1)

    on_bench(scenario)


def test_garbage_between_lines_costs_nothing() -> None:
    async def scenario(bench: Bench) -> None:
        bench.device.faults.garbage_bytes = 40
        readings = [await bench.tracker.measure(name, NEAR) for name in ("N1", "N2", "N3")]
        assert [r.target for r in readings] == ["N1", "N2", "N3"]
        assert bench.tracker.noise_bytes > 0

    on_bench(scenario)


def test_a_flood_of_bad_lines_ends_the_request() -> None:
    async def scenario(bench: Bench) -> None:
        task = asyncio.ensure_future(bench.tracker.measure("N1", NEAR))
        await asyncio.sleep(0.1)
        bench.wire.far.write(b"$PNT,broken*0000\r\n" * 6)
        with pytest.raises(BadReply, match="garbage"):
            await task
        assert bench.loop.time() < 0.2

    on_bench(scenario)


def test_a_frozen_sensor_is_noticed() -> None:
    async def scenario(bench: Bench) -> None:
        bench.optics.noise_mm = 0.0
        bench.optics.points["N2"] = bench.optics.points["N1"]
        await bench.tracker.measure("N1", NEAR)
        with pytest.raises(BadReply, match="frozen"):
            await bench.tracker.measure("N2", NEAR)
        await bench.tracker.measure("N3", NEAR)
        await bench.tracker.measure("N3", NEAR)
        with pytest.raises(BadReply, match="frozen"):
            await bench.tracker.measure("N3", NEAR)

    on_bench(scenario)


def test_a_vanished_port_ends_the_request_at_once_and_a_fresh_session_works() -> None:
    async def scenario(bench: Bench) -> None:
        task = asyncio.ensure_future(bench.tracker.measure("N1", NEAR))
        await asyncio.sleep(0.5)
        bench.wire.unplug("the cable is out")
        with pytest.raises(LinkLost, match="cable is out"):
            await task
        with pytest.raises(LinkLost):
            await bench.tracker.measure("N1", NEAR)
        with pytest.raises(PortMissing):
            await bench.tracker.connect()
        bench.wire.replug()
        await bench.tracker.connect()
        await bench.tracker.measure("N1", NEAR)

    on_bench(scenario)


def test_no_device_on_the_line() -> None:
    async def main() -> None:
        bench = Bench()
        bench.device.faults.silent = True
        with pytest.raises(DeviceSilent):
            await bench.tracker.connect()
        assert bench.loop.time() == pytest.approx(1.0)

    run_virtual(main)


def test_another_protocol_version_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim.tracker.line.PROTOCOL", 2)

    async def main() -> None:
        with pytest.raises(WrongIdentity) as caught:
            await Bench().tracker.connect()
        assert (caught.value.value, caught.value.limit) == (2, 1)

    run_virtual(main)


def test_same_bytes_give_the_same_readings() -> None:
    def once() -> list[tuple[float, ...]]:
        readings: list[Reading] = []

        async def scenario(bench: Bench) -> None:
            bench.device.faults.garbage_bytes = 5
            readings.extend([await bench.tracker.measure(name, NEAR) for name in ("N1", "N2")])

        on_bench(scenario)
        return [(r.t_s, *r.p_T_mm) for r in readings]

    assert once() == once()
