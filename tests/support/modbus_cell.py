"""A small Modbus cell and a plant without physics, for the tests of PLCs and their driver."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from docking.config.cell import CellFile
from docking.types import Array, Correction, Plan

START_MM = np.array([10.0, -5.0, 2.0, 20.0, 3.0, -1.0, 30.0, 4.0, 1.5, 40.0, -2.0, 0.5])
VELOCITY_MM_S = np.array([5.0, -1.0, 0.5, 4.8, -1.2, 0.7, 5.1, -0.9, 0.2, 4.9, -1.1, 0.9])
PORT = 15020


def cell(passive: Sequence[str] = (), **bus: Any) -> CellFile:
    """A cell of four positioners A..D; `passive` names axes such as "B.X"; `bus` overrides Modbus settings."""

    def axis(positioner: str, name: str, direction: tuple[float, float, float]) -> dict[str, Any]:
        return {
            "name": name, "direction": direction, "driven": f"{positioner}.{name}" not in passive,
            "stroke_mm": (-400.0, 400.0), "v_mm_s": 10.0, "a_mm_s2": 10.0, "j_mm_s3": 50.0, "a_quick_mm_s2": 200.0,
        }  # fmt: skip

    positioners = tuple(
        {
            "name": p, "origin_mm": (float(x), float(y), 0.0), "stiffness_n_per_mm": (2e4, 2e4, 2e4),
            "rated_n": (1e4, 1e4, 5e4), "host": "127.0.0.1", "port": PORT + i, "unit": i + 1, "load_cell": p != "D",
            "axes": (axis(p, "X", (1.0, 0.0, 0.0)), axis(p, "Y", (0.0, 1.0, 0.0)), axis(p, "Z", (0.0, 0.0, 1.0))),
        }
        for i, (p, x, y) in enumerate((("A", 0, 0), ("B", 9000, 0), ("C", 9000, 4000), ("D", 0, 4000)))
    )  # fmt: skip
    ers = tuple({"name": f"E{i}", "xyz_mm": (float(i), 0.0, 0.0), "sigma_mm": 0.02} for i in range(4))
    return CellFile.model_validate(
        {
            "schema_version": 1,
            "name": "small",
            "tracker": {
                "protocol": "line", "port": "/dev/null", "device_class": "laser-tracker",
                "station_pose": (0.0,) * 6, "ers": ers,
            },
            "bus": {"kind": "modbus-tcp"} | bus,
            "positioners": positioners,
            "load_cells": {"range_n": (1e4, 1e4, 5e4)},
        }
    )  # fmt: skip


class StiffPlant:
    """Axes that stand exactly where the set-points are while powered and not braked. Jammed axes stand still."""

    def __init__(self) -> None:
        self.position_mm = START_MM.copy()
        self.error_mm = np.zeros(12)
        self.offset_mm = np.zeros(12)
        self.jammed = np.zeros(12, dtype=np.bool_)
        self.powered = np.zeros(12, dtype=np.bool_)
        self.braked = np.ones(12, dtype=np.bool_)
        self.history: list[tuple[float, Array]] = []

    def step(self, t_s: float, target_mm: Array, powered: Any, braked: Any) -> None:
        against = braked & powered & ~self.jammed & (np.abs(target_mm - self.position_mm) > 1e-4)
        assert not against.any(), "moved against the brakes"
        self.powered, self.braked = powered.copy(), braked.copy()
        free = powered & ~braked & ~self.jammed
        self.position_mm = np.where(free, target_mm, self.position_mm)
        self.error_mm = np.where(powered, target_mm - self.position_mm, 0.0)
        self.history.append((t_s, self.position_mm.copy()))

    def encoder_mm(self) -> Array:
        return np.round(self.position_mm + self.offset_mm, 4)

    def following_error_mm(self) -> Array:
        return self.error_mm

    def force_n(self) -> Array:
        return 1000.0 * np.arange(12.0) - 3000.0


def table(duration_s: float, period_s: float = 0.1) -> tuple[Array, Array]:
    """Times (n,) and axis positions (n, 12) of a curved move that starts and ends at rest."""
    t_s = np.arange(round(duration_s / period_s) + 1) * period_s
    x = t_s / duration_s
    s = x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
    q = START_MM + np.outer(s, VELOCITY_MM_S * duration_s / 2.0)
    q[:, 2::3] += np.outer(np.sin(2.0 * np.pi * s), np.array([0.5, 0.8, -0.4, 0.3]))
    return t_s, q


def plan(cell_file: CellFile, duration_s: float = 8.0, plan_id: int = 70001) -> Plan:
    """The table as a plan of the cell."""
    period_s = cell_file.bus.segment_s  # type: ignore[union-attr]
    t_s, q = table(duration_s, period_s)
    nowhere = Correction(np.zeros(3), np.zeros(3), np.zeros(3))
    return Plan(
        plan_id=plan_id, plan_hash="0" * 8, stage="S1", kind="approach", axes=cell_file.axis_names, period_s=period_s,
        t_s=t_s, s=t_s / t_s[-1], q_mm=q, correction=nowhere, chord_error_mm=0.0, rate_slew_per_s=2.0,
        speed_limited_by="stage",
    )  # fmt: skip


def chord_point(t_s: Array, q_mm: Array, at_s: float) -> Array:
    """Positions (m,) on the straight chords of the table at path time `at_s`."""
    return np.array([np.interp(at_s, t_s, column) for column in q_mm.T])


def path_time_of(t_s: Array, q_mm: Array, position_mm: Array) -> float:
    """Path time whose chord point is nearest to `position_mm` in the axes given (columns of `q_mm`)."""
    best = (np.inf, 0.0)
    for i in range(len(t_s) - 1):
        chord = q_mm[i + 1] - q_mm[i]
        length2 = float(chord @ chord)
        f = 0.0 if length2 == 0.0 else float(np.clip((position_mm - q_mm[i]) @ chord / length2, 0.0, 1.0))
        off = float(np.linalg.norm(position_mm - q_mm[i] - f * chord))
        best = min(best, (off, float(t_s[i] + f * (t_s[i + 1] - t_s[i]))))
    return best[1]
