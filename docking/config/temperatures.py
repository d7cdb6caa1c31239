"""What temperature sensors make of a job: a present one narrows what the job states, a missing one widens it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from docking.config.cell import CellFile
from docking.config.job import Component, JobFile, Mate


@dataclass(frozen=True)
class PartTemperature:
    """Of `part`: what the job states, what the sensor reads (NaN: nothing), what counts from now on; deg C and K."""

    part: str
    stated_c: float
    stated_sigma_k: float
    read_c: float
    used_c: float
    used_sigma_k: float


def part_temperatures(cell: CellFile, job: JobFile, read_c: dict[str, float]) -> tuple[PartTemperature, ...]:
    """For component, mate and floor where the cell has a sensor there; `read_c` by the sensors' names.

    Stated value and reading are independent: they are combined by their weights 1/sigma^2. Where the sensor says
    nothing, its `missing_sigma_k` is added to the stated sigma (root of the squares).
    """
    sensors = cell.inputs.temperatures if cell.inputs is not None else ()
    parts: dict[str, Component | Mate] = {"component": job.component, "mate": job.mate}
    found = []
    for sensor in sensors:
        value_c = read_c.get(sensor.name, float("nan"))
        part = parts.get(sensor.of)
        if part is None:
            # Nothing of the floor is fitted: its temperature is only told.
            found.append(PartTemperature(sensor.of, cell.temperature_c, 0.0, value_c, cell.temperature_c, 0.0))
            continue
        stated_c, sigma_k = part.temperature_c, part.temperature_sigma_k
        if math.isfinite(value_c):
            used_c, used_k = _combined(stated_c, sigma_k, value_c, sensor.sigma_k)
        else:
            used_c, used_k = stated_c, math.hypot(sigma_k, sensor.missing_sigma_k)
        found.append(PartTemperature(sensor.of, stated_c, sigma_k, value_c, used_c, used_k))
    return tuple(found)


def with_temperatures(job: JobFile, found: tuple[PartTemperature, ...]) -> JobFile:
    """The job with these temperatures and sigmas in place of those it states."""
    for one in (one for one in found if one.part != "floor"):
        part = getattr(job, one.part)
        changed = {"temperature_c": one.used_c, "temperature_sigma_k": one.used_sigma_k}
        job = job.model_copy(update={one.part: part.model_copy(update=changed)})
    return job


def _combined(stated_c: float, stated_k: float, read_c: float, read_k: float) -> tuple[float, float]:
    """Weighted mean and its sigma; a stated sigma of 0 leaves nothing to learn."""
    if stated_k == 0.0:
        return stated_c, 0.0
    weights = 1.0 / stated_k**2, 1.0 / read_k**2
    total = sum(weights)
    return (weights[0] * stated_c + weights[1] * read_c) / total, math.sqrt(1.0 / total)
