"""Camera and inertial sensor beside a docking in virtual time: what they stream is what the component does."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np

from docking.assemble.streams import camera_of, inertial_of, simulated_camera, simulated_inertial
from docking.config.instruments import InertialConfig, NdiConfig
from docking.sightings import InertialSample, PointFrame, Sight
from docking.state import State
from drivers.ndi_line import DEFAULT_BAUD
from sim.fault_book import FaultBook
from sim.shapes import pose_of
from sim.virtual_time import run_virtual
from sim.wires.virtual_serial import VirtualSerial
from tests.support.dry_cell import DryCell

CAMERA_POSE = (1500.0, -1800.0, 900.0, -90.0, 0.0, 45.0)


def test_what_the_sensors_stream_is_what_the_component_does(tmp_path: Path) -> None:
    (tmp_path / "frame.rom").write_bytes(b"NDI\\0 a definition" + bytes(90))
    tools = ({"name": "frame", "rom": "frame.rom"},)
    camera_config = NdiConfig.model_validate({"port": "x", "station_pose": CAMERA_POSE, "rate_hz": 5.0, "tools": tools})

    async def main() -> tuple[DryCell, list[PointFrame], list[InertialSample], list[str]]:
        run = DryCell("lab-can", 3, tmp_path / "run.jsonl")
        await run.build()
        added = {"camera": camera_config, "inertial": InertialConfig(port="x", rate_hz=5)}
        cell = run.cell.model_copy(update=added)
        lines = [VirtualSerial(run.loop, baud, name) for baud, name in ((DEFAULT_BAUD, "camera"), (115200, "inertial"))]
        simulated_camera(cell, run.job, tmp_path, run.far, lines[0].far)
        simulated_inertial(run.far, lines[1].far)
        camera, sensor = camera_of(cell, tmp_path, lines[0].near), inertial_of(cell, lines[1].near)
        frames: list[PointFrame] = []
        samples: list[InertialSample] = []
        camera.on_frame, sensor.on_sample = frames.append, samples.append
        for stream in (camera, sensor):
            await stream.connect()
            await stream.start()
        await run.dock()
        await camera.stop()
        for stream in (camera, sensor):
            await stream.close()
        assert not asyncio.all_tasks() - {asyncio.current_task()}
        listed = FaultBook(cell, run.far.plant, run.far.world, run.far.devices).devices
        return run, frames, samples, sorted(set(listed["camera"]) & set(listed["inertial"]))

    run, frames, samples, faults = run_virtual(main)
    assert run.state is State.DOCKED
    assert {"silent", "bad_crc", "garbage_bytes", "frozen"} <= set(faults)
    from_W = pose_of(CAMERA_POSE).inverse()
    last = frames[-1]
    assert [(tool.name, tool.sight) for tool in last.tools] == [("frame", Sight.SEEN)]
    true = from_W @ run.far.plant.component_pose_W()
    np.testing.assert_allclose(last.tools[0].p_T_mm, true.t_mm, atol=0.3)
    markers = [run.far.plant.target_W_mm(t.name, run.loop.time()) for t in run.job.component.targets]
    np.testing.assert_allclose(last.strays_T_mm, from_W.apply(np.array(markers)), atol=0.3)
    # It travelled: the first frame sees the component at its stand-off.
    went_mm = last.tools[0].p_T_mm - frames[0].tools[0].p_T_mm
    planned = np.linalg.norm(sum(plan.correction.shift_mm for plan in run.plans))
    assert np.linalg.norm(went_mm) > 0.5 * float(planned) > 1.0
    force = np.linalg.norm([s.force_m_s2 for s in samples], axis=1)
    # The axes accelerate by some mm/s^2: the sensor feels the weight and its own bias, little else.
    assert np.all(np.abs(force - 9.80665) < 0.12)
    assert len(frames) > 0.5 * 5.0 * run.ended_at_s
