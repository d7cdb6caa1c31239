"""The CELL file: what stands in the hall. Lengths mm, times s, forces N, angles deg."""

from __future__ import annotations

from datetime import date
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from docking.config.base import Finite, Fraction, Model, Name, NonNegative, PoseVector, Positive, Vector3
from docking.config.buses import CanBus, DriveIdentity, DriveScale, HomingConfig, ModbusBus, SingleAxis
from docking.config.inputs import CanModule, InputsConfig, ModbusModule
from docking.config.instruments import GeocomConfig, InertialConfig, NdiConfig
from docking.config.live import LiveConfig, StereoConfig

__all__ = [
    "AxisConfig",
    "CanBus",
    "CellFile",
    "DriveIdentity",
    "DriveScale",
    "ErsPoint",
    "HomingConfig",
    "LimitsConfig",
    "LoadCellConfig",
    "ModbusBus",
    "MotionConfig",
    "Noise",
    "PositionerConfig",
    "SettleConfig",
    "SingleAxis",
    "TrackerConfig",
]


class Noise(Model):
    """Noise of the instrument, one standard deviation; set only to override the device class."""

    range_um: Positive = Field(description="constant part along the line of sight, um, 1 sigma")
    range_um_per_m: NonNegative = Field(
        description="part along the line of sight that grows with the distance, um per m"
    )
    transverse_um: NonNegative = Field(description="constant part across the line of sight, um, 1 sigma")
    transverse_um_per_m: NonNegative = Field(
        description="part across the line of sight that grows with the distance, um per m"
    )


class ErsPoint(Model):
    """A fixed reference point that defines the assembly frame W."""

    name: Name = Field(description="as the instrument knows it")
    xyz_mm: Vector3 = Field(description="surveyed reflector centre in W, mm")
    sigma_mm: Positive = Field(description="of the survey, 1 sigma a coordinate, mm")


class TrackerConfig(Model):
    protocol: Literal["line", "geocom"] = Field(description="line: the gateway's line protocol; geocom: GeoCOM ASCII")
    port: str = Field(
        min_length=1, description="any pyserial URL: /dev/ttyUSB0, socket://host:port, rfc2217://host:port"
    )
    baud: Annotated[int, Field(ge=1200, le=1_000_000)] = Field(default=115200, description="line speed, bit/s")
    device_class: Literal["laser-tracker", "total-station"] = Field(description="whose noise model holds")
    noise: Noise | None = Field(default=None, description="set only to override the noise of the device class")
    station_pose: PoseVector = Field(description="approximate X_WT, mm and deg; refined from the ERS points")
    ers: tuple[ErsPoint, ...] = Field(min_length=4, description="fixed reference points that define W")
    measure_timeout_s: Positive = Field(default=15.0, description="longest time one point may take, s")
    seating_um: NonNegative = Field(
        default=10.0, description="repeatability of a reflector in its nest, 1 sigma a coordinate, um"
    )
    calibration_due: date | None = Field(
        default=None,
        description="date on which the instrument is due for calibration; `docking devices` warns after it",
    )
    two_face: bool = Field(default=False, description="the instrument measures in both faces")
    two_face_limit_mm: Positive = Field(
        default=0.5, description="largest distance between the two faces' readings of a point, mm"
    )
    drift_um_per_h: NonNegative = Field(
        default=50.0,
        description="station drift assumed since the last reference check, um per hour, 1 sigma a coordinate",
    )
    geocom: GeocomConfig | None = Field(default=None, description="settings of a GeoCOM instrument")


class AxisConfig(Model):
    name: Literal["X", "Y", "Z"] = Field(description="X, Y or Z; the axis is called positioner.axis")
    node: Annotated[int, Field(ge=1, le=127)] | None = Field(default=None, description="CANopen node id")
    serial_number: Annotated[int, Field(ge=1, le=0xFFFF_FFFF)] | None = Field(
        default=None, description="expected serial number of the drive (1018h:04); any when left out"
    )
    home_mm: Finite = Field(default=0.0, description="position that the axis has at its home (607Ch), mm")
    homing_method: Annotated[int, Field(ge=1, le=37)] | None = Field(
        default=None, description="homing method of this axis where it is not homing.method"
    )
    direction: Vector3 = Field(description="real axis direction times scale, in W")
    driven: bool = Field(
        default=True, description="true: holds a position; false: follows the component, its encoder is read"
    )
    force_n: Positive | None = Field(
        default=None,
        description="an axis that is not driven holds this force against gravity, N; without it, it follows unpowered",
    )
    force_tolerance: Annotated[float, Field(gt=0.0, le=0.2)] = Field(
        default=0.02, description="largest deviation of the held force, as a fraction of it"
    )
    stroke_mm: tuple[Finite, Finite] = Field(description="lower and upper end, mm")
    v_mm_s: Positive = Field(description="largest speed, mm/s")
    a_mm_s2: Positive = Field(description="largest acceleration, mm/s^2")
    j_mm_s3: Positive = Field(description="largest jerk, mm/s^3")
    a_quick_mm_s2: Positive = Field(description="quick-stop deceleration, mm/s^2")

    @model_validator(mode="after")
    def _force_instead_of_position(self) -> Self:
        """An axis that holds a force holds no position."""
        if self.force_n is not None and self.driven:
            raise ValueError("an axis with force_n holds no position: set driven = false")
        return self

    @property
    def powered(self) -> bool:
        """True for an axis under power: it holds a position or a force."""
        return self.driven or self.force_n is not None


class PositionerConfig(Model):
    name: Name = Field(description="such as A")
    origin_mm: Vector3 = Field(description="ball centre in W with all axes at zero, unloaded, mm")
    axes: tuple[AxisConfig, AxisConfig, AxisConfig] = Field(description="X, Y and Z, each once")
    stiffness_n_per_mm: tuple[Positive, Positive, Positive] = Field(
        description="along the axes, positioner with local structure, N/mm"
    )
    rated_n: tuple[Positive, Positive, Positive] = Field(description="largest load along each axis, N")
    swivel_deg: Positive = Field(
        default=15.0, description="largest turn of the ball in its socket from the docked attitude, deg"
    )
    back_drive_m_s2: NonNegative = Field(
        default=0.5,
        description="how a vertical axis accelerates downwards from torque off until its brake has closed; 0 where it "
        "holds by itself, m/s^2",
    )
    brake_s: tuple[NonNegative, Positive] = Field(
        default=(0.05, 0.1), description="shortest and longest time from torque off until a brake has closed, s"
    )
    host: str | None = Field(default=None, description="Modbus TCP address")
    port: Annotated[int, Field(ge=1, le=65535)] | None = Field(default=None, description="Modbus TCP port")
    unit: Annotated[int, Field(ge=1, le=247)] | None = Field(default=None, description="Modbus unit id")
    can_channel: str | None = Field(
        default=None, description="the CAN bus of its axes: bus.channel or one of bus.further_channels; the first"
    )
    load_cell: bool = Field(default=False, description="a three-component load cell sits under the ball")


class LoadCellConfig(Model):
    range_n: tuple[Positive, Positive, Positive] = Field(description="along X, Y, Z, N")
    crosstalk: Fraction = Field(
        default=0.01, description="of the other two components of a ball, as a fraction of them, 1 sigma"
    )
    drift_per_h: Fraction = Field(default=0.001, description="of the zero, as a fraction of the range an hour, 1 sigma")
    resolution_n: Positive = Field(default=10.0, description="one count of a reading, N")


class SettleConfig(Model):
    window_s: Positive = Field(default=1.0, description="wait after standstill before measuring, s")
    readings: Annotated[int, Field(ge=2, le=20)] = Field(
        default=4, description="consecutive stationary read-backs asked"
    )
    tolerance_mm: Positive = Field(default=0.005, description="largest movement between them, mm")
    timeout_s: Positive = Field(default=20.0, description="longest wait for standstill, s")


class LimitsConfig(Model):
    following_error_rest_mm: Positive = Field(default=0.1, description="stop above it at rest, mm")
    following_error_vmax_mm: Positive = Field(
        default=0.5, description="stop above it at full axis speed, in proportion below, mm"
    )
    stuck_mm: Annotated[float, Field(ge=0.005, le=1.0)] = Field(
        default=0.02,
        description="an axis that hangs back by more than its lag while its encoder makes less than half of the "
        "commanded step is stuck, mm",
    )
    standstill_mm: Positive = Field(
        default=0.02, description="stop when an axis that was told to stand moves farther than this, mm"
    )
    passive_mm: Positive = Field(
        default=0.1,
        description="stop when an axis that follows the component stays behind by more than this, mm; play and "
        "friction are inside. Bounds the speed of a plan",
    )
    adrift_mm: Positive = Field(
        default=0.5,
        description="stop when an axis that follows the component has with time come farther than this from where the "
        "component takes it; brake when one that holds a force has, as it has lost its ball; mm",
    )
    sync_error_mm: Positive = Field(
        default=0.05,
        description="how far positioners on clocks of their own may squeeze the ball figure on the way; bounds the "
        "speed of a plan, mm",
    )
    ball_residual_mm: Positive = Field(
        default=0.1, description="stop when the read-backs part from a rigid figure by more, mm"
    )
    ball_rms_mm: Positive = Field(default=0.06, description="the same for the root mean square over the balls, mm")
    ball_pair_mm: Positive = Field(
        default=0.15, description="stop when the distance of two balls changes by more, by the read-backs, mm"
    )
    internal_force_n: Positive = Field(
        default=1500.0, description="stop above this internal force at a ball, predicted from the read-backs, N"
    )
    warp_force_n: Positive = Field(default=300.0, description="stop above this warp force of the vertical axes, N")
    measured_force_n: Positive = Field(
        default=1500.0,
        description="stop when the load cells show more force at a ball, beyond what weight and attitude let expect, "
        "than when the move was loaded, N",
    )
    measured_warp_n: Positive = Field(default=600.0, description="the same for the warp of the vertical axes, N")
    measured_whole_force_n: Positive = Field(
        default=2500.0,
        description="the same without a tare; wider, because load cells drift and cross-talk and mass and centre of "
        "mass have tolerances, N",
    )
    measured_whole_warp_n: Positive = Field(default=1200.0, description="the same for the warp, N")
    standing_force_n: Positive = Field(
        default=300.0,
        description="most that the measured internal force at a ball may change while the axes stand, between load and"
        " start and between hold and resume, N",
    )
    overload_fraction: Annotated[float, Field(gt=1.0, le=3.0)] = Field(
        default=1.1, description="stop when a ball carries more than this times what it is expected to carry"
    )
    underload_fraction: Annotated[float, Field(gt=0.0, lt=1.0)] = Field(
        default=0.5, description="stop when a ball carries less than this times what it is expected to carry"
    )
    relief_target_n: Positive = Field(
        default=200.0, description="a stress relief ends when no ball carries more internal force, N"
    )
    reaction_min_fraction: Fraction = Field(
        default=0.1, description="least upward ball reaction, as a fraction of the equal share of the weight"
    )
    clearance_mm: NonNegative = Field(
        default=2.0,
        description="kept between component.outline_mm and mate.envelope, or half the gap where that is less; mm",
    )
    contact_mm: NonNegative = Field(
        default=0.3, description="taken off the clearance, so that the faces may meet at the end, mm"
    )
    corridor_mm: Positive = Field(
        default=4.0, description="how far the part may be off its straight insertion near the mate, mm"
    )
    corridor_length_mm: NonNegative = Field(
        default=100.0, description="up to this gap to the mate the part moves along its straight insertion only, mm"
    )
    stroke_margin_mm: NonNegative = Field(default=2.0, description="kept free at both stroke ends, mm")
    first_correction_mm: Positive = Field(default=50.0, description="largest shift of the first correction, mm")
    first_correction_deg: Positive = Field(default=2.0, description="largest rotation of the first correction, deg")
    station_correction_max_mm: Positive = Field(default=4.0, description="largest correction at any later station, mm")
    station_correction_min_mm: Positive = Field(
        default=0.5, description="correction always allowed at a later station, mm"
    )
    station_correction_gap_fraction: Fraction = Field(
        default=0.2, description="between the two: this fraction of the gap to the mate"
    )
    max_corrections: Annotated[int, Field(ge=1, le=20)] = Field(default=5, description="per stage")
    frame_plausibility_mm: Positive = Field(
        default=0.5, description="measured pose against axis positions, largest ball, mm"
    )
    fit_age_s: Positive = Field(default=300.0, description="oldest fit that a move may rest on, s")
    target_residual_mm: Positive = Field(default=0.5, description="largest residual of a target in an accepted fit, mm")
    chord_error_mm: Positive = Field(
        default=0.02, description="largest squeeze of the ball figure between two queued points, mm"
    )
    missing_cycles: Annotated[int, Field(ge=1, le=100)] = Field(
        default=2, description="stop after so many cycles without a read-back"
    )
    tick_late_cycles: Annotated[int, Field(ge=1, le=100)] = Field(
        default=5, description="stop when a control cycle comes so many cycles late"
    )
    condition_max: Positive = Field(default=50.0, description="of the driven-axis Jacobian, rotations scaled")
    rotation_length_mm: Positive = Field(
        default=3000.0, description="length that scales rotations, about the arm of the balls, mm"
    )


class MotionConfig(Model):
    """The motion process: how long it goes on alone, how often it reports, how it judges its own punctuality."""

    lease_s: Annotated[float, Field(ge=0.1, le=5.0)] = Field(
        default=0.5, description="the axes stop on the path when the cell process is silent this long, s"
    )
    feedback_s: Annotated[float, Field(ge=0.01, le=0.5)] = Field(
        default=0.1, description="period of the read-backs that the cell process gets; faults come at once, s"
    )
    lateness_s: Annotated[float, Field(ge=0.1, le=60.0)] = Field(
        default=3.0, description="how long the motion process measures its own lateness before it connects, s"
    )


class CellFile(Model):
    """A docking cell: instrument, positioners, bus, limits."""

    schema_version: Literal[1] = Field(description="of this file format")
    name: Name = Field(description="of the cell")
    tracker: TrackerConfig = Field(description="the instrument")
    camera: NdiConfig | None = Field(default=None, description="a camera that streams beside the instrument")
    stereo: StereoConfig | None = Field(default=None, description="a camera pair instead, for [live]")
    inertial: InertialConfig | None = Field(default=None, description="an inertial sensor on the component")
    live: LiveConfig | None = Field(default=None, description="with it the part is followed in every move")
    bus: CanBus | ModbusBus = Field(discriminator="kind", description="the wire to the axes")
    positioners: tuple[PositionerConfig, ...] = Field(min_length=3, description="in the order of all axis lists")
    load_cells: LoadCellConfig | None = Field(
        default=None, description="range and noise of the load cells, where positioners have them"
    )
    gravity_direction: Vector3 = Field(default=(0.0, 0.0, -1.0), description="unit vector in W")
    temperature_c: Finite = Field(default=20.0, description="reference temperature of all nominal coordinates, deg C")
    limits: LimitsConfig = Field(default=LimitsConfig(), description="where the cell stops or refuses")
    settle: SettleConfig = Field(default=SettleConfig(), description="standstill before measuring")
    motion: MotionConfig = Field(default=MotionConfig(), description="the process that moves the axes")
    single_axes: tuple[SingleAxis, ...] = Field(
        default=(), description="axes beside the positioners that carry nothing together with others"
    )
    homing: HomingConfig | None = Field(
        default=None, description="how the drives find their zero; with it a drive that is not homed is not enabled"
    )
    permissives: tuple[Name, ...] = Field(default=(), description="named inputs the cell offers")
    inputs: InputsConfig | None = Field(
        default=None, description="inputs that are wired; without them the operator declares the permissives"
    )

    @model_validator(mode="after")
    def _live_has_its_sensors(self) -> Self:
        """Nothing but a camera sees what the encoders do not, and an inertial method needs what it integrates."""
        if self.live is None:
            return self
        if (self.camera is None) is (self.stereo is None):
            raise ValueError("[live] needs a [camera] or a [stereo] pair, and not both")
        if self.live.method not in ("auto", "encoders") and self.inertial is None:
            raise ValueError(f"live.method = {self.live.method!r} needs an [inertial] sensor")
        names = [point.name for point in self.live.points]
        if len(set(names)) != len(names):
            raise ValueError("live.points: names repeat")
        return self

    @property
    def axis_names(self) -> tuple[str, ...]:
        """All axes in file order: `positioner.axis`."""
        return tuple(f"{p.name}.{a.name}" for p in self.positioners for a in p.axes)

    @property
    def driven(self) -> tuple[bool, ...]:
        """Which axes hold a position."""
        return tuple(a.driven for p in self.positioners for a in p.axes)

    def on_channel(self, channel: str) -> CellFile:
        """The cell as one of its CAN buses knows it: the positioners and I/O modules there, and nothing else."""
        if not isinstance(self.bus, CanBus):
            raise ValueError(f"bus.kind is {self.bus.kind!r}: there are no CAN buses")
        first = self.bus.channel

        def here(one: PositionerConfig | CanModule | ModbusModule) -> bool:
            return getattr(one, "can_channel", None) in ((None, channel) if channel == first else (channel,))

        change: dict[str, object] = {"positioners": tuple(p for p in self.positioners if here(p))}
        if self.inputs is not None:
            change["inputs"] = self.inputs.model_copy(update={"modules": tuple(filter(here, self.inputs.modules))})
        return self.model_copy(update=change)

    @property
    def powered(self) -> tuple[bool, ...]:
        """Which axes are under power: those that hold a position and those that hold a force."""
        return tuple(a.powered for p in self.positioners for a in p.axes)
