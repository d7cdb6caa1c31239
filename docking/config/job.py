"""The JOB file: one part to dock. Coordinates in the component frame C and the mate frame M, mm."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from docking.config.base import Finite, Model, Name, NonNegative, PoseVector, Positive, Vector3
from docking.config.instructions import Instruction
from docking.pose.goal import GoalKind, Lock


class Target(Model):
    """A reflector nest: nominal coordinates and their sigma (1 sigma a coordinate, as built).

    The reflector's centre stands `reflector_offset_mm` along `normal` from `xyz_mm`.
    """

    name: Name = Field(description="as the instrument knows it")
    xyz_mm: Vector3 = Field(description="nominal nest, mm")
    sigma_mm: Positive = Field(description="as built against nominal, 1 sigma a coordinate, mm")
    reflector_offset_mm: NonNegative = Field(default=0.0, description="from the nest to the reflector's centre, mm")
    normal: Vector3 = Field(default=(0.0, 0.0, 1.0), description="unit vector of that offset")


class Ball(Model):
    positioner: Name = Field(description="name in the cell file")
    xyz_mm: Vector3 = Field(description="ball centre in C, mm")


class Feature(Model):
    """A docking feature: a point of the component and the point of the mate it must meet."""

    name: Name = Field(description="of the docking feature")
    xyz_mm: Vector3 = Field(description="in C, mm")
    mate_xyz_mm: Vector3 = Field(description="where it must come to lie, in M, mm")
    sigma_mm: Positive = Field(description="of the feature to the component's targets, 1 sigma a coordinate, mm")
    mate_sigma_mm: Positive = Field(description="of its mate point to the mate's targets, 1 sigma a coordinate, mm")
    tolerance_mm: Positive = Field(description="largest distance of the two points, mm")
    measured: bool = Field(
        default=False,
        description="a reflector sits on both sides of the feature at the first station: it is measured there and must "
        "agree with the stated coordinates",
    )


Ring = Annotated[tuple[Vector3, ...], Field(min_length=3)]


class Box(Model):
    """A box with faces along the axes of its frame."""

    min_mm: Vector3 = Field(description="lower corner, mm")
    max_mm: Vector3 = Field(description="upper corner, mm")


class Component(Model):
    mass_kg: Positive = Field(description="kg")
    mass_tolerance_kg: NonNegative = Field(description="+-, kg")
    com_mm: Vector3 = Field(description="centre of mass in C, mm")
    com_tolerance_mm: Vector3 = Field(description="+- along each axis of C, mm")
    targets: tuple[Target, ...] = Field(min_length=3, description="measured and fitted; 7 or more, well spread")
    check_points: tuple[Target, ...] = Field(default=(), description="measured, never fitted")
    balls: tuple[Ball, ...] = Field(min_length=3, description="one for each positioner of the cell")
    features: tuple[Feature, ...] = Field(min_length=3, description="where component and mate must meet")
    outline_mm: tuple[Ring, ...] = Field(
        default=(), description="edges that could touch the mate: closed polylines in C, mm; none: not checked"
    )
    docking_face_mm: Vector3 = Field(description="pivot of corrections in C: centre of the docking face, mm")
    expansion_per_k: NonNegative = Field(description="linear thermal expansion, 1/K")
    temperature_c: Finite = Field(default=20.0, description="of the component, deg C")
    temperature_sigma_k: NonNegative = Field(default=0.3, description="of that temperature, 1 sigma, K")


class Mate(Model):
    pose: PoseVector = Field(description="approximate X_WM, mm and deg; refined from its targets")
    targets: tuple[Target, ...] = Field(min_length=4, description="measured and fitted")
    envelope: tuple[Box, ...] = Field(
        default=(), description="what the component must stay clear of on its way: boxes in M, mm; none: not checked"
    )
    expansion_per_k: NonNegative = Field(description="linear thermal expansion, 1/K")
    temperature_c: Finite = Field(default=20.0, description="of the mate, deg C")
    temperature_sigma_k: NonNegative = Field(default=0.3, description="of that temperature, 1 sigma, K")


class Stage(Model):
    """A station on the approach: stand-off along the docking axis and the speed of the move that leads to it."""

    name: Name = Field(description="of the station")
    standoff_mm: NonNegative = Field(description="distance before the docked pose, against the docking axis, mm")
    speed_mm_s: Positive = Field(description="asked for the move that leads there, mm/s; the plan may be slower")
    permissives: tuple[Name, ...] = Field(default=(), description="inputs that must be given before the move")


class Measuring(Model):
    passes: Annotated[int, Field(ge=2, le=20)] = Field(default=2, description="passes of a measurement")
    max_passes: Annotated[int, Field(ge=2, le=40)] = Field(
        default=6, description="most passes when the error is inside the noise"
    )
    drift_points: Annotated[int, Field(ge=3, le=20)] = Field(
        default=3, description="ERS points, and mate targets, measured again before each stage"
    )


class JobFile(Model):
    """A docking job."""

    schema_version: Literal[1] = Field(description="of this file format")
    part_number: Annotated[str, Field(min_length=1, max_length=64)] = Field(description="of the component")
    serial_number: Annotated[str, Field(min_length=1, max_length=64)] = Field(description="of the component")
    start: Literal["seated", "empty"] = Field(
        description="seated: the part is on its balls and they are locked; empty is refused: a docking does not begin "
        "with homing and ball entry"
    )
    lift_mm: NonNegative = Field(
        default=0.0,
        description="how far the part is lifted first, straight up against gravity, and then weighed, mm; 0: no lift",
    )
    level: bool = Field(
        default=False,
        description="whether the part is brought level before it is aligned: as level as in its docked pose by design",
    )
    lift_speed_mm_s: Positive = Field(
        default=5.0, description="asked for lift and levelling, mm/s; the plan may be slower"
    )
    component: Component = Field(description="the part that moves")
    mate: Mate = Field(description="the part that stands")
    docking_axis: Vector3 = Field(description="unit vector of the insertion, in the mate frame M")
    goal: GoalKind = Field(
        default="least-squares",
        description="how the docked pose is fitted to the features: least squares weighted by their tolerances, or the "
        "smallest largest error in tolerances",
    )
    goal_locks: tuple[Lock, ...] = Field(
        default=(),
        description="degrees of freedom that the features do not decide: shifts along, rotations about the axes of M "
        "through the docking face; they stay as in docked_pose",
    )
    docked_pose: PoseVector | None = Field(
        default=None,
        description="X_MC as designed, mm and deg; by default the least-squares fit of the features' coordinates",
    )
    stages: tuple[Stage, ...] = Field(
        min_length=1, description="stations of the approach, farthest first, the last at 0 mm"
    )
    measuring: Measuring = Field(default=Measuring(), description="how often points are measured")
    rms_limit_mm: Positive | None = Field(
        default=None, description="largest rms of a fit, mm; by default from the sigmas"
    )
    instructions: tuple[Instruction, ...] = Field(
        default=(), description="what persons do, drawn at its place by `docking guide overlay`"
    )

    @property
    def tolerance_mm(self) -> float:
        """The tightest feature tolerance."""
        return min(f.tolerance_mm for f in self.component.features)
