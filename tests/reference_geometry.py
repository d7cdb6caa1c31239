"""RC-1 and RC-3 as docs/mechanics.md describes them, built from its numbers, not from the cell files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from docking.kinematics import Load, Positioners
from docking.planning import JamSettings, PlanSettings

NAMES = ("A", "B", "C", "D")
AXES = tuple(f"{name}.{axis}" for name in NAMES for axis in "XYZ")
BALLS = np.array([[-3000, -1800, -1200], [3000, -1800, -1200], [3000, 1800, -1200], [-3000, 1800, -1200]], dtype=float)
FACE = np.array([4000.0, 0.0, 0.0])
LOAD = Load(6000.0, 0.0, np.array([600.0, 200.0, 0.0]), np.zeros(3), np.array([0.0, 0.0, -9.80665]))
GUARDED = PlanSettings(load=LOAD)
SETTINGS = replace(GUARDED, jam=JamSettings(residual_mm=1e9, force_n=1e12, warp_n=1e12))
"""The limits of the axes and the stage alone; GUARDED bounds what a jammed axis may do as well."""


def rc1(axes_W: np.ndarray | None = None, driven: np.ndarray | None = None) -> Positioners:
    """Four positioners under the section; with all axes at 0 the component frame is W."""
    per_axis = np.ones(12)
    return Positioners(
        names=NAMES,
        axes=AXES,
        origins_W_mm=BALLS,
        axes_W=np.tile(np.eye(3), (4, 1, 1)) if axes_W is None else axes_W,
        driven=np.ones(12, dtype=bool) if driven is None else driven,
        stroke_mm=np.tile([[-450.0, 150.0], [-75.0, 75.0], [-200.0, 200.0]], (4, 1)),
        v_mm_s=10.0 * per_axis,
        a_mm_s2=10.0 * per_axis,
        j_mm_s3=50.0 * per_axis,
        a_quick_mm_s2=200.0 * per_axis,
        stiffness_n_per_mm=np.full((4, 3), 20000.0),
        rated_n=np.tile([10000.0, 10000.0, 50000.0], (4, 1)),
        swivel_rad=np.full(4, np.radians(15.0)),
        balls_C_mm=BALLS,
        neutral_R_WC=np.eye(3),
    )


def rc3(*, d_z_driven: bool = True) -> Positioners:
    """The 3-2-1 follower cell: A.XYZ, B.YZ, C.Z and D.Z driven."""
    chosen = ["A.X", "A.Y", "A.Z", "B.Y", "B.Z", "C.Z", *(["D.Z"] if d_z_driven else [])]
    return rc1(driven=np.isin(AXES, chosen))


def crooked_axes(seed: int, base_deg: float = 0.5, skew_rad: float = 5e-4, scale: float = 1e-4) -> np.ndarray:
    """Axis matrices (4, 3, 3): rotated bases, axes not orthogonal, scales not one."""
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(np.radians(base_deg) * rng.uniform(-1, 1, (4, 3))).as_matrix()
    skewed = np.eye(3) + rng.uniform(-skew_rad, skew_rad, (4, 3, 3))
    result: np.ndarray = turns @ skewed * (1 + rng.uniform(-scale, scale, (4, 1, 3)))
    return result


def three_positioners() -> Positioners:
    """The first three positioners of RC-1 alone."""
    whole = rc1()
    by_ball = ("origins_W_mm", "axes_W", "stiffness_n_per_mm", "rated_n", "swivel_rad", "balls_C_mm")
    by_axis = ("axes", "driven", "stroke_mm", "v_mm_s", "a_mm_s2", "j_mm_s3", "a_quick_mm_s2")
    by_axis += ("held_n", "held_tolerance_n")
    parts = {name: getattr(whole, name)[:3] for name in by_ball} | {name: getattr(whole, name)[:9] for name in by_axis}
    return replace(whole, names=whole.names[:3], **parts)


def with_com(com_mm: list[float], tolerance_mm: float = 0.0) -> PlanSettings:
    """The settings with another centre of mass."""
    return replace(SETTINGS, load=replace(LOAD, com_C_mm=np.array(com_mm), com_tolerance_mm=np.full(3, tolerance_mm)))
