"""What the simulated I/O modules are wired to: contacts that scenarios move, sensors on the plant."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Protocol

import numpy as np

from docking.config import CellFile
from docking.config.inputs import DigitalInput, ForceInput, TemperatureInput
from docking.types import Array

GIVEN = ("permissive", "enabling-device")
"""Uses whose condition holds in a cell that is ready; all others are a person, a switch or a brake that speaks up."""
BROKEN = -0x8000
SEED_OF_SENSORS = 401


class WarmPlant(Protocol):
    """What the sensors measure."""

    def temperatures_c(self, t_s: float) -> dict[str, float]:
        """deg C of component, mate and floor."""
        ...

    def force_n(self) -> Array:
        """Readings of the load cells along all axes (m,), N."""
        ...


class InputWorld:
    """Conditions by name, sensors by name. `listeners` are called at every change of a contact.

    Faults: a module that is silent, a sensor that is broken or reads wrongly.
    """

    def __init__(self, cell: CellFile, plant: WarmPlant, loop: asyncio.AbstractEventLoop, seed: int) -> None:
        self._contacts: tuple[DigitalInput, ...] = cell.inputs.digital if cell.inputs is not None else ()
        self._sensors: tuple[TemperatureInput, ...] = cell.inputs.temperatures if cell.inputs is not None else ()
        self._forces: tuple[ForceInput, ...] = cell.inputs.forces if cell.inputs is not None else ()
        self._ranges = cell.load_cells.range_n if cell.load_cells is not None else (1.0, 1.0, 1.0)
        self._stations = [p.name for p in cell.positioners]
        self._plant, self._loop = plant, loop
        self.listeners: list[Callable[[], None]] = []
        self.holds = {item.name: item.use in GIVEN for item in self._contacts}
        self.silent: set[str] = set()
        self.broken: set[str] = set()
        self.wrong_k: dict[str, float] = {}
        self.stray_ma: dict[str, float] = {}
        rng = np.random.default_rng([seed, SEED_OF_SENSORS])
        drawn = rng.standard_normal(len(self._sensors)).tolist()
        self._error_k = {s.name: s.sigma_k * e for s, e in zip(self._sensors, drawn, strict=True)}

    # what happens in the cell ------------------------------------------------------------------------------------
    def hold(self, name: str, holds: bool) -> None:
        """A condition is given, pressed or closed, or is not any more. Raises KeyError for another name."""
        if self.holds[name] is not holds:
            self.holds[name] = holds
            self.tell()

    def mute(self, module: str, muted: bool = True) -> None:
        """A module sends nothing any more."""
        (self.silent.add if muted else self.silent.discard)(module)

    def break_sensor(self, name: str, broken: bool = True) -> None:
        """A sensor's wire breaks."""
        (self.broken.add if broken else self.broken.discard)(name)

    def misread(self, name: str, by_k: float) -> None:
        """A sensor reads so much more than it has."""
        self.wrong_k[name] = by_k

    def force_current(self, name: str, ma: float) -> None:
        """The transmitters of a load cell drive this current, whatever the load."""
        self.stray_ma[name] = ma

    def free_current(self, name: str) -> None:
        """They follow the load again."""
        self.stray_ma.pop(name, None)

    def tell(self) -> None:
        for listener in self.listeners:
            listener()

    # what the modules see ----------------------------------------------------------------------------------------
    def contacts(self, module: str, count: int) -> bytes:
        """Levels of the first `count` digital inputs of a module, eight a byte, the first in the lowest bit."""
        levels = 0
        for item in self._contacts:
            if item.module == module and self._level(item):
                levels |= 1 << item.channel
        return (levels & (1 << count) - 1).to_bytes((count + 7) // 8, "little")

    def _level(self, item: DigitalInput) -> bool:
        return self.holds[item.name] is (item.on == "high")

    def counts(self, module: str, count: int) -> tuple[int, ...]:
        """Counts of the first `count` analogue inputs of a module; nothing is connected where no sensor is."""
        result = [BROKEN] * count
        truth = self._plant.temperatures_c(self._loop.time())
        for sensor in self._sensors:
            if sensor.module == module and sensor.channel < count and sensor.name not in self.broken:
                result[sensor.channel] = self._read(sensor, truth[sensor.of])
        for force in self._forces:
            if force.module == module:
                for channel, value in zip(force.channels, self._weigh(force), strict=True):
                    if channel < count:
                        result[channel] = value
        return tuple(result)

    def _weigh(self, force: ForceInput) -> tuple[int, ...]:
        """Counts of the three currents: 12 mA and 8 mA for the whole range, kept by the transmitter between 3.8 and
        20.5 mA; a torn wire carries none."""
        first = 3 * self._stations.index(force.positioner)
        loads = self._plant.force_n()[first : first + 3].tolist()
        low, high = force.counts
        counts = []
        for load_n, range_n in zip(loads, self._ranges, strict=True):
            ma = min(max(12.0 + 8.0 * load_n / range_n, 3.8), 20.5)
            ma = 0.0 if force.name in self.broken else self.stray_ma.get(force.name, ma)
            counts.append(min(max(round(low + (high - low) * (ma - 4.0) / 16.0), BROKEN + 1), -BROKEN - 1))
        return tuple(counts)

    def _read(self, sensor: TemperatureInput, true_c: float) -> int:
        shown_c = true_c + self._error_k[sensor.name] + self.wrong_k.get(sensor.name, 0.0)
        counts: int = round((shown_c - sensor.offset_c) / sensor.celsius_per_count)
        return counts
