"""GeocomTracker against the simulated station over a paced virtual line, in virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import pytest

from docking.config.cell import ErsPoint, TrackerConfig
from docking.config.instruments import GeocomConfig
from docking.errors import BadReply, DeviceRefused, DeviceSilent, LinkLost, ReadBackMismatch, TargetLost
from docking.types import Array, Identity
from drivers.geocom_tracker import GeocomTracker
from sim.tracker.faults import flipped
from sim.tracker.geocom import GeocomStation
from sim.tracker.geocom_head import Air
from sim.virtual_time import run_virtual
from sim.wires.virtual_serial import VirtualSerial
from tests.fakes.tracker_optics import POINTS, FakeOptics

BAUD = 9600
NEAR = {name: np.array(p) + np.array([30.0, -20.0, 10.0]) for name, p in POINTS.items()}


def config(**changes: object) -> TrackerConfig:
    ers = tuple(ErsPoint(name=f"E{i}", xyz_mm=(float(i), 0.0, 0.0), sigma_mm=0.01) for i in range(4))
    base = TrackerConfig(
        protocol="geocom", port="x", device_class="total-station", station_pose=(0.0,) * 6, ers=ers, two_face=True
    )
    return base.model_copy(update=changes)


def covariance(p_T_mm: Array) -> Array:
    return np.diag([0.3**2, 0.4**2, 0.5**2])


class Bench:
    """One tracker, one station, one line."""

    def __init__(self, *, checksum: bool = False, geocom: dict[str, Any] | None = None, **changes: object) -> None:
        geocom = geocom or {}
        self.loop = asyncio.get_running_loop()
        self.wire = VirtualSerial(self.loop, BAUD)
        self.optics = FakeOptics(noise_mm=0.0)
        self.station = GeocomStation(self.optics, self.wire.far, self.loop)
        self.tracker = GeocomTracker(
            self.wire.near, config(geocom=GeocomConfig(checksum=checksum, **geocom), **changes), covariance
        )

    def on_the_wire(self) -> list[bytes]:
        """Both directions as they pass, from now on."""
        seen: list[bytes] = []
        to_device, to_host = self.wire.to_device.send, self.wire.to_host.send
        self.wire.to_device.send = lambda data: (seen.append(data), to_device(data))  # type: ignore[method-assign,assignment,return-value]
        self.wire.to_host.send = lambda data: (seen.append(data), to_host(data))  # type: ignore[method-assign,assignment,return-value]
        return seen


def on_bench(scenario: Callable[[Bench], Awaitable[None]], **changes: Any) -> None:
    async def main() -> None:
        bench = Bench(**changes)
        await bench.tracker.connect()
        await scenario(bench)
        await bench.tracker.close()

    run_virtual(main)


def test_identity() -> None:
    async def main() -> Identity:
        return await Bench().tracker.connect()

    assert run_virtual(main) == Identity("tracker", "Leica", "SIM TS60", "366001", "1.0.0")


@pytest.mark.parametrize("name", list(POINTS))
@pytest.mark.parametrize("face", [1, 2])
def test_a_point_comes_back_in_the_station_frame(name: str, face: int) -> None:
    async def scenario(bench: Bench) -> None:
        start_s = bench.loop.time()
        reading = await bench.tracker.measure(name, NEAR[name], face)
        np.testing.assert_allclose(reading.p_T_mm, POINTS[name], atol=1e-6)
        np.testing.assert_allclose(reading.cov_mm2, covariance(reading.p_T_mm))
        assert (reading.target, reading.face, reading.degraded) == (name, face, False)
        assert {shot[2] for shot in bench.optics.shots} == {face}
        # 2 s for the point, and the wire time of six exchanges at 9600 baud.
        assert 2.3 < reading.t_s - start_s < 3.0

    on_bench(scenario)


def test_the_sequence_on_the_wire() -> None:
    async def scenario(bench: Bench) -> None:
        seen = bench.on_the_wire()
        await bench.tracker.measure("N1", NEAR["N1"], 2)
        requests = [line for line in seen if line.startswith(b"%R1Q")]
        assert [int(line.split(b",")[1]) for line in requests] == [2008, 9027, 9037, 2008, 2108, 2167]
        trids = [int(line.split(b":")[0].split(b",")[2]) for line in requests]
        assert trids == list(range(trids[0], trids[0] + 6))
        hz, v = (float(p) for p in requests[1].split(b":")[1].split(b",")[:2])
        east, north, up = NEAR["N1"]
        assert v > np.pi  # face 2
        across = np.hypot(east, north)
        np.testing.assert_allclose([np.sin(hz), np.cos(hz)], [-east / across, -north / across], atol=1e-9)
        np.testing.assert_allclose(np.cos(v), up / np.linalg.norm(NEAR["N1"]), atol=1e-9)

    on_bench(scenario)


def test_the_checksum_form_works_and_refuses_a_wrong_one() -> None:
    async def scenario(bench: Bench) -> None:
        seen = bench.on_the_wire()
        reading = await bench.tracker.measure("N2", NEAR["N2"])
        np.testing.assert_allclose(reading.p_T_mm, POINTS["N2"], atol=1e-6)
        assert all(line.split(b":")[0].count(b",") == 3 for line in seen)
        bench.station.faults.bad_crc = True
        with pytest.raises(DeviceSilent):
            await bench.tracker.measure("N2", NEAR["N2"])
        assert bench.tracker.line.bad_lines == 1

    on_bench(scenario, checksum=True)


def test_nothing_in_the_search_window() -> None:
    async def scenario(bench: Bench) -> None:
        with pytest.raises(TargetLost) as caught:
            await bench.tracker.measure("N1", -NEAR["N1"])
        assert caught.value.where == "N1"
        assert "8710" in caught.value.cause

    on_bench(scenario)


@pytest.mark.parametrize("code", [1283, 1284])
def test_accuracy_warnings_keep_the_point_and_inflate_it(code: int) -> None:
    async def scenario(bench: Bench) -> None:
        bench.station.faults.measure_code = code
        reading = await bench.tracker.measure("N3", NEAR["N3"])
        np.testing.assert_allclose(reading.p_T_mm, POINTS["N3"], atol=1e-6)
        assert reading.degraded
        np.testing.assert_allclose(reading.cov_mm2, 9.0 * covariance(reading.p_T_mm))

    on_bench(scenario)


def test_an_inaccurate_shot_is_degraded() -> None:
    async def scenario(bench: Bench) -> None:
        bench.optics.status["N3"] = "inaccurate"
        assert (await bench.tracker.measure("N3", NEAR["N3"])).degraded

    on_bench(scenario)


@pytest.mark.parametrize(
    ("fault", "value", "error"),
    [
        ("measure_code", 1285, TargetLost),
        ("measure_code", 1292, TargetLost),
        ("measure_code", 8710, TargetLost),
        ("measure_code", 1291, DeviceRefused),
        ("measure_code", 9999, DeviceRefused),
        ("com_code", 3077, DeviceRefused),
        ("zero", True, TargetLost),
        ("silent", True, DeviceSilent),
        ("wrong_trid", True, DeviceSilent),
        ("cut_to", 15, DeviceSilent),
        ("carriage_return_only", True, DeviceSilent),
        ("late_s", 1.5, DeviceSilent),
    ],
)
def test_faults_are_never_points_and_pass(fault: str, value: object, error: type[Exception]) -> None:
    async def scenario(bench: Bench) -> None:
        normal = getattr(bench.station.faults, fault)
        setattr(bench.station.faults, fault, value)
        with pytest.raises(error):
            await bench.tracker.measure("N1", NEAR["N1"])
        setattr(bench.station.faults, fault, normal)
        reading = await bench.tracker.measure("N2", NEAR["N2"])
        np.testing.assert_allclose(reading.p_T_mm, POINTS["N2"], atol=1e-6)

    on_bench(scenario)


def test_silence_is_noticed_within_about_a_second() -> None:
    async def scenario(bench: Bench) -> None:
        bench.station.faults.silent = True
        start_s = bench.loop.time()
        with pytest.raises(DeviceSilent, match="DoMeasure"):
            await bench.tracker.measure("N1", NEAR["N1"])
        assert bench.loop.time() - start_s == pytest.approx(1.05)

    on_bench(scenario)


def test_a_late_reply_is_counted_and_never_taken_for_the_next() -> None:
    async def scenario(bench: Bench) -> None:
        bench.station.faults.late_s = 1.2
        with pytest.raises(DeviceSilent):
            await bench.tracker.measure("N1", NEAR["N1"])
        bench.station.faults.late_s = 0.0
        reading = await bench.tracker.measure("N2", NEAR["N2"])
        np.testing.assert_allclose(reading.p_T_mm, POINTS["N2"], atol=1e-6)
        assert bench.tracker.line.stale_replies == 1

    on_bench(scenario)


def test_the_deadline_holds_for_the_whole_measurement() -> None:
    async def scenario(bench: Bench) -> None:
        bench.optics.measure_s = 60.0
        start_s = bench.loop.time()
        with pytest.raises((DeviceSilent, TargetLost)):
            await bench.tracker.measure("N1", NEAR["N1"])
        assert bench.loop.time() - start_s < 5.0

    on_bench(scenario, measure_timeout_s=4.0)


def test_a_busy_instrument_is_asked_again() -> None:
    async def scenario(bench: Bench) -> None:
        bench.station.faults.measure_code = 1293
        bench.loop.call_later(3.0, setattr, bench.station.faults, "measure_code", 0)
        reading = await bench.tracker.measure("N1", NEAR["N1"])
        np.testing.assert_allclose(reading.p_T_mm, POINTS["N1"], atol=1e-6)

    on_bench(scenario)


def test_a_flipped_digit_without_checksum_is_caught_by_the_second_reading() -> None:
    async def scenario(bench: Bench) -> None:
        send, hits = bench.wire.to_host.send, 0

        def flip(data: bytes) -> None:
            nonlocal hits
            if data.count(b",") == 5 and not hits:
                hits, at = 1, data.rfind(b".") - 1
                data = data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]
            send(data)

        bench.wire.to_host.send = flip  # type: ignore[method-assign]
        with pytest.raises(BadReply, match="differ") as caught:
            await bench.tracker.measure("N1", NEAR["N1"])
        assert hits == 1
        assert 100.0 < float(caught.value.value or 0.0) <= 1000.0  # the metre digit moved by one

    on_bench(scenario)


def test_a_vanished_port_ends_the_request_at_once() -> None:
    async def scenario(bench: Bench) -> None:
        task = asyncio.ensure_future(bench.tracker.measure("N1", NEAR["N1"]))
        await asyncio.sleep(0.5)
        bench.wire.unplug("pulled")
        with pytest.raises(LinkLost, match="pulled"):
            await task
        bench.wire.replug()
        await bench.tracker.connect()

    on_bench(scenario)


def test_an_instrument_that_sleeps_through_the_first_request_is_woken() -> None:
    async def main() -> Identity:
        bench = Bench()
        bench.station.faults.silent = True
        bench.loop.call_later(1.5, setattr, bench.station.faults, "silent", False)
        return await bench.tracker.connect()

    assert run_virtual(main).serial == "366001"


def test_one_face_only() -> None:
    async def scenario(bench: Bench) -> None:
        with pytest.raises(DeviceRefused):
            await bench.tracker.measure("N1", NEAR["N1"], 2)

    on_bench(scenario, two_face=False)


@pytest.mark.parametrize("commas", [5, 10], ids=["GetSimpleMea", "GetFullMeas"])
def test_no_single_bit_flip_gives_a_wrong_point(commas: int) -> None:
    """Every bit of one of the two replies, flipped: refused, or still the point within three sigma."""

    async def scenario(bench: Bench) -> None:
        bench.optics.measure_s = 0.0
        await bench.tracker.measure("N1", NEAR["N1"])
        send, state = bench.wire.to_host.send, {"bit": 0, "length": 1}

        def flip(data: bytes) -> None:
            if data.count(b",") == commas:
                state["length"] = len(data)
                data = flipped(data, state["bit"])
            send(data)

        bench.wire.to_host.send = flip  # type: ignore[method-assign]
        taken = refused = 0
        while state["bit"] < 8 * state["length"]:
            # Each time another target, so that a frozen sensor is not the reason for a refusal.
            name = ("N1", "N2")[state["bit"] % 2]
            try:
                reading = await bench.tracker.measure(name, NEAR[name])
            except (BadReply, DeviceSilent, DeviceRefused, TargetLost):
                refused += 1
            else:
                taken += 1
                off_mm = np.abs(reading.p_T_mm - POINTS[name])
                assert np.all(off_mm <= 3.0 * np.sqrt(np.diag(reading.cov_mm2))), state["bit"]
            state["bit"] += 1
        assert refused > 200
        assert taken > 50  # the last digits of a number may differ by less than the noise

    on_bench(scenario, measure_timeout_s=3.0)


def test_the_instruments_own_sigma_widens_the_model_across_the_line_of_sight() -> None:
    async def scenario(bench: Bench) -> None:
        bench.station.faults.sigma_angle_rad = 1e-4
        reading = await bench.tracker.measure("N3", NEAR["N3"])
        distance_mm = float(np.linalg.norm(POINTS["N3"]))
        model = covariance(reading.p_T_mm)
        # N3 lies to the north: the line of sight is y, across it are x and z.
        assert reading.cov_mm2[1, 1] == pytest.approx(model[1, 1], rel=1e-3)
        more_mm2 = (1e-4 * distance_mm) ** 2 - 0.5 * (model[0, 0] + model[2, 2])
        assert reading.cov_mm2[0, 0] == pytest.approx(model[0, 0] + more_mm2, rel=1e-3)
        assert reading.cov_mm2[2, 2] == pytest.approx(model[2, 2] + more_mm2, rel=1e-3)
        bench.station.faults.sigma_angle_rad = 0.02
        with pytest.raises(BadReply, match="accuracy of the angles"):
            await bench.tracker.measure("N1", NEAR["N1"])

    on_bench(scenario)


def test_the_distance_of_the_point_before_is_refused_by_its_time() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.tracker.measure("N1", NEAR["N1"])
        bench.station.faults.stale_distance = True
        with pytest.raises(BadReply, match="point before"):
            await bench.tracker.measure("N2", NEAR["N2"])
        bench.station.faults.stale_distance = False
        np.testing.assert_allclose((await bench.tracker.measure("N2", NEAR["N2"])).p_T_mm, POINTS["N2"], atol=1e-6)

    on_bench(scenario)


def test_an_older_firmware_is_read_twice_by_the_simple_procedure() -> None:
    async def scenario(bench: Bench) -> None:
        bench.station.faults.missing = {2167}
        seen = bench.on_the_wire()
        for name in ("N1", "N2"):
            np.testing.assert_allclose((await bench.tracker.measure(name, NEAR[name])).p_T_mm, POINTS[name], atol=1e-6)
        asked = [int(line.split(b",")[1]) for line in seen if line.startswith(b"%R1Q")]
        assert asked.count(2167) == 1
        assert asked.count(2108) == 4

    on_bench(scenario)


AIR = {"pressure_hpa": 980.0, "dry_c": 24.0, "wet_c": 17.5}


def test_prism_and_air_are_written_and_correct_the_distance() -> None:
    async def scenario(bench: Bench) -> None:
        head = bench.station.head
        assert (head.prism_mm, head.air) == (pytest.approx(-16.9), Air(980.0, 24.0, 17.5))
        # 12 K warmer and 33 hPa less than the reference air, at about 1 ppm a K and 0.28 ppm a hPa.
        assert head.air.ppm() == pytest.approx(21.0, abs=0.5)
        head.true_prism_mm, head.true_air = -16.9, Air(980.0, 24.0, 17.5)
        np.testing.assert_allclose((await bench.tracker.measure("N3", NEAR["N3"])).p_T_mm, POINTS["N3"], atol=1e-6)
        head.true_prism_mm = 0.0
        short = (await bench.tracker.measure("N3", NEAR["N3"])).p_T_mm
        assert np.linalg.norm(short) - np.linalg.norm(POINTS["N3"]) == pytest.approx(-16.9, abs=1e-6)

    on_bench(scenario, geocom={"prism_mm": -16.9, "air": AIR})


@pytest.mark.parametrize(
    ("settings", "lie", "words"),
    [
        ({"prism_mm": -34.4}, lambda station: station.faults.ignores.add(2024), "prism constant"),
        ({"air": AIR}, lambda station: station.faults.ignores.add(2028), "pressure"),
        ({}, lambda station: station._procedures.update({108: lambda params: (0, ("4",))}), "decimals"),
    ],
)
def test_an_instrument_that_keeps_another_setting_is_refused(
    settings: dict[str, Any], lie: Callable[[GeocomStation], None], words: str
) -> None:
    async def main() -> None:
        bench = Bench(geocom=settings)
        lie(bench.station)
        with pytest.raises(ReadBackMismatch, match=words):
            await bench.tracker.connect()

    run_virtual(main)


def test_a_reflector_outside_the_fine_window_is_searched_where_that_is_allowed() -> None:
    aside = NEAR["N3"] + np.array([400.0, 0.0, 250.0])  # 2.5 and 1.6 deg off

    async def narrow(bench: Bench) -> None:
        with pytest.raises(TargetLost, match="8710"):
            await bench.tracker.measure("N3", aside)

    async def wide(bench: Bench) -> None:
        np.testing.assert_allclose((await bench.tracker.measure("N3", aside)).p_T_mm, POINTS["N3"], atol=1e-6)
        with pytest.raises(TargetLost):
            await bench.tracker.measure("N3", -NEAR["N3"])

    on_bench(narrow)
    on_bench(wide, geocom={"search_deg": 8.0})


def test_a_measurement_that_is_given_up_stops_the_motors() -> None:
    async def scenario(bench: Bench) -> None:
        bench.station.faults.turn_s = 5.0
        task = asyncio.ensure_future(bench.tracker.measure("N1", NEAR["N1"]))
        await asyncio.sleep(1.0)
        assert bench.station._turning is not None
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await asyncio.sleep(0.1)
        assert bench.station._turning is None
        bench.station.faults.turn_s = 0.5
        np.testing.assert_allclose((await bench.tracker.measure("N2", NEAR["N2"])).p_T_mm, POINTS["N2"], atol=1e-6)
        assert (bench.tracker.line.bad_lines, bench.tracker.line.noise_bytes) == (0, 0)
        assert bench.tracker.line.stale_replies == 1  # "aborted", under the number of the call that was given up

    on_bench(scenario)


def test_garbage_between_replies_costs_nothing_and_a_flood_ends_the_request() -> None:
    async def scenario(bench: Bench) -> None:
        bench.station.faults.garbage_bytes = 40
        for name in POINTS:
            np.testing.assert_allclose((await bench.tracker.measure(name, NEAR[name])).p_T_mm, POINTS[name], atol=1e-6)
        assert bench.tracker.line.noise_bytes > 0
        bench.station.faults.garbage_bytes = 0
        task = asyncio.ensure_future(bench.tracker.measure("N1", NEAR["N1"]))
        await asyncio.sleep(0.5)
        bench.wire.far.write(b"%R1P,broken\r\n" * 6)
        with pytest.raises(BadReply, match="6 bad lines"):
            await task

    on_bench(scenario)
