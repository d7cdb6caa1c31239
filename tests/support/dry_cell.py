"""A whole cell in virtual time with its far end in reach: real controller, real drivers, real bytes, faults at will.

Everything that a test says about the set-points is read off the bus here, with its own `struct` code.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from docking.assemble.controller import Company, Wires, build_cell
from docking.assemble.simulated import FarEnd, make_far_end, truth_of
from docking.cell import Cell
from docking.config import CellFile, JobFile
from docking.config.build import positioners_from
from docking.config.cell import CanBus
from docking.config.load import load_cell, load_job
from docking.journal import JournalFile, read
from docking.operators import AutomaticOperator
from docking.state import State
from docking.types import Array, Plan
from sim.canopen.group import DriveGroup
from sim.plc.group import PlcGroup
from sim.virtual_time import run_virtual
from sim.wires.virtual_can import VirtualCan
from sim.wires.virtual_serial import VirtualSerial
from tests.support.rigid_figure import rigid_gap_mm, sockets_mm

CELLS = Path(__file__).parents[2] / "sim" / "cells"
SET_POINT = struct.Struct("<HiB")
COUNTS_PER_MM = 10_000.0
QUIET_S = 3.0
"""How long the cell is watched after its run has ended."""


@cache
def files(name: str, job: str | None = None) -> tuple[CellFile, JobFile]:
    cell = load_cell(CELLS / f"{name}.toml")
    return cell, load_job(CELLS / f"{job or name}.job.toml", cell)


class Tap:
    """The journal of a run; `hooks` hear every record when it has been written."""

    def __init__(self, path: Path, clock: Callable[[], float]) -> None:
        self._file = JournalFile(path, clock)
        self.hooks: list[Callable[[str, dict[str, Any]], None]] = []

    def write(self, kind: str, body: dict[str, Any]) -> None:
        self._file.write(kind, body)
        for hook in self.hooks:
            hook(kind, body)

    async def sync(self) -> None:
        await self._file.sync()

    def close(self) -> None:
        self._file.close()


class DryCell:
    """One docking of the reference cell `name`, with its own job or another by name; make it on the loop that runs it.
    `said` collects what is told."""

    def __init__(self, name: str, seed: int, journal: Path, job: str | None = None) -> None:
        self.loop = asyncio.get_running_loop()
        self.cell, self.job = files(name, job)
        self.positioners = positioners_from(self.cell, self.job)
        self.far: FarEnd = make_far_end(self.cell, self.job, truth_of(CELLS / f"{name}.toml"), seed)
        self.serial = VirtualSerial(self.loop, self.cell.tracker.baud)
        self.bus: VirtualCan | None = None
        self.journal_path = journal
        self.journal = Tap(journal, self.loop.time)
        self.said: list[str] = []
        self.operator = AutomaticOperator(self.said.append)
        self.sent: list[tuple[float, int, bytes]] = []
        self.pushed: list[tuple[float, str, tuple[float, float, float]]] = []
        self.plans: list[Plan] = []
        self.defects: list[dict[str, Any]] = []
        self.ended_at_s = float("nan")
        self.rest_mm: Array = np.zeros(0)
        self.drift_mm = float("nan")
        self.left_on: list[str] = []
        self.state = State.OFFLINE

    async def build(self) -> None:
        """Join the far end and the controller by wires."""
        self.loop.set_exception_handler(lambda loop, context: self.defects.append(context))
        self.far.tracker(self.cell, self.serial.far)
        if isinstance(self.cell.bus, CanBus):
            self.bus = VirtualCan(self.loop, self.cell.bus.bitrate)
            self.bus.keep = self._hear
            far_end = self.bus.end()
            await far_end.open()
            self.far.drives(self.cell, far_end)
            self.wires = Wires(serial=self.serial.near, can=self.bus.end())
        else:
            self.wires = Wires(serial=self.serial.near, modbus=await self.far.plcs(self.cell, None))
            for station, plc in zip(self.cell.positioners, self.plcs.plcs, strict=True):
                self._watch_queue(station.name, plc)
        self.controller: Cell = self.join()
        self.journal.hooks.append(self._keep_plan)

    def join(self) -> Cell:
        """The controller on its wires."""
        return build_cell(self.cell, self.job, self.wires, Company(self.journal, self.operator, self.loop.time))

    @property
    def tracker(self) -> Any:
        """The simulated instrument's device."""
        return self.far.devices[0]

    @property
    def drives(self) -> DriveGroup:
        return next(d for d in self.far.devices if isinstance(d, DriveGroup))

    @property
    def plcs(self) -> PlcGroup:
        return next(d for d in self.far.devices if isinstance(d, PlcGroup))

    @property
    def ramp_s(self) -> float:
        """How long a stop from full rate takes."""
        bus = self.cell.bus
        return 1.5 / self.plans[-1].rate_slew_per_s if isinstance(bus, CanBus) else bus.ramp_s

    def _hear(self, cob: int, data: bytes) -> bool:
        if 0x200 < cob < 0x280:
            self.sent.append((self.loop.time(), cob - 0x200, data))
        return True

    def _watch_queue(self, name: str, plc: Any) -> None:
        push = plc.queue.push

        def heard(knot: tuple[float, float, float], last: bool) -> None:
            self.pushed.append((self.loop.time(), name, knot))
            push(knot, last)

        plc.queue.push = heard

    def _keep_plan(self, kind: str, body: dict[str, Any]) -> None:
        if kind == "intent":
            plan = self.controller.procedure.progress.plan
            assert plan is not None
            self.plans.append(plan)

    def on_move(self, call: Callable[[Plan], None]) -> None:
        """Call back at every intent, when the plan is about to leave."""
        self.journal.hooks.append(lambda kind, body: call(self.plans[-1]) if kind == "intent" else None)

    async def dock(self) -> None:
        """Dock, then watch for a while whether anything still moves, then stop the far end."""
        self.state = await self.controller.dock()
        self.ended_at_s = self.loop.time()
        self.journal.close()
        await asyncio.sleep(0.5)
        self.left_on = self._left_on()
        self.rest_mm = self.far.plant.encoder_mm()
        await asyncio.sleep(QUIET_S)
        self.drift_mm = float(np.abs(self.far.plant.encoder_mm() - self.rest_mm).max())
        await self.far.close()

    def _left_on(self) -> list[str]:
        """What is still powered or open after the run."""
        left = ["serial line"] if self.serial.near._is_open else []
        if self.bus is not None:
            powered = self.drives.drives.powered
            return [*left, *(["bus"] if self.wires.can.is_open else []), *np.array(self.cell.axis_names)[powered]]
        names = [p.name for p in self.cell.positioners]
        left += [name for name, plc in zip(names, self.plcs.plcs, strict=True) if plc.powered]
        return left + [str(connection) for connection in self.plcs._connections]

    # what was seen ------------------------------------------------------------------------------------------------
    def all_records(self) -> list[dict[str, Any]]:
        return read(self.journal_path)

    def records(self, kind: str) -> list[dict[str, Any]]:
        return [r["body"] for r in self.all_records() if r["kind"] == kind]

    def alarms(self) -> list[tuple[int, str]]:
        """(code, where) of every alarm."""
        return [(a["code"], a["where"]) for a in self.records("alarm")]

    def states(self) -> list[str]:
        return [body["to"] for body in self.records("state")]

    def setpoints_mm(self) -> tuple[Array, Array]:
        """Times (n,) and set-points (n, m) of every SYNC, decoded from the frames; NaN for axes that get none."""
        nodes = [axis.node for p in self.cell.positioners for axis in p.axes]
        column = {node: k for k, node in enumerate(nodes)}
        driven = sum(self.cell.driven)
        rows = len(self.sent) // driven
        table = np.full((rows, len(nodes)), np.nan)
        times = np.empty(rows)
        for i in range(rows):
            batch = self.sent[i * driven : (i + 1) * driven]
            times[i] = batch[0][0]
            for _, node, data in batch:
                table[i, column[node]] = SET_POINT.unpack(data)[1] / COUNTS_PER_MM
        return times, table

    def figure_gap_mm(self, q_mm: Array, plan: Plan) -> Array:
        """How far the sockets at `q_mm` (n, m) are from the rigid figure that `plan` carries along (n,)."""
        where = self.positioners.origins_W_mm, self.positioners.axes_W
        return rigid_gap_mm(sockets_mm(*where, plan.q_mm[0])[0], sockets_mm(*where, q_mm))


def run_dry(name: str, seed: int, folder: Path, scenario: Callable[[DryCell], None], job: str | None = None) -> DryCell:
    """Dock once; `scenario` sets its traps before anything happens. Whatever went wrong inside is raised here."""

    async def main() -> DryCell:
        run = DryCell(name, seed, folder / f"{name}-{seed}.jsonl", job)
        await run.build()
        scenario(run)
        await run.dock()
        assert not run.defects, run.defects
        left = asyncio.all_tasks() - {asyncio.current_task()}
        assert not left, f"left running: {left}"
        return run

    return run_virtual(main)
