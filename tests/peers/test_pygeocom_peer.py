"""pygeocom, a second client written by others, drives the simulated station over a pseudo-terminal.

It sends no transaction numbers and polls every half second; here its clock runs forty times as fast.
"""

from __future__ import annotations

import asyncio
import math
import sys
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sim.tracker.geocom import GeocomStation
from sim.tracker.geocom_head import Air
from sim.wires.pty_serial import PtySerial
from tests.fakes.tracker_optics import POINTS, FakeOptics

pytestmark = [pytest.mark.peer, pytest.mark.wires]

HASTE = 40.0


def use(path: str) -> dict[str, Any]:
    """What a user of pygeocom does: identify, correct for the air, turn to a target in both faces, measure."""
    from geocom import AtmosphericCorrectionData, TotalStation
    from geocom.enums import ATRMode, LeicaReturnCode, OnOffType, PositionMode
    from surveytools import Angle

    station = TotalStation(path, baudrate=115200)
    seen: dict[str, Any] = {"ok": LeicaReturnCode.GRC_OK}
    seen["name"] = station.get_instrument_name()
    seen["number"] = station.get_instrument_number()
    air = station.get_atm_correction()
    seen["air"] = station.set_atm_correction(AtmosphericCorrectionData(air.lambda_value, 990.0, 21.0, 15.0))
    seen["prism"] = station.get_prism_constant()
    seen["atr"] = station.set_user_atr_state(OnOffType.ON)
    east, north, up = POINTS["N2"]
    hz, v = math.atan2(east, north) % (2.0 * math.pi), math.acos(up / math.dist((0.0, 0.0, 0.0), POINTS["N2"]))
    for face, aim in ((1, (hz + 0.001, v)), (2, (hz + math.pi + 0.001, 2.0 * math.pi - v))):
        turned = station.set_telescope_position(
            Angle(aim[0]), Angle(aim[1]), PositionMode.AUT_NORMAL, ATRMode.AUT_TARGET
        )
        point = station.measure("N2", None, None)
        angles = station.get_angle1(SimpleNamespace(value=1))
        seen[face] = (turned, point.direction.value_rad, point.zenith.value_rad, point.slope_distances, angles.face_def)
    seen["nothing"] = station.fine_adjust(Angle(1e-3), Angle(1e-3))
    station.serialPort.close()
    return seen


async def test_pygeocom_measures_a_point_in_both_faces(monkeypatch: pytest.MonkeyPatch) -> None:
    import geocom  # noqa: F401

    hasty = SimpleNamespace(sleep=lambda s: time.sleep(s / HASTE))
    monkeypatch.setattr(sys.modules["geocom.TotalStation"], "time", hasty)
    loop = asyncio.get_running_loop()
    terminal = PtySerial(loop, 115200)
    terminal.open()
    station = GeocomStation(FakeOptics(measure_s=0.05, noise_mm=0.0), terminal, loop)
    seen = await asyncio.to_thread(use, terminal.path)
    terminal.close()
    assert (seen["name"], seen["number"], seen["prism"]) == ('"SIM TS60"', 366001, 0.0)
    assert station.head.air == Air(990.0, 21.0, 15.0)
    assert seen["air"] is seen["atr"] is seen["ok"]
    for face in (1, 2):
        turned, hz, v, slope_m, said = seen[face]
        assert turned is seen["ok"]
        assert said.value == face - 1
        across = slope_m * math.sin(v)
        found_mm = np.array((across * math.sin(hz), across * math.cos(hz), slope_m * math.cos(v))) * 1000.0
        np.testing.assert_allclose(found_mm, POINTS["N2"], atol=1e-6)
    assert seen["nothing"] is seen["ok"]
