"""The JOB file: one part to dock. Coordinates in the component frame C and the mate frame M, mm."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from docking.config.base import Finite, Model, Name, NonNegative, PoseVector, Positive, Vector3


class Target(Model):
    """A reflector nest: nominal coordinates and their sigma (1 sigma a coordinate, as built).

    The reflector's centre stands `reflector_offset_mm` along `normal` from `xyz_mm`.
    """

    name: Name
    xyz_mm: Vector3
    sigma_mm: Positive
    reflector_offset_mm: NonNegative = 0.0
    normal: Vector3 = (0.0, 0.0, 1.0)


class Ball(Model):
    positioner: Name
    xyz_mm: Vector3


class Feature(Model):
    """A docking feature: a point of the component and the point of the mate it must meet."""

    name: Name
    xyz_mm: Vector3
    mate_xyz_mm: Vector3
    sigma_mm: Positive = Field(description="of the feature to the component's targets, 1 sigma a coordinate")
    mate_sigma_mm: Positive
    tolerance_mm: Positive


class Component(Model):
    mass_kg: Positive
    mass_tolerance_kg: NonNegative
    com_mm: Vector3
    com_tolerance_mm: Vector3
    targets: tuple[Target, ...] = Field(min_length=3)
    check_points: tuple[Target, ...] = Field(default=(), description="measured, never fitted")
    balls: tuple[Ball, ...] = Field(min_length=3)
    features: tuple[Feature, ...] = Field(min_length=3)
    docking_face_mm: Vector3 = Field(description="pivot of corrections: centre of the docking face")
    expansion_per_k: NonNegative
    temperature_c: Finite = 20.0
    temperature_sigma_k: NonNegative = 0.3


class Mate(Model):
    pose: PoseVector = Field(description="approximate X_WM; refined from its targets")
    targets: tuple[Target, ...] = Field(min_length=4)
    expansion_per_k: NonNegative
    temperature_c: Finite = 20.0
    temperature_sigma_k: NonNegative = 0.3


class Stage(Model):
    """A station on the approach: stand-off along the docking axis and the speed of the move that leads to it."""

    name: Name
    standoff_mm: NonNegative
    speed_mm_s: Positive
    permissives: tuple[Name, ...] = ()


class Measuring(Model):
    passes: Annotated[int, Field(ge=2, le=20)] = 2
    max_passes: Annotated[int, Field(ge=2, le=40)] = 6
    drift_points: Annotated[int, Field(ge=3, le=20)] = 3


class JobFile(Model):
    """A docking job."""

    schema_version: Literal[1]
    part_number: Annotated[str, Field(min_length=1, max_length=64)]
    serial_number: Annotated[str, Field(min_length=1, max_length=64)]
    start: Literal["seated", "empty"] = Field(description="seated: balls locked and load taken; empty: begin with homing")
    component: Component
    mate: Mate
    docking_axis: Vector3 = Field(description="direction of insertion, in the mate frame M")
    stages: tuple[Stage, ...] = Field(min_length=1)
    measuring: Measuring = Measuring()
    rms_limit_mm: Positive | None = None

    @property
    def tolerance_mm(self) -> float:
        """The tightest feature tolerance."""
        return min(f.tolerance_mm for f in self.component.features)
