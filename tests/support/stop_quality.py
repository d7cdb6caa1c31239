"""Stops of the full-size cell from any instant of a move, and how straight they leave the part."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from functools import cache

import numpy as np

from docking.config.cell import CellFile
from docking.motion.playback import Playback
from docking.motion.stops import PlannedStop, planned_stop
from docking.planning import PlanRequest, make_plan
from docking.planning.path import rigid_path
from docking.planning.time_law import quintic
from docking.types import Array, Correction, Plan
from sim.virtual_time import run_virtual
from tests.support.can_bench import Bench, can_cell, exchange
from tests.support.planned_moves import Site, lab_site
from tests.support.rigid_figure import rigid_gap_mm, sockets_mm

CELL = "fuselage-can"
CYCLE_S = 0.01
MOVES = {
    "1 deg + 165 mm in 60 s": (np.array([0.4, 0.5, 0.77]), 1.0, np.array([-160.0, 30.0, 25.0]), 60.0),
    "3 deg pure rotation": (np.array([1.0, 0.0, 0.0]), 3.0, np.zeros(3), None),
    "pure insertion": (np.array([1.0, 0.0, 0.0]), 0.0, np.array([100.0, 0.0, 0.0]), None),
    "small correction": (np.array([0.3, -0.5, 0.8]), 0.05, np.array([0.6, -0.8, 0.4]), None),
}
"""Axis of rotation, degrees, shift in mm, duration where it is stated (else as fast as the axes may)."""


@cache
def site() -> Site:
    """The cell without what bounds the speed for a jam: straightness has to hold at the axes' own limits."""
    found = lab_site(CELL)
    jam = replace(found.settings.jam, residual_mm=1e6, force_n=1e12, warp_n=1e12)
    return replace(found, settings=replace(found.settings, jam=jam))


@cache
def move(name: str) -> Plan:
    """The plan of one of `MOVES`, on a grid of 10 ms; where a duration is stated, by the quintic law in that time."""
    axis, turn_deg, shift, duration_s = MOVES[name]
    here = site()
    turn = np.radians(turn_deg) * axis / np.linalg.norm(axis)
    request = PlanRequest(
        plan_id=1,
        stage="align",
        kind="align",
        q_now_mm=here.start_mm,
        correction=Correction(here.pivot_mm, turn, shift),
        speed_mm_s=12.0,
        period_s=CYCLE_S,
        linear_interpolation=False,
    )
    plan = make_plan(request, here.positioners, here.settings)
    if duration_s is None:
        return plan
    t_s = CYCLE_S * np.arange(round(duration_s / CYCLE_S) + 1)
    s = quintic(duration_s).at(t_s)
    q_mm = rigid_path(here.positioners, here.start_mm, request.correction).axes_mm(s)
    return replace(plan, t_s=t_s, s=s, q_mm=q_mm)


def stop_of(plan: Plan, a_quick_mm_s2: float | None = None) -> PlannedStop:
    """The stops that the product plans, for the cell's own quick-stop decelerations or for another one."""
    own = site().positioners.a_quick_mm_s2
    return planned_stop(plan, own if a_quick_mm_s2 is None else np.full_like(own, a_quick_mm_s2), CYCLE_S)


def cell_with(a_quick_mm_s2: float | None) -> CellFile:
    """The cell, its axes with another quick-stop deceleration where one is given."""
    cell = can_cell(CELL)
    if a_quick_mm_s2 is None:
        return cell
    change = {"a_quick_mm_s2": a_quick_mm_s2}
    return cell.model_copy(
        update={
            "positioners": tuple(
                p.model_copy(update={"axes": tuple(axis.model_copy(update=change) for axis in p.axes)})
                for p in cell.positioners
            )
        }
    )


def residual_mm(plan: Plan, q_mm: Array) -> float:
    """Largest distance of a ball from the rigid figure in the rows of `q_mm` (n, m)."""
    where = site().positioners.origins_W_mm, site().positioners.axes_W
    return float(rigid_gap_mm(sockets_mm(*where, plan.q_mm[0])[0], sockets_mm(*where, q_mm)).max())


def led_stop(plan: Plan, at_s: float, *, fast: bool) -> Array:
    """Commanded positions (n, m) of a stop on the path that begins at path time `at_s`."""
    playback = Playback(plan)
    playback.path_time_s = at_s
    if fast:
        playback.stop_straight(stop_of(plan).fast_slew_per_s)
    else:
        playback.hold()
    sent = [playback.advance(CYCLE_S)]
    while not playback.standing:
        sent.append(playback.advance(CYCLE_S))
    return np.array(sent)


def drives_stops(plan: Plan, rows: list[int], *, armed: bool, a_quick_mm_s2: float | None = None) -> list[Array]:
    """Motor positions (n, m) while twelve simulated drives quick-stop by themselves, one array a row of `rows`.

    `armed`: 6085h as the product sets it for this plan; otherwise the same deceleration in every drive.
    """

    async def main() -> list[Array]:
        bench = Bench(cell_with(a_quick_mm_s2))
        await bench.master.bring_up()
        stop = stop_of(plan, a_quick_mm_s2)
        if armed:
            await bench.master.arm_stops(stop.peak_mm_s, stop.t_stop_s)
        stopped = [await _stopped_at(bench, plan, row, stop.t_stop_s) for row in rows]
        bench.drives.close()
        return stopped

    result: list[Array] = run_virtual(main)
    return result


async def _stopped_at(bench: Bench, plan: Plan, row: int, t_stop_s: float) -> Array:
    """Put the axes a few rows before `row`, play up to it, quick-stop; then take the torque for the next time."""
    begin = max(0, row - 6)
    bench.plant.position = np.array(plan.q_mm[begin])
    await bench.master.enable()
    await _tick(bench, [plan.q_mm[k] for k in range(begin, row + 1)])
    count = len(bench.plant.calls)
    bench.master.quick_stop()
    await asyncio.sleep(CYCLE_S)
    await _tick(bench, [plan.q_mm[row]] * (int(t_stop_s / CYCLE_S) + 4))
    positions = np.array([position for _, position in bench.plant.calls[count:]])
    assert np.abs(positions[-1] - positions[-2]).max() == 0.0, "not at rest"
    braking = asyncio.get_running_loop().create_task(bench.master.brake())
    while not braking.done():
        await _tick(bench, [plan.q_mm[row]])
    await braking
    return positions


async def _tick(bench: Bench, rows: list[Array]) -> None:
    for q in rows:
        exchange(bench.master, q)
        await asyncio.sleep(CYCLE_S)
