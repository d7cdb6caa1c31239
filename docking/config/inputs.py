"""The inputs of a cell: modules on its wires, and what each of their channels means."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from docking.config.base import Finite, Model, Name, NonNegative, Positive

Use = Literal["permissive", "emergency-stop", "protective-stop", "enabling-device", "limit-switch", "brake-closed"]
AxisName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_\-]{0,31}\.[XYZ]$")]
Channel = Annotated[int, Field(ge=0, le=255)]


class CanModule(Model):
    """A CANopen I/O module (CiA 401) on the positioners' bus."""

    kind: Literal["cia401"] = Field(description="CANopen I/O module on the positioners' bus")
    name: Name = Field(description="of the module")
    node: Annotated[int, Field(ge=1, le=127)] = Field(description="CANopen node id")
    refresh_s: Annotated[float, Field(ge=0.01, le=1.0)] = Field(
        default=0.05, description="the module repeats its inputs so often, and at every change, s"
    )
    can_channel: str | None = Field(
        default=None, description="its CAN bus: bus.channel or one of bus.further_channels; the first when left out"
    )
    map: str = Field(default="cia401", description="object map in drivers/maps")


class ModbusModule(Model):
    """Discrete inputs and input registers behind a Modbus TCP address."""

    kind: Literal["modbus-io"] = Field(description="Modbus TCP I/O module")
    name: Name = Field(description="of the module; not that of a positioner")
    host: str = Field(description="Modbus TCP address")
    port: Annotated[int, Field(ge=1, le=65535)] = Field(default=502, description="Modbus TCP port")
    unit: Annotated[int, Field(ge=1, le=247)] = Field(default=1, description="Modbus unit id")
    poll_s: Annotated[float, Field(ge=0.01, le=1.0)] = Field(default=0.05, description="period of the polls, s")
    timeout_s: Annotated[float, Field(ge=0.01, le=2.0)] = Field(
        default=0.05, description="longest time one reply may take, s"
    )
    map: str = Field(default="modbus_io", description="register map in drivers/maps")


class DigitalInput(Model):
    """One contact. A module that is silent gives nothing, whatever the level."""

    name: Name = Field(description="of the condition; for a permissive, its name in permissives")
    use: Use = Field(default="permissive", description="what the contact means")
    module: Name = Field(description="name of the module")
    channel: Channel = Field(description="number of the input, from 0")
    on: Literal["high", "low"] = Field(
        default="high", description="level at which it is given, pressed, asked for or closed"
    )
    debounce_s: Annotated[float, Field(ge=0.0, le=1.0)] = Field(
        default=0.02, description="a level counts once it has lasted so long, s"
    )
    axis: AxisName | None = Field(default=None, description="whose limit switch or brake it is")


class TemperatureInput(Model):
    """One temperature sensor."""

    name: Name = Field(description="of the sensor")
    of: Literal["component", "mate", "floor"] = Field(description="what it is fixed to")
    module: Name = Field(description="name of the module")
    channel: Channel = Field(description="number of the analogue input, from 0")
    celsius_per_count: Positive = Field(default=0.1, description="scale of the input, deg C a count")
    offset_c: Finite = Field(default=0.0, description="deg C at 0 counts")
    sigma_k: Positive = Field(default=0.2, description="of the sensor and of its place, 1 sigma, K")
    missing_sigma_k: NonNegative = Field(
        default=1.0, description="added (root of the squares) to the job's temperature_sigma_k where it says nothing, K"
    )


class ForceInput(Model):
    """A three-component load cell with transmitters of 4 to 20 mA; 12 mA is no force, 20 mA the whole range."""

    name: Name = Field(description="of the load cell")
    positioner: Name = Field(description="under whose ball it sits; its load_cell = true, load_cells has its range")
    module: Name = Field(description="name of the module, which has nothing but load cells")
    channels: tuple[Channel, Channel, Channel] = Field(description="analogue inputs of X, Y and Z, from 0")
    counts: tuple[int, int] = Field(default=(5530, 27648), description="counts of the inputs at 4 mA and at 20 mA")

    @model_validator(mode="after")
    def _some_span(self) -> Self:
        if not self.counts[1] - self.counts[0] >= 16:
            raise ValueError("counts at 20 mA must be above those at 4 mA")
        return self


Module = Annotated[CanModule | ModbusModule, Field(discriminator="kind")]


class InputsConfig(Model):
    """Wired inputs; permissives that are not wired are declared by the operator."""

    modules: tuple[Module, ...] = Field(min_length=1, description="what the inputs are wired to")
    digital: tuple[DigitalInput, ...] = Field(default=(), description="contacts")
    temperatures: tuple[TemperatureInput, ...] = Field(default=(), description="temperature sensors")

    forces: tuple[ForceInput, ...] = Field(default=(), description="load cells")

    @property
    def weighing(self) -> frozenset[str]:
        """Names of the modules that load cells are wired to."""
        return frozenset(force.module for force in self.forces)

    def names(self, *uses: Use) -> tuple[str, ...]:
        """Names of the contacts with one of these uses."""
        return tuple(item.name for item in self.digital if item.use in uses)
