"""Settings of single instruments in the CELL file. Lengths mm, times s, angles deg."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from docking.config.base import Finite, Model, Name, PoseVector

INERTIAL_LINE_BYTES = {"VNYMR": 140, "VNIMU": 125}
"""Longest line of each message, time stamp and checksum included."""


class AirConfig(Model):
    """The air in which the instrument measures distances."""

    pressure_hpa: Annotated[float, Field(ge=500.0, le=1100.0)] = Field(description="air pressure, hPa")
    dry_c: Annotated[float, Field(ge=-20.0, le=60.0)] = Field(description="dry-bulb temperature, C")
    wet_c: Annotated[float, Field(ge=-20.0, le=60.0)] = Field(
        description="wet-bulb temperature, C; equal to dry_c in saturated air"
    )

    @model_validator(mode="after")
    def _wet_is_not_warmer(self) -> Self:
        """A wet bulb is never warmer than a dry one."""
        if not self.wet_c <= self.dry_c:
            raise ValueError("wet_c is above dry_c")
        return self


class GeocomConfig(Model):
    """Only for protocol = "geocom"."""

    checksum: bool = Field(default=False, description="use the lines' CRC form, where the instrument has it")
    search_deg: Annotated[float, Field(ge=0.0, le=30.0)] = Field(
        default=0.0,
        description="width of the window that is searched when no reflector is near the aim, deg; 0 = no search",
    )
    prism_mm: Finite | None = Field(
        default=None, description="prism constant, written and read back, mm; left as it is when not given"
    )
    air: AirConfig | None = Field(
        default=None, description="atmospheric correction, written and read back; left as it is when not given"
    )


class NdiToolConfig(Model):
    """A tool that is not plugged in: its definition has to be loaded."""

    name: Name = Field(description="as the frames shall call it")
    rom: str = Field(min_length=1, description="its definition file (.rom), relative to the cell file")


class NdiConfig(Model):
    """A camera that speaks the NDI Combined API."""

    port: str = Field(min_length=1, description="any pyserial URL")
    baud: Literal[9600, 14400, 19200, 38400, 57600, 115200, 230400, 921600] = Field(
        default=115200, description="line speed that device and host go over to, bit/s"
    )
    rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] = Field(
        default=60.0, description="exposures a second: how fast the frames count up"
    )
    station_pose: PoseVector = Field(
        default=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), description="approximate place of the camera in W, mm and deg"
    )
    strays: bool = Field(default=True, description="report markers that belong to no tool")
    tools: tuple[NdiToolConfig, ...] = Field(default=(), description="tools whose definition is loaded")


class InertialConfig(Model):
    """An inertial sensor that speaks the VectorNav ASCII protocol."""

    port: str = Field(min_length=1, description="any pyserial URL")
    baud: Literal[9600, 19200, 38400, 57600, 115200, 128000, 230400, 460800, 921600] = Field(
        default=115200, description="line speed, as the sensor is set, bit/s"
    )
    message: Literal["VNYMR", "VNIMU"] = Field(
        default="VNYMR",
        description="VNYMR: attitude and compensated measurements; VNIMU: calibrated measurements without filter",
    )
    rate_hz: Literal[1, 2, 4, 5, 10, 20, 25, 40, 50, 100, 200] = Field(default=50, description="samples a second")
    mount_pose: PoseVector = Field(
        default=(0.0, 0.0, 0.0, 180.0, 0.0, 0.0),
        description="pose of the sensor's own axes in the component frame, mm and deg; as it is: z down, at its origin",
    )

    @model_validator(mode="after")
    def _fits_the_line(self) -> Self:
        """A sample is a line of text: the line has to carry them all."""
        most_hz = 0.95 * self.baud / (10.0 * INERTIAL_LINE_BYTES[self.message])
        if not self.rate_hz <= most_hz:
            raise ValueError(f"{self.baud} bit/s carry no more than {most_hz:.0f} {self.message} a second")
        return self
