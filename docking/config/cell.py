"""The CELL file: what stands in the hall. Lengths mm, times s, forces N, angles deg."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from docking.config.base import Finite, Fraction, Model, Name, NonNegative, PoseVector, Positive, Vector3


class Noise(Model):
    """Noise of the instrument, one standard deviation; set only to override the device class."""

    range_um: Positive = Field(description="constant part along the line of sight")
    range_um_per_m: NonNegative
    transverse_um: NonNegative = Field(description="constant part across the line of sight")
    transverse_um_per_m: NonNegative


class ErsPoint(Model):
    """A fixed reference point that defines the assembly frame W."""

    name: Name
    xyz_mm: Vector3
    sigma_mm: Positive


class TrackerConfig(Model):
    protocol: Literal["line", "geocom"]
    port: str = Field(min_length=1, description="any pyserial URL: /dev/ttyUSB0, socket://host:port, rfc2217://host:port")
    baud: Annotated[int, Field(ge=1200, le=1_000_000)] = 115200
    device_class: Literal["laser-tracker", "total-station"]
    noise: Noise | None = None
    station_pose: PoseVector = Field(description="approximate X_WT; refined from the ERS points")
    ers: tuple[ErsPoint, ...] = Field(min_length=4)
    measure_timeout_s: Positive = 15.0
    two_face: bool = False
    two_face_limit_mm: Positive = 0.5
    drift_um_per_h: NonNegative = Field(default=50.0, description="station drift assumed since the last reference check")


class CanBus(Model):
    kind: Literal["canopen"]
    interface: str = Field(description="python-can interface name")
    channel: str
    bitrate: Literal[125000, 250000, 500000, 1000000] = 1000000
    cycle_s: Annotated[float, Field(ge=0.002, le=0.1)] = 0.01
    heartbeat_s: Annotated[float, Field(ge=0.02, le=1.0)] = 0.1
    drive_timeout_s: Annotated[float, Field(ge=0.05, le=2.0)] = 0.28
    map: str = Field(default="cia402", description="object map in drivers/maps")
    counts_per_mm: Positive = 10000.0


class ModbusBus(Model):
    kind: Literal["modbus-tcp"]
    segment_s: Annotated[float, Field(ge=0.02, le=0.5)] = 0.1
    poll_s: Annotated[float, Field(ge=0.01, le=0.5)] = 0.05
    timeout_s: Annotated[float, Field(ge=0.01, le=2.0)] = 0.05
    watchdog_s: Annotated[float, Field(ge=0.05, le=2.0)] = 0.2
    ramp_s: Annotated[float, Field(ge=0.05, le=5.0)] = Field(default=0.5, description="playback rate 1 -> 0 on hold or stop")
    start_skew_s: NonNegative = Field(default=0.001, description="largest difference of the common start edge")
    clock_ppm: NonNegative = Field(default=50.0, description="largest deviation of a controller's clock")
    map: str = Field(default="positioner_plc", description="register map in drivers/maps")


class AxisConfig(Model):
    name: Literal["X", "Y", "Z"]
    node: Annotated[int, Field(ge=1, le=127)] | None = Field(default=None, description="CANopen node id")
    direction: Vector3 = Field(description="real axis direction times scale, in W")
    driven: bool = True
    stroke_mm: tuple[Finite, Finite]
    v_mm_s: Positive
    a_mm_s2: Positive
    j_mm_s3: Positive
    a_quick_mm_s2: Positive


class PositionerConfig(Model):
    name: Name
    origin_mm: Vector3 = Field(description="ball centre in W with all axes at zero, unloaded")
    axes: tuple[AxisConfig, AxisConfig, AxisConfig]
    stiffness_n_per_mm: tuple[Positive, Positive, Positive] = Field(description="along the axes, positioner with local structure")
    rated_n: tuple[Positive, Positive, Positive]
    swivel_deg: Positive = 15.0
    host: str | None = Field(default=None, description="Modbus TCP address")
    port: Annotated[int, Field(ge=1, le=65535)] | None = None
    unit: Annotated[int, Field(ge=1, le=247)] | None = None
    load_cell: bool = False


class LoadCellConfig(Model):
    range_n: tuple[Positive, Positive, Positive]
    noise_n: Positive = 25.0


class SettleConfig(Model):
    window_s: Positive = 1.0
    readings: Annotated[int, Field(ge=2, le=20)] = 4
    tolerance_mm: Positive = 0.005
    timeout_s: Positive = 20.0


class LimitsConfig(Model):
    following_error_rest_mm: Positive = 0.1
    following_error_vmax_mm: Positive = 0.5
    ball_residual_warn_mm: Positive = 0.05
    ball_residual_mm: Positive = 0.1
    internal_force_warn_n: Positive = 500.0
    internal_force_n: Positive = 1500.0
    warp_force_n: Positive = 300.0
    reaction_min_fraction: Fraction = Field(default=0.1, description="of the equal share of the weight")
    stroke_margin_mm: NonNegative = 2.0
    first_correction_mm: Positive = 50.0
    first_correction_deg: Positive = 2.0
    station_correction_max_mm: Positive = 4.0
    station_correction_min_mm: Positive = 0.5
    station_correction_gap_fraction: Fraction = 0.2
    max_corrections: Annotated[int, Field(ge=1, le=20)] = Field(default=5, description="per stage")
    frame_plausibility_mm: Positive = Field(default=0.5, description="measured pose against axis positions, largest ball")
    fit_age_s: Positive = 300.0
    target_residual_mm: Positive = Field(default=0.5, description="largest residual of a target in an accepted fit")
    chord_error_mm: Positive = 0.02
    missing_cycles: Annotated[int, Field(ge=1, le=100)] = 2
    condition_max: Positive = Field(default=50.0, description="of the driven-axis Jacobian, rotations scaled")
    rotation_length_mm: Positive = Field(default=3000.0, description="length that scales rotations")


class CellFile(Model):
    """A docking cell: instrument, positioners, bus, limits."""

    schema_version: Literal[1]
    name: Name
    tracker: TrackerConfig
    bus: CanBus | ModbusBus = Field(discriminator="kind")
    positioners: tuple[PositionerConfig, ...] = Field(min_length=3)
    load_cells: LoadCellConfig | None = None
    gravity_direction: Vector3 = (0.0, 0.0, -1.0)
    temperature_c: Finite = Field(default=20.0, description="reference temperature of all nominal coordinates")
    limits: LimitsConfig = LimitsConfig()
    settle: SettleConfig = SettleConfig()
    permissives: tuple[Name, ...] = Field(default=(), description="named inputs the cell offers")

    @property
    def axis_names(self) -> tuple[str, ...]:
        """All axes in file order: `positioner.axis`."""
        return tuple(f"{p.name}.{a.name}" for p in self.positioners for a in p.axes)

    @property
    def driven(self) -> tuple[bool, ...]:
        return tuple(a.driven for p in self.positioners for a in p.axes)
