"""Settings of single instruments in the CELL file. Lengths mm, times s, angles deg."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from docking.config.base import Finite, Model


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
