"""geocompy, a client written by others, drives the simulated station over a pseudo-terminal."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import numpy as np
import pytest

from sim.tracker.geocom import GeocomStation
from sim.wires.pty_serial import PtySerial
from tests.fakes.tracker_optics import POINTS, FakeOptics

geocompy = pytest.importorskip("geocompy")
pytestmark = [pytest.mark.peer, pytest.mark.wires]


def measure(path: str, checksum: bool) -> dict[str, Any]:
    """What a user of geocompy does, in a thread of its own: identify, aim, search, measure, in both faces."""
    from geocompy.communication import open_serial
    from geocompy.data import Angle
    from geocompy.geo import GeoCom

    east, north, up = POINTS["N1"]
    seen: dict[str, Any] = {}
    with open_serial(path, speed=115200, timeout=5) as line:
        station = GeoCom(line, checksum=checksum)
        seen["name"] = station.csv.get_instrument_name().params
        seen["serial"] = station.csv.get_serial_number().params
        seen["precision"] = station.precision
        hz = math.atan2(east, north)
        zenith = math.acos(up / math.dist((0.0, 0.0, 0.0), (east, north, up)))
        seen["turn"] = station.aut.turn_to(Angle(hz + 0.002), Angle(zenith - 0.002)).error
        for face in (1, 2):
            if face == 2:
                seen["change"] = station.aut.change_face().error
            seen["adjust", face] = station.aut.fine_adjust(Angle(0.02), Angle(0.02)).error
            seen["measure", face] = station.tmc.do_measurement().error
            result = station.tmc.get_simple_measurement(3)
            seen["point", face] = (result.error, result.params)
            seen["face", face] = int(station.tmc.get_face().params.value)
            seen["full", face] = station.tmc.get_complete_measurement(3).params
        seen["coordinate"] = station.tmc.get_coordinate(3).params
        seen["air"] = station.tmc.set_atmospheric_corrections(0.658, 990.0, 21.0, 15.0).error
        seen["air read"] = station.tmc.get_atmospheric_corrections().params
        seen["prism"] = station.tmc.set_prism_correction(-0.0169).error
        seen["prism read"] = station.tmc.get_prism_correction().params
        seen["unknown"] = station.request(4711).error
        station.aut.turn_to(Angle(hz + 0.06), Angle(zenith))
        seen["search"] = station.aut.search(Angle(0.2), Angle(0.05)).error
        station.aut.turn_to(Angle(hz + 1.0), Angle(zenith))
        seen["nothing"] = station.aut.fine_adjust(Angle(0.02), Angle(0.02)).error
    return seen


@pytest.mark.parametrize("checksum", [False, True])
async def test_geocompy_measures_a_point_in_both_faces(checksum: bool) -> None:
    loop = asyncio.get_running_loop()
    terminal = PtySerial(loop, 115200)
    terminal.open()
    GeocomStation(FakeOptics(measure_s=0.05, noise_mm=0.0), terminal, loop)
    seen = await asyncio.to_thread(measure, terminal.path, checksum)
    terminal.close()
    assert (seen["name"], seen["serial"], seen["precision"]) == ("SIM TS60", 366001, 15)
    assert all(int(seen[key]) == 0 for key in ("turn", "change", ("adjust", 1), ("measure", 1)))
    for face in (1, 2):
        code, (hz, v, slope_m) = seen["point", face]
        assert int(code) == 0
        hz_rad, v_rad = float(hz), float(v)
        assert seen["face", face] == face - 1
        across = slope_m * math.sin(v_rad)
        found_m = (across * math.sin(hz_rad), across * math.cos(hz_rad), slope_m * math.cos(v_rad))
        np.testing.assert_allclose(found_m, np.array(POINTS["N1"]) / 1000.0, atol=1e-9)
        full = seen["full", face]
        assert [float(full[i]) for i in (0, 1)] == pytest.approx([hz_rad, v_rad], abs=1e-9)
        assert (float(full[2]), full[6]) == (pytest.approx(2.4e-6), pytest.approx(slope_m, abs=1e-9))
    point, taken_ms, again, _ = seen["coordinate"]
    np.testing.assert_allclose((point.x, point.y, point.z), np.array(POINTS["N1"]) / 1000.0, atol=1e-9)
    assert again == point
    assert taken_ms == seen["full", 2][7] > seen["full", 1][7]
    assert [int(seen[key]) for key in ("air", "prism", "search")] == [0, 0, 0]
    assert seen["air read"] == pytest.approx((0.658, 990.0, 21.0, 15.0))
    assert seen["prism read"] == pytest.approx(-0.0169)
    assert int(seen["unknown"]) == 3081
    assert int(seen["nothing"]) == 8710
