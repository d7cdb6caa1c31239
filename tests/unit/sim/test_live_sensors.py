"""Errors and faults of the simulated sensors that follow a part, and sockets that slip under it.

Scale, misalignment, late samples, mounting; occlusion, swapped tools, a camera that repeats itself or was pushed."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from docking.config import CellFile
from docking.config.load import load_cell, load_job
from sim.plant import Plant
from sim.shapes import pose_of
from sim.tracker.ndi import NdiCamera
from sim.tracker.plant_scene import PlantScene, mounted_pose
from sim.tracker.vectornav import TO_SENSOR, InertialErrors, VectorNavSensor
from sim.truth import load_truth
from sim.virtual_time import run_virtual
from sim.wires.virtual_serial import VirtualSerial
from tests.fakes.camera_scene import FakeScene
from tests.support.dry_cell import CELLS

NO_ERRORS = ((0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0), 0.0, 0.0)


def felt(errors: InertialErrors, turn_rad_s: Callable[[float], float], at_s: float) -> np.ndarray:
    """What a sensor that turns about its own z says at `at_s`: force and rate (6,)."""

    async def main() -> np.ndarray:
        loop = asyncio.get_running_loop()
        angle, last = 0.0, loop.time()

        def pose(t_s: float) -> tuple[np.ndarray, np.ndarray]:
            nonlocal angle, last
            angle, last = angle + turn_rad_s(t_s) * (t_s - last), t_s
            return Rotation.from_euler("z", angle).as_matrix(), np.zeros(3)

        sensor = VectorNavSensor(pose, VirtualSerial(loop, 921600).far, loop, 1)
        sensor.errors = errors
        await asyncio.sleep(at_s)
        sensor.close()
        return np.array(sensor._values)

    return run_virtual(main)


def test_a_scale_error_and_a_turned_mounting_show_in_force_and_rate() -> None:
    clean = felt(InertialErrors(*NO_ERRORS), lambda t: 0.5, 1.0)
    np.testing.assert_allclose(clean, [0, 0, -9.80665, 0, 0, -0.5], atol=2e-3)  # its z points down
    big = felt(InertialErrors(*NO_ERRORS, scale=0.02), lambda t: 0.5, 1.0)
    np.testing.assert_allclose(big, 1.02 * clean, rtol=1e-6, atol=1e-9)
    turned = felt(InertialErrors(*NO_ERRORS, misalignment_rad=0.01), lambda t: 0.5, 1.0)
    leans = -Rotation.from_rotvec(np.full(3, 0.01 / np.sqrt(3.0))).inv().as_matrix()[:, 2] * 9.80665
    np.testing.assert_allclose(turned[:3], leans, atol=1e-3)


def test_late_samples_show_what_was() -> None:
    def turning(t_s: float) -> float:
        return 0.0 if t_s % 1000.0 < 1.0 else 1.0

    assert felt(InertialErrors(*NO_ERRORS), turning, 1.7)[5] == pytest.approx(-1.0, abs=0.01)
    assert felt(InertialErrors(*NO_ERRORS, late_s=0.8), turning, 1.7)[5] == pytest.approx(0.0, abs=0.01)


def camera_answers(change: Callable[[Any], None]) -> tuple[str, str]:
    """Two answers of a camera of 60 Hz, the second half a second after `change(faults)`."""

    async def main() -> tuple[str, str]:
        loop = asyncio.get_running_loop()
        camera = NdiCamera(FakeScene(speed_mm_s=10.0), VirtualSerial(loop, 9600).far, loop, {}, ("nose", "ring"))
        camera.noise_mm = 0.0
        for command in ("INIT", "PINIT:01", "PENA:01D", "PINIT:02", "PENA:02D", "TSTART"):
            name, _, params = command.partition(":")
            assert camera._answer(name, params) == "OKAY"
        before = camera._answer("TX", "1001")
        change(camera.faults)
        await asyncio.sleep(0.5)
        return before, camera._answer("TX", "1001")

    return run_virtual(main)


def places(answer: str) -> list[str]:
    """Tool part of each line without status and frame number."""
    return [line[: -8 - 8] for line in answer.split("\n")[:2]]


def test_an_occluded_camera_sees_nothing_and_says_so() -> None:
    _, after = camera_answers(lambda faults: setattr(faults, "occluded", True))
    assert after.count("MISSING") == 2
    assert after.endswith("00" + "0000")  # no marker


def test_swapped_tools_are_told_at_each_others_place() -> None:
    before, after = camera_answers(lambda faults: setattr(faults, "swapped", {"nose": "ring", "ring": "nose"}))
    nose, ring = (float(line[-13:-6]) / 100.0 for line in places(before))
    swapped_nose, swapped_ring = (float(line[-13:-6]) / 100.0 for line in places(after))
    assert (swapped_nose, swapped_ring) == pytest.approx((ring, nose), abs=0.02)


def test_a_stale_camera_counts_on_and_a_pushed_one_shifts_everything() -> None:
    before, after = camera_answers(lambda faults: setattr(faults, "stale", True))
    assert [line[2:] for line in places(before)][1] == [line[2:] for line in places(after)][1]
    assert before.split("\n")[0][-8:] != after.split("\n")[0][-8:]
    before, after = camera_answers(lambda faults: setattr(faults, "shift_mm", (0.0, 0.0, 2.5)))
    assert float(places(after)[1][-13:-6]) - float(places(before)[1][-13:-6]) == pytest.approx(250.0, abs=1.0)


@pytest.fixture(scope="module")
def plant() -> tuple[CellFile, Plant]:
    cell = load_cell(CELLS / "lab-can-tracked.toml")
    job = load_job(CELLS / "lab-can-tracked.job.toml", cell)
    return cell, Plant(cell, job, load_truth(CELLS / "lab-can-tracked.sim.toml"), 2)


def test_tools_and_sensor_ride_where_the_cell_file_has_them(plant: tuple[CellFile, Plant]) -> None:
    cell, body = plant
    X = body.component_pose_W()
    scene = PlantScene(body, (0.0,) * 6, {"nose": (430.0, -250.0, 90.0)}, ())
    np.testing.assert_allclose(scene.tools_T(0.0)["nose"][1], X.apply(np.array([430.0, -250.0, 90.0])))
    assert cell.inertial is not None
    R, place = mounted_pose(body, cell.inertial.mount_pose, 0.0)
    mounted = X @ pose_of(cell.inertial.mount_pose)
    np.testing.assert_allclose(R @ TO_SENSOR, mounted.R, atol=1e-12)
    np.testing.assert_allclose(place, mounted.t_mm)


def test_sockets_that_slip_together_carry_the_part_and_no_encoder_shows_it(plant: tuple[CellFile, Plant]) -> None:
    _, body = plant
    encoders, before = body.encoder_mm().copy(), body.component_pose_W()
    for axis in ("A.X", "B.X", "C.X", "D.X"):
        body.slip(axis, 0.7)
    after = body.component_pose_W()
    assert after.t_mm[0] - before.t_mm[0] == pytest.approx(0.7, abs=0.02)
    np.testing.assert_array_equal(body.encoder_mm(), encoders)
