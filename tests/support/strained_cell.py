"""A part that a stop left strained, a supervisor who asks for steps, and the truth beside what the cell believes."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from docking.assemble.controller import Company, Wires
from docking.assemble.motion_side import local_motion, motion_beside
from docking.assemble.relieving import build_relief
from docking.assemble.runs import Files
from docking.assemble.simulated import FarEnd, make_far_end, truth_of
from docking.config import CellFile, JobFile
from docking.config.build import positioners_from
from docking.config.cell import CanBus
from docking.motion.settle import SettleSettings
from docking.motion.weighing import weigh
from docking.operators import AutomaticOperator
from docking.planning.relief import Tare
from docking.state import State
from docking.types import Array
from sim.truth import TruthFile
from sim.virtual_time import run_virtual
from sim.wires.virtual_can import VirtualCan
from sim.wires.virtual_serial import VirtualSerial
from tests.support.dry_cell import CELLS, Tap, files

SAMPLE_S = 0.1


class Supervisor(AutomaticOperator):
    """Asks for `steps` steps, then lets go; `each` is called before every answer."""

    def __init__(self, say: Callable[[str], None], steps: int, each: Callable[[int], None]) -> None:
        super().__init__(say)
        self.steps, self.asked, self._each = steps, 0, each

    async def hold_to_run(self, facts: dict[str, Any]) -> bool:
        self._each(self.asked)
        self.asked += 1
        return self.asked <= self.steps


@dataclass
class Strained:
    """How the part is left: axes and how far they stand off (mm). `tared`: weighed before. `before` is called before
    the relief, `each` before every answer of the supervisor, `while_moving` early in every step."""

    name: str
    seed: int
    offsets_mm: dict[str, float]
    tared: bool = True
    steps: int = 100
    truth: Callable[[TruthFile], TruthFile] = lambda truth: truth
    before: Callable[[ReliefCase], None] = lambda case: None
    each: Callable[[ReliefCase], None] = lambda case: None
    while_moving: Callable[[ReliefCase], None] | None = None


@dataclass
class ReliefCase:
    """What came of it. Forces are true ones: `ball_n` (n, k) sampled through the run, `step_starts` the rows at which
    the steps began."""

    strained: Strained
    cell: CellFile
    job: JobFile
    far: FarEnd
    wires: Callable[[], Wires]
    state: State = State.OFFLINE
    said: list[str] = field(default_factory=list)
    records: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    ball_n: list[Array] = field(default_factory=list)
    internal_n: list[float] = field(default_factory=list)
    position_mm: list[Array] = field(default_factory=list)
    step_starts: list[int] = field(default_factory=list)
    controller: Any = None

    def bodies(self, kind: str) -> list[dict[str, Any]]:
        return [body for of, body in self.records if of == kind]

    def alarms(self) -> list[tuple[int, str]]:
        return [(a["code"], a["where"]) for a in self.bodies("alarm")]

    def worst_rise(self) -> float:
        """Largest rise of any ball's true force over what it was as its step began, as a fraction of it."""
        ends = [*self.step_starts[1:], len(self.ball_n)] if self.step_starts else []
        rises = [
            (np.max(self.ball_n[a:b], axis=0) / self.ball_n[a] - 1.0).max()
            for a, b in zip(self.step_starts, ends, strict=True)
        ]
        return float(max(rises, default=0.0))

    async def tare(self) -> Tare:
        """Weigh the part as it was taken, and switch off."""
        wires, settle = self.wires(), self.cell.settle
        motion = motion_beside(self.cell, local_motion(self.cell, self.job, wires))
        await motion.connect()
        await motion.enable()
        settings = SettleSettings(settle.window_s, settle.readings, settle.tolerance_mm, settle.timeout_s)
        weighing = await weigh(motion, settings)
        await motion.close()
        return Tare(weighing, 0.1)

    def sample(self) -> None:
        plant = self.far.plant
        to_balls = plant._equilibrium.ball_forces_n
        self.ball_n.append(np.linalg.norm(to_balls(plant.true_axis_forces_n()), axis=1))
        self.internal_n.append(plant.true_internal_force_n())
        self.position_mm.append(np.array(plant.encoder_mm()))

    async def watch(self) -> None:
        while True:
            self.sample()
            await asyncio.sleep(SAMPLE_S)

    def heard(self, kind: str, body: dict[str, Any]) -> None:
        self.records.append((kind, body))
        if kind == "intent":
            self.step_starts.append(len(self.ball_n))
            self.sample()
            if self.strained.while_moving is not None:
                asyncio.get_running_loop().call_later(0.05, self.strained.while_moving, self)

    async def run(self, journal: Path) -> None:
        tare = await self.tare() if self.strained.tared else None
        for axis, by_mm in self.strained.offsets_mm.items():
            self.far.plant.displace(axis, by_mm)
        self.strained.before(self)
        wires, loop = self.wires(), asyncio.get_running_loop()
        tap = Tap(journal, loop.time)
        tap.hooks.append(self.heard)
        operator = Supervisor(self.said.append, self.strained.steps, lambda number: self.strained.each(self))
        motion = motion_beside(self.cell, local_motion(self.cell, self.job, wires))
        company = Company(tap, operator, loop.time)
        self.controller = build_relief(Files(self.cell, self.job, journal), motion, company, "A. Smith", tare)
        watching = asyncio.ensure_future(self.watch())
        self.state = await self.controller.relieve()
        watching.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await watching
        self.sample()
        tap.close()


async def _wired(cell: CellFile, far: FarEnd) -> Callable[[], Wires]:
    """The far end on its wires; gives a fresh near end whenever it is called."""
    serial = VirtualSerial(far.loop, cell.tracker.baud)
    if isinstance(cell.bus, CanBus):
        bus = VirtualCan(far.loop, cell.bus.bitrate)
        end = bus.end()
        await end.open()
        far.drives(cell, end)
        return lambda: Wires(serial=serial.near, can=bus.end())
    addresses = await far.plcs(cell, None)
    return lambda: Wires(serial=serial.near, modbus=addresses)


def relieved(strained: Strained, journal: Path) -> ReliefCase:
    """Leave the part strained, run the relief to its end, close everything."""

    async def main() -> ReliefCase:
        cell, job = files(strained.name)
        truth = strained.truth(truth_of(CELLS / f"{strained.name}.toml"))
        far = make_far_end(cell, job, truth, strained.seed)
        case = ReliefCase(strained, cell, job, far, await _wired(cell, far))
        await case.run(journal)
        await far.close()
        return case

    return run_virtual(main)


def warp_mm(name: str, axis: str, force_n: float) -> dict[str, float]:
    """How far one vertical axis has to stand off for this warp at every ball: a quarter of it shows at each."""
    cell, job = files(name)
    positioners = positioners_from(cell, job)
    k = positioners.axes.index(axis)
    return {axis: 4.0 * force_n / float(positioners.stiffness_n_per_mm.reshape(-1)[k])}
