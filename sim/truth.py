"""The truth file NAME.sim.toml: how the simulated cell differs from what the cell and job files say.

Every unmodelled error is one named group with its own size; `errors` holds one scale a group (1 = as written,
0 = off). Sizes marked [K] in the truth files have no public source. `docking` never reads these files.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator

from docking.config.base import Model, Name, NonNegative, Positive
from docking.types import Array
from sim.toml_model import read_toml

ERROR_NAMES: tuple[str, ...] = (
    "nominal_nests",
    "feature_transfer",
    "seating",
    "station_drift",
    "station_bump",
    "refraction",
    "temperature",
    "floor_settlement",
    "sag",
    "ball_clearance",
    "stick_slip",
    "screw_lead",
    "load_cell_noise",
    "load_cell_crosstalk",
    "load_cell_drift",
    "mate_creep",
    "mate_pose",
    "station_pose",
    "calibration",
    "uncalibrated_base",
    "repeatability",
    "backlash",
    "clock_ppm",
    "gross_errors",
    "fast_outliers",
    "instrument_noise",
    "range_zero",
    "collimation",
    "ers_points",
    "mass_properties",
    "misalignment",
)
"""Names of the unmodelled errors. The order fixes each error's random stream: append, never reorder."""

OFF_BY_DEFAULT = frozenset({"uncalibrated_base"})

Probability = Annotated[float, Field(ge=0.0, le=1.0)]
Span = tuple[NonNegative, NonNegative]


class PerCoordinate(Model):
    """A normal error of every coordinate, constant in a run (as built)."""

    sigma_mm: NonNegative


class Seating(Model):
    """Reflector in its nest: every shot, normal; sigma of each target drawn uniformly in `sigma_um`."""

    sigma_um: Span


class DriftRate(Model):
    """A steady drift: speed drawn uniformly in `um_per_h`, direction random."""

    um_per_h: Span


class StationBump(Model):
    """One sudden shift of the station, with `probability`, at a time uniform in the first `window_s` of the run."""

    shift_mm: NonNegative
    probability: Probability
    window_s: Positive


class Refraction(Model):
    """Vertical temperature gradient of the air, either sign."""

    k_per_m: NonNegative


class Temperature(Model):
    """Component and mate, each: offset from the job's value +-`offset_k`, and a ramp of +-`rate_k_per_h`."""

    offset_k: NonNegative
    stress_offset_k: NonNegative
    rate_k_per_h: NonNegative


class FloorSettlement(Model):
    """Each floor pad sinks by a depth drawn in `um` (at the equal share of load), after the load was transferred."""

    um: Span
    time_constant_s: Positive


class Sag(Model):
    """Bending of the component: normal as-built amplitude, and a part that follows the change of its support."""

    sigma_um: NonNegative
    um_per_support_change: NonNegative


class BallClearance(Model):
    """Play of the ball in its socket, side to side, drawn in `um`; it slips when a side force exceeds `friction_n`."""

    um: Span
    friction_n: NonNegative


class Micrometres(Model):
    """An error with one size in micrometres."""

    um: NonNegative


class ScrewLead(Model):
    """Normal error of each screw's lead."""

    um_per_m: NonNegative


class FractionOfScale(Model):
    """An error relative to the range (noise), to the other axes' loads (cross-talk), to the range an hour (drift)."""

    fraction: NonNegative


class PoseError(Model):
    """Uniform error of a pose, every coordinate and every angle."""

    mm: NonNegative
    mrad: NonNegative


class Calibration(Model):
    """Normal errors left by the calibration of the cell: true value = cell or job file + error, per coordinate."""

    origin_mm: NonNegative
    direction_mrad: NonNegative
    ball_mm: NonNegative


class Degrees(Model):
    deg: NonNegative


class ClockPpm(Model):
    """Uniform error of every device's own clock."""

    ppm: NonNegative


class GrossErrors(Model):
    """Rare blunders: unseated reflector (per target and run); lost beam, wrong nest, inaccurate reading (per shot)."""

    unseated: Probability
    unseated_mm: Span
    lost_beam: Probability
    wrong_nest: Probability
    inaccurate: Probability
    inaccurate_factor: Positive


class FastOutliers(Model):
    """Outliers of readings that take less than `below_s`."""

    probability: Probability
    um: Span
    below_s: Positive


class Angle(Model):
    urad: NonNegative


class Misalignment(Model):
    """Start of the run: every coordinate uniform in +-`mm`, every angle in +-`deg`, about the component's origin."""

    mm: NonNegative
    deg: NonNegative


class Drives(Model):
    """Servo drives and brakes as they really are; drives on CAN react as `sync_loss` says to `sync_loss_cycles` without
    SYNC, and have these `modes`; where they are not `homed` they count `zero_off_mm` too much until they are.
    `follower_friction` is of the force that a force-controlled axis holds."""

    servo_lag_s: Positive
    servo_lag_spread: NonNegative
    encoder_um: Positive
    overspeed_factor: Positive
    acceleration_factor: Positive
    brake_mm_s2: Positive
    back_drive_mm_s2: NonNegative
    passive_friction_n: Positive
    follower_friction: NonNegative = 0.005
    sync_loss: Literal["hold", "ignore", "extrapolate", "quick-stop", "fault"]
    sync_loss_cycles: Positive = 3.0
    watchdog_scatter_s: NonNegative = 0.0
    modes: tuple[int, ...] = (6, 8, 10)
    homed: bool = True
    zero_off_mm: float = 0.0


class InstrumentTruth(Model):
    """How the optics are used."""

    measure_s: Positive
    search_cone_deg: Positive


class TruthFile(Model):
    """The whole truth file. Without a part on the balls (`part_on_balls`) the positioners stand free where they would
    carry it: the load cells read nothing, and no reflector of the part is seen."""

    schema_version: Literal[1]
    name: Name
    part_on_balls: bool = True
    errors: dict[str, NonNegative]
    drives: Drives
    instrument: InstrumentTruth
    nominal_nests: PerCoordinate
    feature_transfer: PerCoordinate
    seating: Seating
    station_drift: DriftRate
    station_bump: StationBump
    refraction: Refraction
    temperature: Temperature
    floor_settlement: FloorSettlement
    sag: Sag
    ball_clearance: BallClearance
    stick_slip: Micrometres
    screw_lead: ScrewLead
    load_cell_noise: FractionOfScale
    load_cell_crosstalk: FractionOfScale
    load_cell_drift: FractionOfScale
    mate_creep: DriftRate
    mate_pose: PoseError
    station_pose: PoseError
    calibration: Calibration
    uncalibrated_base: Degrees
    repeatability: Micrometres
    backlash: Micrometres
    clock_ppm: ClockPpm
    gross_errors: GrossErrors
    fast_outliers: FastOutliers
    range_zero: Micrometres
    collimation: Angle
    misalignment: Misalignment

    @field_validator("errors")
    @classmethod
    def _complete_scales(cls, given: dict[str, float]) -> dict[str, float]:
        unknown = sorted(set(given) - set(ERROR_NAMES))
        if unknown:
            raise ValueError(f"unknown error names {unknown}; known: {', '.join(ERROR_NAMES)}")
        default = {name: 0.0 if name in OFF_BY_DEFAULT else 1.0 for name in ERROR_NAMES}
        return {**default, **given}

    def scaled(self, scales: Mapping[str, float]) -> TruthFile:
        """The same truth with some errors scaled (1 = as written, 0 = off)."""
        unknown = sorted(set(scales) - set(ERROR_NAMES))
        if unknown:
            raise KeyError(f"unknown error names {unknown}")
        return self.model_copy(update={"errors": {**self.errors, **scales}})

    def only(self, name: str, scale: float = 1.0) -> TruthFile:
        """The same truth with every error off but `name`."""
        return self.scaled({**dict.fromkeys(ERROR_NAMES, 0.0), name: scale})

    def without_errors(self) -> TruthFile:
        """The cell exactly as its files say (drive dynamics and elasticity stay)."""
        return self.scaled(dict.fromkeys(ERROR_NAMES, 0.0))

    def stress(self) -> TruthFile:
        """All errors at stress size: temperature at `stress_offset_k`, a bump in every run."""
        hot = self.temperature.model_copy(update={"offset_k": self.temperature.stress_offset_k})
        bump = self.station_bump.model_copy(update={"probability": 1.0})
        return self.model_copy(update={"temperature": hot, "station_bump": bump})


def load_truth(path: Path) -> TruthFile:
    """Read NAME.sim.toml. Raises FileUnreadable or ConfigInvalid (all problems at once)."""
    return read_toml(path, TruthFile)


class Draws:
    """Random draws of one run: an own generator for every error, so that switching one leaves the others alone."""

    def __init__(self, truth: TruthFile, seed: int) -> None:
        sequences = np.random.SeedSequence(seed).spawn(len(ERROR_NAMES))
        self._generators = {n: np.random.default_rng(s) for n, s in zip(ERROR_NAMES, sequences, strict=True)}
        self._scales = truth.errors

    def scale(self, name: str) -> float:
        return self._scales[name]

    def generator(self, name: str) -> np.random.Generator:
        """The generator of `name`: draw the same count whatever the scale."""
        return self._generators[name]

    def normal(self, name: str, size: tuple[int, ...]) -> Array:
        """Scaled standard normal draws."""
        return self._scales[name] * self._generators[name].standard_normal(size)

    def uniform(self, name: str, size: tuple[int, ...]) -> Array:
        """Scaled uniform draws in +-1."""
        return self._scales[name] * self._generators[name].uniform(-1.0, 1.0, size)

    def span(self, name: str, limits: Span, size: tuple[int, ...]) -> Array:
        """Scaled uniform draws in `limits`."""
        return self._scales[name] * self._generators[name].uniform(limits[0], limits[1], size)

    def direction(self, name: str) -> Array:
        """A random unit vector (3,), never scaled."""
        vector = self._generators[name].standard_normal(3)
        unit: Array = vector / np.linalg.norm(vector)
        return unit
