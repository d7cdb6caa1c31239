"""The invariants of tests/faults/README.md, judged over every tick of a case, and what the case measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from docking.config.build import gravity_m_s2
from docking.types import Array
from tests.support.motion_record import AS_SENT_MM, ENABLED, MOVES_MM, QUICK_STOP, Sent, along
from tests.support.ready_cell import CYCLE_S, ReadyCell

QUICK_STOP_BESIDE_MM = 0.005
"""Largest distance of the healthy axes from their path during a synchronous quick stop. I3 permits 0.02 mm;
drives that all ramped with one deceleration would leave these paths by 0.007 mm (lab) and more.
"""
COUNT_MM_S2 = 2.0
"""What rounding to counts of 0.1 um leaves in a second difference over 10 ms."""
HELD_MM = 0.002


@dataclass(frozen=True)
class Outcome:
    """What a case measured; times in s after the fault, NaN where it did not happen.

    `reaction`: none (the plan ran to its end), path (slowed on the path), quick-stop, silence. `reacted_s` first
    changed command, `standstill_s` last motion of a healthy axis. Worst `residual_mm` of the true motor positions, rise
    of the true internal force `force_n` until 0.3 s after the fault, worst residual of the commands sent `streamed_mm`,
    worst distance from the path in a quick stop `beside_mm`, `drift_mm` of the healthy axes afterwards.
    """

    reaction: str
    reacted_s: float
    standstill_s: float
    residual_mm: float
    force_n: float
    streamed_mm: float
    beside_mm: float
    drift_mm: float


def judge(cell: ReadyCell, broken: str | None = None) -> Outcome:
    """Assert I1 to I7 for a move with a fault of axis `broken`; return what was measured."""
    healthy = np.array([axis != broken for axis in cell.cell.axis_names])
    assert cell.cause is None or cell.again_refused, "after a fault the same move could be started again"
    sent = cell.record.sent()
    stopped_s = _quick_stop_s(cell, sent)
    streamed_mm = _assert_streamed(cell, sent, stopped_s)
    _assert_torque(cell, healthy)
    standstill_s, drift_mm = _assert_rest(cell, healthy)
    reaction, reacted_s = _reaction(cell, sent, stopped_s)
    return Outcome(
        reaction=reaction,
        reacted_s=reacted_s,
        standstill_s=standstill_s,
        residual_mm=_residual_mm(cell),
        force_n=_force_rise_n(cell),
        streamed_mm=streamed_mm,
        beside_mm=_assert_quick_stop(cell, healthy, stopped_s),
        drift_mm=drift_mm,
    )


def _quick_stop_s(cell: ReadyCell, sent: Sent) -> float:
    """When the controller first told a drive to stop by itself; infinite when it did not."""
    told = (sent.t_s >= cell.start_s) & (sent.word == QUICK_STOP).any(axis=1)
    return float(sent.t_s[np.argmax(told)]) if told.any() else float("inf")


def _assert_streamed(cell: ReadyCell, sent: Sent, stopped_s: float) -> float:
    """I1, I2, I3, I6: nothing moves before the intent; then the path of its plan, rigid, inside every axis' limits."""
    enabled = (sent.word == ENABLED).all(axis=1)
    before = sent.target_mm[enabled & (sent.t_s < cell.start_s)]
    intents = [(t_s, body) for t_s, kind, body in cell.journal if kind == "intent"]
    assert intents
    assert intents[0][0] <= cell.start_s
    assert intents[0][1]["plan_hash"] == cell.plan.plan_hash
    if len(before):
        assert (before == before[0]).all()
    rows = enabled & (sent.t_s >= cell.start_s) & (sent.t_s < min(stopped_s, cell.ended_s + 0.5 * CYCLE_S))
    path = sent.target_mm[rows]
    driven = np.array(cell.cell.driven)
    _, beside = along(cell.plan, _whole(cell, path, driven), driven)
    assert beside.max(initial=0.0) <= AS_SENT_MM
    _assert_limits(cell, np.vstack((before[-2:], path)), sent.t_s[rows], driven)
    gap = cell.record.figure_gap_mm(_whole(cell, path, driven), cell.plan.q_mm[0]) if driven.all() else np.zeros(1)
    assert gap.max(initial=0.0) <= AS_SENT_MM
    return float(gap.max(initial=0.0))


def _whole(cell: ReadyCell, driven_mm: Array, driven: NDArray[np.bool_]) -> Array:
    """Rows of driven axes (n, d) among all axes (n, m)."""
    rows = np.zeros((len(driven_mm), len(driven)))
    rows[:, driven] = driven_mm
    return rows


def _assert_limits(cell: ReadyCell, target_mm: Array, t_s: Array, driven: NDArray[np.bool_]) -> None:
    """I6 by finite differences of the commands: planned limits until the fault, the quick-stop deceleration after."""
    axes = cell.positioners
    speed = np.diff(target_mm, axis=0) / CYCLE_S
    assert (np.abs(speed) <= axes.v_mm_s[driven] + 0.02).all()
    hard = np.abs(np.diff(speed, axis=0)) / CYCLE_S
    late = (
        np.concatenate((np.zeros(len(hard) - len(t_s)), t_s)) > cell.fault_s
        if len(hard) > len(t_s)
        else (t_s[len(t_s) - len(hard) :] > cell.fault_s)
    )
    limit = np.where(late[:, None], axes.a_quick_mm_s2[driven], axes.a_mm_s2[driven]) + COUNT_MM_S2
    assert (hard <= limit).all(), float((hard / limit).max())


def _assert_torque(cell: ReadyCell, healthy: NDArray[np.bool_]) -> None:
    """I5: torque never leaves a loaded axis whose brake is open; a broken axis may lose it by itself."""
    down = gravity_m_s2(cell.cell) / 9.80665
    rows = np.concatenate([np.linalg.inv(columns) for columns in cell.positioners.axes_W])
    loaded = healthy & (np.abs(rows @ down) > 0.5)
    powered = np.array([tick.powered for tick in cell.recorded.ticks])
    braked = np.array([tick.braked for tick in cell.recorded.ticks])
    dropped = powered[:-1] & ~powered[1:] & ~braked[1:] & loaded
    assert not dropped.any(), np.array(cell.cell.axis_names)[dropped.any(axis=0)]


def _assert_rest(cell: ReadyCell, healthy: NDArray[np.bool_]) -> tuple[float, float]:
    """I4, I7: healthy axes come to rest and stay there until the cell is closed; (time after the fault, drift)."""
    t_s, motor = cell.record.motors(cell.start_s)
    shown = t_s <= cell.record_until_s
    t_s, motor = t_s[shown], motor[shown][:, healthy]
    moving = np.abs(np.diff(motor, axis=0)).max(axis=1) > MOVES_MM
    last = int(np.flatnonzero(moving)[-1]) + 1 if moving.any() else 0
    drift = float(np.abs(motor[last:] - motor[-1]).max())
    assert t_s[last] < cell.record_until_s - 0.5, "still moving at the end"
    assert drift <= HELD_MM
    return float(t_s[last] - cell.fault_s), drift


def _reaction(cell: ReadyCell, sent: Sent, stopped_s: float) -> tuple[str, float]:
    """The first thing that the commands do differently from the plan at full rate."""
    # What was sent at the very instant of the start was sent before it.
    rows = np.flatnonzero((sent.t_s > cell.start_s) & (sent.t_s < cell.ended_s + 0.5 * CYCLE_S))
    first_s = float(sent.t_s[rows[0]])
    due = np.clip(np.rint((sent.t_s[rows] - first_s) / CYCLE_S).astype(int) + 1, 0, len(cell.plan.q_mm) - 1)
    asked = cell.plan.q_mm[due][:, np.array(cell.cell.driven)]
    other = np.abs(sent.target_mm[rows] - asked).max(axis=1) > 0.6e-4
    slowed_s = float(sent.t_s[rows[np.argmax(other)]]) if other.any() else float("inf")
    last_s = float(sent.t_s[-1])
    if last_s < cell.record_until_s - 0.5:
        return ("silence" if not stopped_s <= last_s else "quick-stop"), (
            min(slowed_s, stopped_s, last_s + CYCLE_S) - cell.fault_s
        )
    if not min(slowed_s, stopped_s) < float("inf"):
        return "none", float("nan")
    return ("quick-stop" if stopped_s < float("inf") else "path"), min(slowed_s, stopped_s) - cell.fault_s


def _assert_quick_stop(cell: ReadyCell, healthy: NDArray[np.bool_], stopped_s: float) -> float:
    """I3 in a quick stop: the set-points inside the healthy drives stay by the path until standstill."""
    if not stopped_s < float("inf"):
        return float("nan")
    t_s, target = cell.record.set_points(stopped_s)
    ramp = t_s <= stopped_s + 0.3
    _, beside = along(cell.plan, target[ramp], healthy & np.array(cell.cell.driven))
    worst = float(beside.max(initial=0.0))
    assert worst <= QUICK_STOP_BESIDE_MM
    return worst


def _residual_mm(cell: ReadyCell) -> float:
    """Worst rigid residual of the true motor positions during the move."""
    t_s, motor = cell.record.motors(cell.start_s)
    gap = cell.record.figure_gap_mm(motor[t_s <= cell.record_until_s], motor[0])
    return float(gap.max())


def _force_rise_n(cell: ReadyCell) -> float:
    """Rise of the true internal force after the fault."""
    forces = [force for _, force in cell.recorded.force_n_at]
    return max(forces) - forces[0] if forces else float("nan")
