"""A Modbus cell ready to move: real motion, monitors and driver, real bytes, PLCs around the plant. No tracker."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from docking.assemble.motion_side import local_motion
from docking.assemble.simulated import make_far_end, truth_of
from docking.assemble.wires import NearBus
from docking.config import CellFile, JobFile
from docking.config.build import positioners_from
from docking.config.load import load_cell, load_job
from docking.errors import DockingError
from docking.motion import QueuedMotion
from docking.types import Array, MoveResult, Plan
from sim.plc.group import PlcGroup
from sim.plc.modbus_tcp import ModbusTcpConnection
from sim.truth import TruthFile
from sim.virtual_time import run_virtual
from tests.support.motion_record import Record, RecordedPlant
from tests.support.planned_moves import CELLS, a_plan, a_shift, lab_site

MOVES_MM = 2e-4
"""More than this between two scans is motion: 0.02 mm/s."""
ROUNDED_MM = 0.003
"""Segments are rounded to micrometres, servo lags differ by 5 %."""
QUIET_S = 0.6
COMMAND_AT, RUN, RESUME = 0, 7, 10


@dataclass(frozen=True)
class ModbusScene:
    """How a case is set up: cell, seed of plant and plan, size of the move, changes of `[bus]`.

    `along`: straight along the axes of this letter instead of a direction of the seed. `errors_off` are true errors of
    the simulated cell that this case does without.
    """

    name: str = "lab-modbus"
    seed: int = 1
    shift_mm: float = 6.0
    turn_deg: float = 0.2
    speed_mm_s: float = 4.0
    along: str = ""
    bus: tuple[tuple[str, float], ...] = (("timeout_s", 0.05), ("watchdog_s", 0.12), ("poll_s", 0.05))
    errors_off: tuple[str, ...] = ()


@cache
def _files(name: str) -> tuple[CellFile, JobFile, TruthFile]:
    cell = load_cell(CELLS / f"{name}.toml")
    return cell, load_job(CELLS / f"{name}.job.toml", cell), truth_of(CELLS / f"{name}.toml")


@cache
def _plan(scene: ModbusScene, standing_mm: tuple[float, ...]) -> Plan:
    """The move of a scene: most cases of the suite make the same one."""
    reach = {"reach_mm": scene.shift_mm, "turn_deg": scene.turn_deg, "speed_mm_s": scene.speed_mm_s}
    period_s = _files(scene.name)[0].bus.segment_s  # type: ignore[union-attr]
    seed = int(np.random.default_rng(scene.seed).integers(1000))
    start_mm = np.array(standing_mm)
    if scene.along:
        shift = scene.shift_mm * np.eye(3)["XYZ".index(scene.along)]
        return a_shift(lab_site(scene.name), shift, scene.speed_mm_s, start_mm, period_s=period_s, queued=True)
    return a_plan(replace(lab_site(scene.name), **reach), seed, period_s=period_s, queued=True, start_mm=start_mm)


class ReadyModbus:
    """Make it on the loop that runs it. `tamper(frame)` may lose or change what one positioner hears and says."""

    def __init__(self, scene: ModbusScene) -> None:
        self.loop, self.scene = asyncio.get_running_loop(), scene
        cell, job, truth = _files(scene.name)
        bus = cell.bus.model_copy(update=dict(scene.bus))
        limits = cell.limits.model_copy(update={"missing_cycles": 2})
        self.cell: CellFile = cell.model_copy(update={"bus": bus, "limits": limits, "inputs": None})
        self.positioners = positioners_from(self.cell, job)
        truth = truth.model_copy(update={"errors": {**truth.errors, **dict.fromkeys(scene.errors_off, 0.0)}})
        self.plant = make_far_end(self.cell, job, truth, scene.seed).plant
        self.recorded = RecordedPlant(self.plant)
        self.record = Record(self.cell, self.recorded)
        ppm = [self.plant.clock_ppm[p.name] for p in self.cell.positioners]
        late_s = np.linspace(0.0, 1.0, len(ppm)) * bus.start_skew_s
        self.group = PlcGroup(self.recorded, self.cell, ppm, self.loop, late_s.tolist())
        motion = local_motion(self.cell, job, NearBus())
        assert isinstance(motion, QueuedMotion)
        self.motion = motion
        self.victim = self.group.plcs[1]
        self.tamper: Callable[[bytes], Any] = lambda frame: None
        self.commands: list[tuple[int, bytes]] = []
        self.plan: Plan
        self.start_s = self.fault_s = self.ended_s = float("nan")
        self.result: MoveResult | None = None
        self.refused: DockingError | None = None

    async def bring_up(self) -> None:
        await self.group.serve()
        await self.motion.connect()

    async def ready(self) -> None:
        standing = await self.motion.enable()
        self.plan = _plan(self.scene, tuple(standing.tolist()))
        await self.motion.load(self.plan)

    async def move(self, share: float, fault: Callable[[ReadyModbus], Any], *, weigh_s: float = 0.0) -> None:
        """Run the plan; at `share` of its time `fault` happens. Watch for a while, then close.

        The true forces are kept from just before the fault until `weigh_s` after it.
        """
        self.start_s = self.loop.time()
        # Never on the beat of poll and scan.
        self.fault_s = self.start_s + share * self.plan.duration_s + 0.0137
        if weigh_s > 0.0:
            self.recorded.weigh_from_s, self.recorded.weigh_until_s = self.fault_s - 0.02, self.fault_s + weigh_s
        self.loop.call_at(self.fault_s, fault, self)
        try:
            self.result = await self.motion.start(self.plan.plan_hash)
        except DockingError as error:
            self.refused = error
        self.ended_s = self.loop.time()
        await asyncio.sleep(QUIET_S)
        self.watched_until_s = self.loop.time()

    async def close(self) -> None:
        self.tamper = lambda frame: None
        try:
            await self.motion.close()
        except DockingError as error:
            self.refused = self.refused or error
        await self.group.close()

    def index(self, axis: str) -> int:
        return self.cell.axis_names.index(axis)

    # what was seen ------------------------------------------------------------------------------------------------
    def stood_s(self, broken: str | None = None) -> float:
        """Last motion of a healthy axis, after the fault."""
        healthy = np.array([axis != broken for axis in self.cell.axis_names])
        t_s, motor = self.record.motors(self.start_s)
        shown = t_s <= self.watched_until_s
        moving = np.abs(np.diff(motor[shown][:, healthy], axis=0)).max(axis=1) > MOVES_MM
        return float(t_s[int(np.flatnonzero(moving)[-1]) + 1]) - self.fault_s

    def residual_mm(self) -> float:
        """Worst rigid residual of the motors during the whole move and after."""
        t_s, motor = self.record.motors(self.start_s)
        return float(self.record.figure_gap_mm(motor[t_s <= self.watched_until_s], motor[0]).max())

    def stated_mm(self) -> float:
        """Chord error and what start skew and clocks may part at peak speed; docs/mechanics.md (37), (38)."""
        bus, plan = self.cell.bus, self.plan
        speed = float(np.abs(np.diff(plan.q_mm, axis=0)).max()) / plan.period_s
        parted_s = bus.start_skew_s + 2e-6 * bus.clock_ppm * plan.duration_s  # type: ignore[union-attr]
        return plan.chord_error_mm + speed * parted_s + ROUNDED_MM

    def force_rise_n(self) -> float:
        """What came on top of the true internal force after the fault, worst ball."""
        forces = np.array(self.recorded.beyond_n_at)
        return float(np.linalg.norm(forces - forces[0], axis=2).max())

    def assert_at_rest_and_braked(self) -> None:
        """I4, I5: nothing moves after the stop; torque never left an axis whose brake was open."""
        powered = np.array([tick.powered for tick in self.recorded.ticks])
        braked = np.array([tick.braked for tick in self.recorded.ticks])
        assert not (powered[:-1] & ~powered[1:] & ~braked[1:]).any()
        last = self.recorded.ticks[-1]
        assert last.braked[np.array(self.cell.driven)].all()
        assert not last.powered.any()

    def assert_no_second_start(self) -> None:
        """No command that starts motion was sent twice under one number, nor more often than once in this move."""
        starts = [(who, data) for who, data in self.commands if data[3] in (RUN, RESUME)]
        assert len(starts) == len(set(starts)) <= len(self.group.plcs)


def play_modbus(scene: ModbusScene, story: Callable[[ReadyModbus], Any], monkeypatch: Any) -> ReadyModbus:
    """Build the cell, let `story` play it, close. `tamper` acts on the frames of the victim alone.

    It returns None (pass), "request" or "reply" (lost), or a function of the reply's bytes that returns other ones.
    """
    original = ModbusTcpConnection.data_received

    async def main() -> ReadyModbus:
        cell = ReadyModbus(scene)
        defects: list[dict[str, Any]] = []
        cell.loop.set_exception_handler(lambda loop, context: defects.append(context))

        def data_received(connection: ModbusTcpConnection, data: bytes) -> None:
            for number, plc in enumerate(cell.group.plcs):
                if connection.serves(plc) and data[7:10] == b"\x10\0\0":
                    cell.commands.append((number, data[13:17]))
            act = cell.tamper(data) if connection.serves(cell.victim) else None
            transport = connection._transport
            if act is not None:
                connection._transport = _Changed(transport, act)  # type: ignore[assignment]
            if act != "request":
                original(connection, data)
            connection._transport = transport

        monkeypatch.setattr(ModbusTcpConnection, "data_received", data_received)
        await story(cell)
        await cell.close()
        assert not defects, defects
        left = asyncio.all_tasks() - {asyncio.current_task()}
        assert not left, f"left running: {left}"
        return cell

    return run_virtual(main)


class _Changed:
    """A transport that loses or changes one reply."""

    def __init__(self, transport: asyncio.Transport, act: Any) -> None:
        self._transport, self._act = transport, act

    def write(self, data: bytes) -> None:
        if self._act != "reply":
            self._transport.write(self._act(data))

    def is_closing(self) -> bool:
        return self._transport.is_closing()

    def close(self) -> None:
        self._transport.close()


def peak_mm_s(plan: Plan) -> Array:
    """Peak speeds (m,) of the rows of a plan."""
    peak: Array = np.abs(np.diff(plan.q_mm, axis=0)).max(axis=0) / plan.period_s
    return peak
