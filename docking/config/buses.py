"""The wires to the axes in a cell file, and how axes on them are homed. Lengths mm, times s."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from docking.config.base import Finite, Model, Name, NonNegative, Positive

Word32 = Annotated[int, Field(ge=0, le=0xFFFF_FFFF)]
Turns = Annotated[int, Field(ge=1, le=0xFFFF_FFFF)]


class DriveIdentity(Model):
    vendor: Word32 | None = Field(default=None, description="1018h:01 of every drive; any when left out")
    product: Word32 | None = Field(default=None, description="1018h:02 of every drive; any when left out")
    revision: Word32 | None = Field(default=None, description="1018h:03 of every drive; any when left out")


class DriveScale(Model):
    encoder_increments: Turns = Field(description="increments of one motor revolution, 608Fh")
    gear: tuple[Turns, Turns] = Field(
        default=(1, 1), description="motor revolutions for so many revolutions of the screw, 6091h"
    )
    mm_per_revolution: Positive = Field(
        description="travel of one revolution of the screw, mm; 6092h must state it in counts_per_mm"
    )


Framing = Literal["8N1", "8N2", "8E1", "8O1"]


PROFILE_RAMP_S = 0.5
"""From rest to full speed, and back, of drives that ramp by themselves."""


class CanBus(Model):
    kind: Literal["canopen"] = Field(description="twelve or fewer CiA 402 drives that take one position each cycle")
    interface: str = Field(description="python-can interface name, such as socketcan")
    channel: str = Field(description="python-can channel, such as can0")
    further_channels: tuple[str, ...] = Field(
        default=(), description="further buses of the same kind; a positioner says by can_channel which is its own"
    )
    sync_skew_s: NonNegative = Field(
        default=0.001,
        description="with further_channels: largest time between the SYNCs of one cycle on two of the buses, s",
    )
    bitrate: Literal[125000, 250000, 500000, 1000000] = Field(default=1000000, description="bit/s")
    cycle_s: Annotated[float, Field(ge=0.002, le=0.1)] = Field(default=0.01, description="SYNC period, s")
    heartbeat_s: Annotated[float, Field(ge=0.02, le=1.0)] = Field(
        default=0.1, description="heartbeat period of master and drives, s"
    )
    drive_timeout_s: Annotated[float, Field(ge=0.05, le=2.0)] = Field(
        default=0.28, description="a drive stops by itself when the master's heartbeat is silent this long, s"
    )
    prove_watchdog: bool = Field(
        default=False,
        description="at every start, with the axes disabled, the heartbeat pauses until every drive has missed it",
    )
    map: str = Field(default="cia402", description="object map in drivers/maps")
    profile_position: bool = Field(
        default=False,
        description="the drives have neither cyclic synchronous nor interpolated position: plans are cut into straight "
        "pieces from rest to rest, which each drive goes by its own ramps (profile position)",
    )
    counts_per_mm: Positive = Field(default=10000.0, description="position units of the drives in one mm")
    identity: DriveIdentity = Field(
        default=DriveIdentity(), description="vendor, product and revision that every drive must show (1018h)"
    )
    scale: DriveScale | None = Field(
        default=None, description="encoder, gear and screw that every drive must state; not compared when left out"
    )
    servo_lag_s: Annotated[float, Field(ge=0.0, le=0.1)] = Field(
        default=0.002, description="following error of a healthy axis, divided by its speed, s"
    )

    @property
    def channels(self) -> tuple[str, ...]:
        """All buses of the cell, the first first."""
        return (self.channel, *self.further_channels)

    @property
    def start_skew_s(self) -> float:
        """How far apart two axes may begin: nothing on one SYNC that they follow."""
        return self.sync_skew_s if self.further_channels or self.profile_position else 0.0

    @property
    def queued(self) -> bool:
        """The devices play what they were given by themselves."""
        return self.profile_position

    @property
    def ramp_s(self) -> float:
        """How long a drive takes in profile position from full speed to rest."""
        return PROFILE_RAMP_S


class ModbusBus(Model):
    kind: Literal["modbus-tcp", "modbus-rtu"] = Field(
        description="positioner PLCs with a segment queue and a common RUN line, each at an address or all on one line"
    )
    line: str | None = Field(default=None, description="modbus-rtu: serial port of all positioners, any pyserial URL")
    baud: Annotated[int, Field(ge=9600, le=1_000_000)] = Field(
        default=115200, description="modbus-rtu: speed of the line, bit/s"
    )
    framing: Framing = Field(
        default="8N1", description="modbus-rtu: data bits, parity (None, Even, Odd), stop bits of a character"
    )
    segment_s: Annotated[float, Field(ge=0.02, le=0.5)] = Field(
        default=0.1, description="duration of one queued segment, s"
    )
    poll_s: Annotated[float, Field(ge=0.01, le=0.5)] = Field(default=0.05, description="period of the read-back, s")
    timeout_s: Annotated[float, Field(ge=0.01, le=2.0)] = Field(
        default=0.05, description="longest time one reply may take, s"
    )
    watchdog_s: Annotated[float, Field(ge=0.05, le=2.0)] = Field(
        default=0.12, description="a PLC stops by itself when the host is silent this long, s"
    )
    ramp_s: Annotated[float, Field(ge=0.05, le=5.0)] = Field(
        default=0.5, description="playback rate 1 -> 0 on hold or stop, s"
    )
    start_skew_s: NonNegative = Field(default=0.001, description="largest difference of the common start edge, s")
    clock_ppm: NonNegative = Field(default=50.0, description="largest deviation of a controller's clock, ppm")
    scan_s: Annotated[float, Field(ge=0.001, le=0.1)] = Field(
        default=0.01, description="scan of the controllers, compared with what they say of themselves, s"
    )
    servo_lag_s: Annotated[float, Field(ge=0.0, le=0.06)] = Field(
        default=0.002, description="following error of a healthy axis, divided by its speed, s"
    )
    map: str = Field(default="positioner_plc", description="register map in drivers/maps")

    @property
    def queued(self) -> bool:
        """The devices play what they were given by themselves."""
        return True

    @model_validator(mode="after")
    def _line_where_there_is_one(self) -> Self:
        if (self.kind == "modbus-rtu") != (self.line is not None):
            raise ValueError("'line' belongs to kind 'modbus-rtu', which needs it")
        return self


class SingleAxis(Model):
    """An axis that carries nothing together with others, behind a drive that moves by numbers (Modbus RTU)."""

    name: Name = Field(description="of the axis, such as platform-left; not that of a positioner")
    line: str = Field(min_length=1, description="serial port, any pyserial URL; not the line of the positioners")
    baud: Annotated[int, Field(ge=9600, le=1_000_000)] = Field(default=38400, description="speed of the line, bit/s")
    framing: Framing = Field(default="8N1", description="data bits, parity (None, Even, Odd), stop bits of a character")
    unit: Annotated[int, Field(ge=1, le=247)] = Field(description="its unit on the line")
    map: str = Field(default="iai_numerical", description="map in drivers/maps")
    stroke_mm: tuple[Finite, Finite] = Field(description="lower and upper end, mm")
    v_mm_s: Positive = Field(description="largest speed, mm/s")
    a_mm_s2: Positive = Field(description="acceleration, mm/s^2")
    timeout_s: Annotated[float, Field(ge=0.01, le=2.0)] = Field(
        default=0.1, description="longest time one reply may take, s"
    )


class HomingConfig(Model):
    """How free axes find their zero; drives with absolute encoders need it once, others after every loss of supply."""

    method: Annotated[int, Field(ge=1, le=37)] = Field(
        default=37, description="homing method of the drives (6098h); 35 and 37 take the present position, unmoved"
    )
    speed_mm_s: tuple[Positive, Positive] = Field(
        default=(5.0, 1.0), description="while the switch is looked for, and while the zero is (6099h), mm/s"
    )
    acceleration_mm_s2: Positive = Field(default=20.0, description="of homing (609Ah), mm/s^2")
    timeout_s: Positive = Field(default=120.0, description="longest time a group may take, s")
    free_n: Positive = Field(default=50.0, description="most that a load cell may show under an axis that is free, N")
