"""Plans of two geometries for the tests of motion: RC-1 with crooked axes, and the laboratory cell from its files."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from docking.config.build import plan_settings, positioners_from
from docking.config.load import load_cell, load_job
from docking.kinematics import Positioners
from docking.planning import PlanRequest, PlanSettings, make_plan
from docking.types import Array, Correction, Plan
from tests.reference_geometry import FACE, SETTINGS, crooked_axes, rc1

CELLS = Path(__file__).parents[2] / "sim" / "cells"


@dataclass(frozen=True, eq=False)
class Site:
    """Positioners with the settings to plan on them; positions the axes start from (m,), and where the face is."""

    positioners: Positioners
    settings: PlanSettings
    start_mm: Array
    pivot_mm: Array
    speed_mm_s: float
    reach_mm: float
    turn_deg: float


@cache
def rc1_site() -> Site:
    start = np.random.default_rng(7).uniform(-10.0, 10.0, 3)
    return Site(rc1(crooked_axes(3)), SETTINGS, np.tile(start, 4), FACE, 5.0, 15.0, 0.2)


@cache
def lab_site(name: str = "lab-can") -> Site:
    cell = load_cell(CELLS / f"{name}.toml")
    job = load_job(CELLS / f"{name}.job.toml", cell)
    pivot = np.array(job.mate.pose[:3])
    return Site(positioners_from(cell, job), plan_settings(cell, job), np.zeros(12), pivot, 4.0, 8.0, 0.5)


def a_plan(
    site: Site, seed: int, *, period_s: float = 0.01, queued: bool = False, start_mm: Array | None = None
) -> Plan:
    """A plan in a random direction, turning about a random axis."""
    rng = np.random.default_rng(seed)
    turn = np.radians(site.turn_deg) * rng.uniform(-1.0, 1.0, 3)
    shift = site.reach_mm * rng.uniform(-1.0, 1.0, 3)
    request = PlanRequest(
        plan_id=seed + 1,
        stage="align",
        kind="align",
        q_now_mm=site.start_mm if start_mm is None else start_mm,
        correction=Correction(site.pivot_mm, turn, shift),
        speed_mm_s=site.speed_mm_s,
        period_s=period_s,
        linear_interpolation=queued,
    )
    return make_plan(request, site.positioners, site.settings)


def a_shift(
    site: Site, shift_mm: Array, speed_mm_s: float, start_mm: Array, *, period_s: float = 0.01, queued: bool = False
) -> Plan:
    """A plan straight along `shift_mm` (3,) without any turn."""
    correction = Correction(site.pivot_mm, np.zeros(3), np.asarray(shift_mm, dtype=np.float64))
    request = PlanRequest(1, "align", "align", start_mm, correction, speed_mm_s, period_s, queued)
    return make_plan(request, site.positioners, site.settings)
