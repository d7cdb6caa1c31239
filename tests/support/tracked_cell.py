"""The reference cell whose part is followed in every move, in virtual time: what the live pose said, and the truth."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from docking.assemble.controller import Company, build_cell
from docking.assemble.scenarios import WatchedJournal
from docking.assemble.streams import virtual_streams
from docking.cell import Cell
from docking.live import WatchedMotion
from docking.types import Array, Pose
from sim.fault_book import FaultBook
from sim.scenario import EventModel, ScenarioFile, ScenarioRunner
from sim.virtual_time import run_virtual
from tests.support.dry_cell import CELLS, DryCell

LOOK_S = 0.05


class TrackedCell(DryCell):
    """One docking of lab-can-tracked; `live` overrides keys of `[live]`, its key `stereo` puts a camera pair in the
    place of the camera; `events` happen as in a scenario file.

    `seen`: a row every 50 ms in a move: move, loop time, blind time (s), change since rest of the largest error of a
    point (mm, against the plant), predicted sd (mm).
    """

    def __init__(self, seed: int, journal: Path, events: list[dict[str, Any]], live: dict[str, Any]) -> None:
        super().__init__("lab-can-tracked", seed, journal)
        assert self.cell.live is not None
        stereo = live.pop("stereo", None)
        changed: dict[str, Any] = {"live": self.cell.live.model_copy(update=live)}
        if stereo is not None:
            changed |= {"camera": None, "stereo": stereo}
        self.cell = self.cell.model_copy(update=changed)
        self.events = [EventModel.model_validate(event) for event in events]
        self.seen: list[tuple[int, float, float, float, float]] = []

    def join(self) -> Cell:
        watched = WatchedJournal(self.journal, self.far)
        streams = virtual_streams(self.cell, self.job, CELLS, self.far)
        wires = replace(self.wires, streams=streams)
        controller = build_cell(self.cell, self.job, wires, Company(watched, self.operator, self.loop.time))
        if self.events:
            book = FaultBook(self.cell, self.far.plant, self.far.world, self.far.devices)
            scenario = ScenarioFile(schema_version=1, name="test", event=tuple(self.events))
            watched.watch(controller, ScenarioRunner(scenario, book, self.loop, lambda what, event: None))
        return controller

    async def dock(self) -> None:
        looking = self.loop.create_task(self._look())
        try:
            await super().dock()
        finally:
            looking.cancel()
            await asyncio.gather(looking, return_exceptions=True)

    async def _look(self) -> None:
        motion = self.controller.procedure.motion
        assert isinstance(motion, WatchedMotion)
        truth: list[tuple[float, Pose]] = []
        rest: tuple[int, Array] | None = None
        while True:
            await asyncio.sleep(LOOK_S)
            truth.append((self.loop.time(), self.far.plant.component_pose_W()))
            live = motion.live
            state = live.state() if live is not None else None
            if live is None or state is None:
                continue
            # The newest instant that the live pose knows is up to one read-back old.
            before, after = truth[-2], truth[-1]
            share = (state.t_s - before[0]) / (after[0] - before[0])
            places = [X.apply(live._body.points_B_mm) for _, X in (before, after)]
            error = state.points_W_mm - (places[0] + share * (places[1] - places[0]))
            move = len(self.plans)
            if rest is None or rest[0] != move:
                rest = (move, error)
            off = float(np.linalg.norm(error - rest[1], axis=1).max())
            self.seen.append((move, state.t_s, state.blind_s, off, state.predicted_sd_mm))


def run_tracked(seed: int, folder: Path, events: list[dict[str, Any]], **live: Any) -> TrackedCell:
    """Dock once. Whatever went wrong inside is raised here."""

    async def main() -> TrackedCell:
        run = TrackedCell(seed, folder / f"tracked-{seed}.jsonl", events, live)
        await run.build()
        await run.dock()
        assert not run.defects, run.defects
        left = asyncio.all_tasks() - {asyncio.current_task()}
        assert not left, f"left running: {left}"
        return run

    return run_virtual(main)
