"""VectorNav against the simulated sensor on a moving body, over a paced virtual line, in virtual time."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from docking.config.instruments import InertialConfig
from docking.errors import BadReply, DeviceRefused, DeviceSilent, LinkError, LinkLost, ReadBackMismatch
from docking.sightings import InertialSample
from docking.types import Identity
from drivers.vectornav import VectorNav
from sim.tracker.vectornav import InertialErrors, VectorNavSensor
from sim.virtual_time import run_virtual
from sim.wires.virtual_serial import VirtualSerial

Array = NDArray[np.float64]
IDEAL = InertialErrors((0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0), 0.0, 0.0)


class Bench:
    """One sensor on a body, one driver, one line. `pose` may be replaced while it runs."""

    def __init__(self, **config: Any) -> None:
        self.loop = asyncio.get_running_loop()
        self.wire = VirtualSerial(self.loop, 115200)
        self.pose: Callable[[float], tuple[Array, Array]] = lambda t_s: (np.eye(3), np.zeros(3))
        self.sensor = VectorNavSensor(lambda t_s: self.pose(t_s), self.wire.far, self.loop, seed=3)
        self.driver = VectorNav(self.wire.near, InertialConfig(port="x", **config))
        self.samples: list[InertialSample] = []
        self.lost: list[LinkError] = []
        self.driver.on_sample, self.driver.on_lost = self.samples.append, self.lost.append


def on_bench(scenario: Callable[[Bench], Awaitable[None]], **config: Any) -> None:
    async def main() -> None:
        bench = Bench(**config)
        await bench.driver.connect()
        await bench.driver.start()
        await scenario(bench)
        await bench.driver.close()
        bench.sensor.close()

    run_virtual(main)


def mean(bench: Bench, what: str, since: int) -> Array:
    result: Array = np.mean([getattr(s, what) for s in bench.samples[since:]], axis=0)
    return result


@pytest.mark.parametrize("crc16", [False, True])
def test_bring_up_identifies_and_sets_the_registers(crc16: bool) -> None:
    async def main() -> tuple[Identity, Bench]:
        bench = Bench(rate_hz=25)
        bench.sensor.crc16 = crc16
        await asyncio.sleep(0.3)  # it streams from power-up on
        identity = await bench.driver.connect()
        bench.sensor.close()
        return identity, bench

    who, bench = run_virtual(main)
    assert who == Identity("inertial sensor", "VectorNav", "VN-SIM", "0100012345", "2.1.0.0")
    registers = bench.sensor._registers
    assert (registers[6], registers[7], registers[30]) == ("0", "25", "2,0,0,0,1,0,1")


def test_at_rest_it_feels_the_ground_push_upwards() -> None:
    async def scenario(bench: Bench) -> None:
        await asyncio.sleep(4.0)
        assert len(bench.samples) == pytest.approx(200, abs=3)
        errors = bench.sensor.errors
        # z points down: the specific force of rest points the other way.
        force = np.array([0.0, 0.0, -9.80665]) + errors.force_bias_m_s2
        np.testing.assert_allclose(mean(bench, "force_m_s2", 0), force, atol=4 * 0.01 / 14)
        np.testing.assert_allclose(mean(bench, "rate_rad_s", 0), errors.rate_bias_rad_s, atol=4 * 5e-4 / 14)
        np.testing.assert_allclose(mean(bench, "attitude_rad", 0), 0.0, atol=1e-6)
        spread = np.std([s.force_m_s2 for s in bench.samples], axis=0)
        np.testing.assert_allclose(spread, 0.01, rtol=0.2)

    on_bench(scenario)


def test_acceleration_along_the_bodys_own_axes() -> None:
    async def scenario(bench: Bench) -> None:
        bench.sensor.errors = IDEAL
        turned = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
        start_s = bench.loop.time()
        # 40 mm/s^2 along W's y, which is the turned body's x.
        bench.pose = lambda t_s: (turned, np.array([0.0, 20.0 * (t_s - start_s) ** 2, 0.0]))
        await asyncio.sleep(1.0)
        np.testing.assert_allclose(bench.samples[-1].force_m_s2, (0.04, 0.0, -9.80665), atol=2e-3)
        # Yaw counts clockwise seen from above: z points down.
        assert bench.samples[-1].attitude_rad[0] == pytest.approx(-math.pi / 2, abs=1e-4)

    on_bench(scenario)


def test_turning_rate_in_the_sensors_axes_and_gravity_as_it_tilts() -> None:
    async def scenario(bench: Bench) -> None:
        bench.sensor.errors = IDEAL
        start_s = bench.loop.time()
        rate = np.array([0.02, 0.01, 0.03])
        bench.pose = lambda t_s: (Rotation.from_rotvec(rate * (t_s - start_s)).as_matrix(), np.zeros(3))
        await asyncio.sleep(2.0)
        sample = bench.samples[-1]
        np.testing.assert_allclose(sample.rate_rad_s, (0.02, -0.01, -0.03), atol=2e-6)
        body = Rotation.from_rotvec(rate * (sample.t_s - start_s)).as_matrix()
        upwards = body.T @ np.array([0.0, 0.0, 9.80665])
        np.testing.assert_allclose(sample.force_m_s2, upwards * (1.0, -1.0, -1.0), atol=3e-3)

    on_bench(scenario)


def test_device_and_host_time_stamps() -> None:
    async def scenario(bench: Bench) -> None:
        await asyncio.sleep(10.0)
        ages_s = [s.received_s - s.t_s for s in bench.samples]
        device_s = np.diff([s.device_s for s in bench.samples])
        np.testing.assert_allclose(device_s, 0.02, atol=5e-6)
        assert max(ages_s) < 1e-3  # no more than the part of the fixed delay that varies
        # The fixed delay, one line of 11 ms, is not seen; the sample is no older than a period and that.
        assert 0.0 <= bench.loop.time() - bench.samples[-1].t_s <= 0.02 + 0.012
        # Lines that are late show their age; the estimate stays.
        bench.sensor.faults.late_s = 0.4
        await asyncio.sleep(1.0)
        late = [s.received_s - s.t_s for s in bench.samples if s.received_s - s.t_s > 0.01]
        assert len(late) >= 29
        assert late == pytest.approx([0.4] * len(late), abs=2e-3)

    on_bench(scenario)


def test_the_clock_passes_its_32_bits() -> None:
    async def scenario(bench: Bench) -> None:
        bench.sensor._registers[6] = "0"
        await asyncio.sleep(0.1)
        bench.sensor.faults.clock_us = 2**32 - 2_000_000
        await bench.driver.stop()
        await bench.driver.start()
        await asyncio.sleep(4.0)
        device_s = np.array([s.device_s for s in bench.samples[-150:]])
        np.testing.assert_allclose(np.diff(device_s), 0.02, atol=5e-6)
        assert not bench.lost

    on_bench(scenario)


def test_the_calibrated_message_has_no_attitude() -> None:
    async def scenario(bench: Bench) -> None:
        await asyncio.sleep(0.5)
        assert np.isnan(bench.samples[-1].attitude_rad).all()
        assert bench.samples[-1].force_m_s2[2] == pytest.approx(-9.78, abs=0.08)

    on_bench(scenario, message="VNIMU")


def test_stop_ends_the_output() -> None:
    async def scenario(bench: Bench) -> None:
        await asyncio.sleep(0.5)
        await bench.driver.stop()
        count = len(bench.samples)
        await asyncio.sleep(2.0)
        assert len(bench.samples) == count
        assert not bench.lost

    on_bench(scenario)


async def _up_and_running(bench: Bench) -> None:
    await bench.driver.connect()
    await bench.driver.start()


@pytest.mark.parametrize("register", [6, 7, 30])
def test_a_register_that_keeps_another_value_is_named(register: int) -> None:
    async def main() -> None:
        bench = Bench(rate_hz=50)
        bench.sensor._registers[6] = "0" if register == 6 else "14"
        bench.sensor.faults.ignores = {register}
        with pytest.raises(ReadBackMismatch, match=f"register {register}"):
            await _up_and_running(bench)
        bench.sensor.close()

    run_virtual(main)


def test_a_sensor_without_checksum_is_refused() -> None:
    async def main() -> None:
        bench = Bench()
        bench.sensor._registers[30] = "0,0,0,0,0,0,1"
        with pytest.raises(DeviceRefused, match="checksum is switched off"):
            await bench.driver.connect()
        bench.sensor.close()

    run_virtual(main)


def test_a_refused_setting_says_why() -> None:
    async def main() -> None:
        bench = Bench(rate_hz=40)
        bench.sensor._allows = lambda register, fields: register != 7  # type: ignore[method-assign]
        with pytest.raises(DeviceRefused, match="parameter not allowed") as caught:
            await bench.driver.connect()
        assert caught.value.value == 7
        bench.sensor.close()

    run_virtual(main)


@pytest.mark.parametrize(
    ("fault", "value", "error", "words"),
    [
        ("silent", True, DeviceSilent, "no sample"),
        ("cut_to", 40, BadReply, "garbage"),
        ("bad_crc", True, BadReply, "garbage"),
        ("frozen", True, BadReply, "frozen"),
        ("clock_us", -60_000_000, BadReply, "restarted"),
    ],
)
def test_a_stream_that_ends_says_why_once(fault: str, value: object, error: type[LinkError], words: str) -> None:
    async def scenario(bench: Bench) -> None:
        await asyncio.sleep(1.0)
        setattr(bench.sensor.faults, fault, value)
        at_s, ends = bench.loop.time(), list[float]()
        bench.driver.on_lost = lambda e: (bench.lost.append(e), ends.append(bench.loop.time()))[0]
        await asyncio.sleep(5.0)
        assert len(bench.lost) == 1
        assert isinstance(bench.lost[0], error)
        assert words in str(bench.lost[0])
        assert ends[0] - at_s <= 1.0

    on_bench(scenario)


def test_a_vanished_port_ends_the_stream_at_once() -> None:
    async def scenario(bench: Bench) -> None:
        await asyncio.sleep(0.5)
        bench.wire.unplug("pulled")
        assert isinstance(bench.lost[0], LinkLost)
        bench.wire.replug()
        await bench.driver.connect()
        await bench.driver.start()
        count = len(bench.samples)
        await asyncio.sleep(1.0)
        assert len(bench.samples) > count + 45

    on_bench(scenario)


def test_losses_duplicates_and_noise_cost_only_themselves() -> None:
    async def scenario(bench: Bench) -> None:
        bench.sensor.faults.drop_share, bench.sensor.faults.garbage_bytes = 0.2, 10
        await asyncio.sleep(4.0)
        bench.sensor.faults.drop_share, bench.sensor.faults.twice = 0.0, True
        count, repeated = len(bench.samples), bench.driver.counts.repeated
        assert 110 < count < 145
        await asyncio.sleep(1.0)
        assert bench.driver.counts.repeated - repeated == pytest.approx(len(bench.samples) - count, abs=2)
        device_s = [s.device_s for s in bench.samples]
        assert device_s == sorted(set(device_s))
        assert not bench.lost

    on_bench(scenario, rate_hz=40)


def test_a_backlog_leaves_only_what_is_still_young() -> None:
    async def scenario(bench: Bench) -> None:
        await asyncio.sleep(1.0)
        held: list[bytes] = []
        hear = bench.driver._on_bytes
        bench.wire.near.on_bytes = held.append
        bench.driver._watch.cancel()  # type: ignore[union-attr]
        await asyncio.sleep(5.0)
        count = len(bench.samples)
        hear(b"".join(held))
        fresh = bench.samples[count:]
        assert len(fresh) == pytest.approx(100, abs=4)
        assert bench.driver.counts.old == pytest.approx(150, abs=4)
        assert all(bench.loop.time() - s.t_s <= 2.0 for s in fresh)

    on_bench(scenario)


def test_a_line_that_is_too_slow_is_refused_by_file_and_sensor() -> None:
    with pytest.raises(ValueError, match="115200 bit/s carry no more than 78 VNYMR"):
        InertialConfig(port="x", rate_hz=100)
    with pytest.raises(ValueError, match="carry no more"):
        InertialConfig(port="x", rate_hz=10, baud=9600, message="VNIMU")

    async def main() -> None:
        bench = Bench(rate_hz=100, baud=230400)
        with pytest.raises(DeviceRefused, match="too slow"):
            await bench.driver.connect()
        bench.sensor.close()

    run_virtual(main)
