"""Pose of the component <-> ball centres <-> axis displacements; consistency and forces. docs/mechanics.md."""

from docking.kinematics.forces import (
    Load,
    Reactions,
    axis_forces_n,
    ball_reactions_n,
    consistency_projector,
    internal_force_matrix,
    internal_forces_n,
    reaction_extremes,
    sink_mm,
    warp_rows,
)
from docking.kinematics.forward import figure_residual_mm, pose_from_axes
from docking.kinematics.monitor import Coupling, CouplingMonitor, coupling_monitor, pose_step_matrix
from docking.kinematics.positioners import (
    Conditioning,
    Positioners,
    RankSettings,
    axis_displacements,
    axis_jacobian,
    axis_positions,
    ball_jacobian,
    conditioning,
    socket_positions,
)

__all__ = [
    "Conditioning",
    "Coupling",
    "CouplingMonitor",
    "Load",
    "Positioners",
    "RankSettings",
    "Reactions",
    "axis_displacements",
    "axis_forces_n",
    "axis_jacobian",
    "axis_positions",
    "ball_jacobian",
    "ball_reactions_n",
    "conditioning",
    "consistency_projector",
    "coupling_monitor",
    "figure_residual_mm",
    "internal_force_matrix",
    "internal_forces_n",
    "pose_from_axes",
    "pose_step_matrix",
    "reaction_extremes",
    "sink_mm",
    "socket_positions",
    "warp_rows",
]
