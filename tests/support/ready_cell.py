"""A cell ready to move: real driver, motion and monitors on a virtual CAN bus, axes enabled, a plan loaded. No tracker.

A case costs about a quarter of a second: bring-up of twelve nodes, two seconds of motion, a few seconds of watching.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np

from docking import records
from docking.assemble.motion_side import local_motion
from docking.assemble.simulated import FarEnd, make_far_end, truth_of
from docking.assemble.wires import NearBus
from docking.config import CellFile, JobFile
from docking.config.build import positioners_from
from docking.config.load import load_cell, load_job
from docking.errors import DockingError
from docking.types import Array, MoveResult, Plan
from sim.canopen.faults import DriveFaults
from sim.canopen.group import DriveGroup
from sim.canopen.settings import DriveSettings
from sim.virtual_time import run_virtual
from sim.wires.virtual_can import VirtualCan
from tests.support.motion_record import Record, RecordedPlant
from tests.support.planned_moves import CELLS, Site, a_plan, lab_site

QUIET_S = 1.0
"""How long the cell is watched after a move has ended."""
CYCLE_S = 0.01


@cache
def production_files(name: str) -> tuple[CellFile, JobFile]:
    """A reference cell with a production cell's limits (a CPU of its own, two missing read-backs), inputs unwired."""
    cell = load_cell(CELLS / f"{name}.toml")
    limits = cell.limits.model_copy(update={"missing_cycles": 2, "tick_late_cycles": 2})
    cell = cell.model_copy(update={"limits": limits, "inputs": None})
    return cell, load_job(CELLS / f"{name}.job.toml", cell)


@dataclass
class Scene:
    """How one case is set up: cell, seed of plant and plan, how the drives behave, the size of the move.

    `cell_changes` alters the cell file, `before` is called before bring-up; `enabled`: enable the axes and load a plan.
    `errors_off` are true errors of the simulated cell that this case does without.
    """

    name: str = "lab-can"
    seed: int = 1
    drives: DriveSettings = field(default_factory=lambda: DriveSettings(sync_loss="quick-stop"))
    shift_mm: float = 6.0
    turn_deg: float = 0.2
    speed_mm_s: float = 4.0
    cell_changes: Callable[[CellFile], CellFile] | None = None
    before: Callable[[ReadyCell], None] | None = None
    enabled: bool = True
    errors_off: tuple[str, ...] = ()


class ReadyCell:
    """Make it on the loop that runs it, then `open`, `ready`, `move`."""

    def __init__(self, scene: Scene) -> None:
        self.loop, self.scene = asyncio.get_running_loop(), scene
        cell, self.job = production_files(scene.name)
        self.cell = scene.cell_changes(cell) if scene.cell_changes else cell
        truth = truth_of(CELLS / f"{scene.name}.toml")
        truth = truth.model_copy(update={"errors": {**truth.errors, **dict.fromkeys(scene.errors_off, 0.0)}})
        self.positioners = positioners_from(self.cell, self.job)
        self.far: FarEnd = make_far_end(self.cell, self.job, truth, scene.seed)
        self.plant = self.far.plant
        self.recorded = RecordedPlant(self.plant)
        self.bus = VirtualCan(self.loop, self.cell.bus.bitrate)  # type: ignore[union-attr]
        self.record = Record(self.cell, self.recorded)
        self.journal: list[tuple[float, str, dict[str, Any]]] = []
        self.defects: list[dict[str, Any]] = []
        self.plan: Plan
        self.start_s = self.fault_s = float("nan")
        self.result: MoveResult | None = None
        self.refused: DockingError | None = None
        self.again_refused = False

    async def open(self) -> None:
        """Join drives and controller; nothing is sent yet."""
        self.loop.set_exception_handler(lambda loop, context: self.defects.append(context))
        far = self.bus.end()
        await far.open()
        self.group = DriveGroup(self.recorded, self.cell, self.scene.drives, far, self.loop)
        self.group.start()
        self.near = self.bus.end()
        send = self.near.send

        def tapped(frames: list[tuple[int, bytes]]) -> None:
            self.record.hear(self.loop.time(), frames)
            send(frames)

        self.near.send = tapped  # type: ignore[method-assign]
        self.motion: Any = local_motion(self.cell, self.job, NearBus(self.near))

    @property
    def faults(self) -> DriveFaults:
        return self.group.faults

    def index(self, axis: str) -> int:
        return self.cell.axis_names.index(axis)

    async def ready(self) -> None:
        """Bring up, enable, plan from where the axes stand, load; only bring up where the scene says so."""
        if self.scene.before is not None:
            self.scene.before(self)
        await self.motion.connect()
        if not self.scene.enabled:
            return
        standing = await self.motion.enable()
        self.plan = self.plan_from(standing)
        await self.motion.load(self.plan)

    def plan_from(self, standing_mm: Array) -> Plan:
        """The scene's move: a direction and a turn of the seed, always the same size."""
        scene, rng = self.scene, np.random.default_rng(self.scene.seed)
        site: Site = replace(
            lab_site(scene.name), reach_mm=scene.shift_mm, turn_deg=scene.turn_deg, speed_mm_s=scene.speed_mm_s
        )
        return a_plan(site, int(rng.integers(1000)), start_mm=standing_mm)

    _fault: tuple[float, Callable[..., Any], tuple[Any, ...]] | None = None

    def during(self, share: float, fault: Callable[..., Any], *args: Any) -> None:
        """Let a fault happen after this share of the move's time; before `move`."""
        self._fault = share, fault, args

    async def move(self) -> None:
        """Write the intent, start, wait for the end, watch for a while, and try to start again in between."""
        self.write("intent", records.intent_record(self.plan))
        self.start_s = self.loop.time()
        if self._fault is not None:
            share, fault, args = self._fault
            self.fault_s = self.start_s + round(share * self.plan.duration_s / CYCLE_S) * CYCLE_S + 0.5 * CYCLE_S
            self.recorded.weigh_from_s = self.fault_s - CYCLE_S
            self.recorded.weigh_until_s = self.fault_s + 0.3
            self.loop.call_at(self.fault_s, fault, *args)
        try:
            self.result = await self.motion.start(self.plan.plan_hash)
        except DockingError as error:
            self.refused = error
        self.ended_s = self.loop.time()
        await asyncio.sleep(0.5 * QUIET_S)
        try:
            await self.motion.load(self.plan)
            await self.motion.start(self.plan.plan_hash)
        except DockingError:
            self.again_refused = True
        await asyncio.sleep(0.5 * QUIET_S)

    def write(self, kind: str, body: dict[str, Any]) -> None:
        self.journal.append((self.loop.time(), kind, body))

    async def close(self) -> None:
        """Close both ends; a controller that cannot close the axes says so."""
        self.record_until_s = self.loop.time()
        try:
            await self.motion.close()
        except DockingError as error:
            self.refused = self.refused or error
        await asyncio.sleep(0.3)
        self.group.close()

    @property
    def cause(self) -> BaseException | None:
        """What ended the move."""
        return self.result.cause if self.result is not None else self.refused


def play(scene: Scene, story: Callable[[ReadyCell], Awaitable[None] | None]) -> ReadyCell:
    """Set up, let `story` set its traps (or play itself), move, watch, close. Defects inside are raised here."""

    async def main() -> ReadyCell:
        cell = ReadyCell(scene)
        await cell.open()
        await cell.ready()
        told = story(cell)
        if told is not None:
            await told
        else:
            await cell.move()
        await cell.close()
        assert not cell.defects, cell.defects
        left = asyncio.all_tasks() - {asyncio.current_task()}
        assert not left, f"left running: {left}"
        return cell

    return run_virtual(main)
