"""A camera pair follows the part in a docking; its driver against the simulated computer, and against bad lines."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.config.live import StereoConfig
from docking.errors import DeviceSilent, LinkError
from docking.sightings import PointFrame
from docking.state import State
from docking.stereo_files import stereo_camera
from drivers.pixel_pair import PixelPair, decode
from sim.tracker.pixel_pair import PixelPairComputer
from sim.virtual_time import run_virtual
from sim.wires.virtual_serial import VirtualSerial
from tests.e2e.test_live_pose import X_AXES, at
from tests.support.tracked_cell import run_tracked

LENS = {"width_px": 4096.0, "height_px": 3000.0, "fx_px": 4000.0, "fy_px": 4000.0, "cx_px": 2048.0, "cy_px": 1500.0}
BENT = {"distortion": (-0.05, 0.01, 0.001, -0.0005), "pixel_sigma": 0.1}
PAIR = StereoConfig.model_validate(
    {
        "port": "socket://vision:4000",
        "cameras": tuple(
            {**LENS, **BENT, "name": name, "pose": (x, -3000.0, 1000.0, -90.0, 0.0, 0.0)}
            for name, x in (("left", -900.0), ("right", 900.0))
        ),
    }
)
PLACES = {"P1": np.array([0.0, 0.0, 1000.0]), "P2": np.array([400.0, -200.0, 1100.0])}


def test_a_pair_follows_the_part_and_stops_the_move_of_one_that_slipped(tmp_path: Path) -> None:
    slip = [at("approach-3", 0.5, axis, "slip", values={"by_mm": -1.2}) for axis in X_AXES]
    blind = at("align", 0.3, "camera", "blind", values={"value": ("right",)}, for_s=2.0)
    run = run_tracked(4, tmp_path, [blind, *slip], stereo=PAIR, deviation_mm=0.8)
    assert run.state is State.FAULT
    (alarm,) = run.records("alarm")
    assert alarm["code"] == 2151
    assert alarm["value"] == pytest.approx(1.2, abs=0.3)
    first = np.array([row for row in run.seen if row[0] == 1])
    assert first[:, 2].max() > 1.8  # one blind camera is a lost view
    assert np.quantile(first[:, 3], 0.9) <= 0.1


def on_line(act: Any, seconds: float) -> tuple[list[PointFrame], list[LinkError], PixelPair]:
    """Frames while the computer streams and `act(computer)` happens after a second."""

    async def main() -> tuple[list[PointFrame], list[LinkError], PixelPair]:
        loop = asyncio.get_running_loop()
        wire = VirtualSerial(loop, 921600)
        computer = PixelPairComputer(lambda t_s: PLACES, PAIR.cameras, wire.far, loop, 20.0, 5)
        first, second = (stereo_camera(one.name, one) for one in PAIR.cameras)
        stream = PixelPair(wire.near, (first, second))
        frames: list[PointFrame] = []
        lost: list[LinkError] = []
        stream.on_frame, stream.on_lost = frames.append, lost.append
        await stream.connect()
        await stream.start()
        await asyncio.sleep(1.0)
        act(computer)
        await asyncio.sleep(seconds)
        await stream.close()
        computer.close()
        return frames, lost, stream

    return run_virtual(main)


def test_frames_hold_the_points_with_their_covariance() -> None:
    frames, lost, _ = on_line(lambda computer: setattr(computer.faults, "blind", {"left"}), 0.5)
    assert not lost
    seen = [f for f in frames if f.tools]
    assert len(seen) == pytest.approx(20, abs=2)
    assert all(not f.tools for f in frames[len(seen) :])
    assert frames[-1].t_s - frames[0].t_s == pytest.approx((frames[-1].number - frames[0].number) / 20.0, abs=1e-3)
    for k, (name, place) in enumerate(PLACES.items()):
        tools = [f.tools[k] for f in seen]
        assert {t.name for t in tools} == {name}
        errors = np.array([t.p_T_mm - place for t in tools])
        sd = np.sqrt(np.diag(tools[0].cov_T_mm2))
        assert np.all(np.abs(errors.mean(axis=0)) < 4.0 * sd / np.sqrt(len(tools)))
        np.testing.assert_array_less(0.5 * sd, errors.std(axis=0))
        np.testing.assert_array_less(errors.std(axis=0), 1.6 * sd)


def test_silence_and_wrong_checksums_end_the_stream() -> None:
    _, lost, _ = on_line(lambda computer: setattr(computer.faults, "silent", True), 2.0)
    assert [type(e) for e in lost] == [DeviceSilent]
    _, lost, stream = on_line(lambda computer: setattr(computer.faults, "bad_crc", True), 2.0)
    assert len(lost) == 1
    assert stream.bad_lines > 5


@pytest.mark.parametrize(
    "body", ["PX,left,1,5,P1,1.0", "PX,left,1,5,P1,nan,2", "PX,left,-1,5", "PX,left,1,5,P1,1,2,P1,3,4", "PY,left,1,5"]
)
def test_lines_of_another_grammar_are_refused(body: str) -> None:
    from drivers.line_codec import crc16_arc

    raw = body.encode()
    with pytest.raises(ValueError, match=r"not a|checksum"):
        decode(b"$" + raw + b"*%04X" % crc16_arc(raw))
