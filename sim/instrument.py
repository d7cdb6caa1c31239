"""The optics of the simulated tracker: the true reflectors seen through the true station pose, with all errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from docking.config import CellFile
from docking.config.cell import Noise
from docking.types import Array
from sim.plant import Plant
from sim.shapes import pose_of
from sim.supports import gravity_unit
from sim.surroundings import StationMotion
from sim.truth import Draws, TruthFile

CLASS_NOISE: dict[str, Noise] = {
    # Half of the MPE of a laser tracker: ADM 10 um + 0.3 um/m, transverse 15 um + 6 um/m.
    "laser-tracker": Noise(range_um=5.0, range_um_per_m=0.15, transverse_um=7.5, transverse_um_per_m=3.0),
    # Total station: 0.6 mm + 1 ppm along the line, 1 arcsec (4.85 urad) across it.
    "total-station": Noise(range_um=600.0, range_um_per_m=1.0, transverse_um=1.0, transverse_um_per_m=4.85),
}

_BENDING_PER_K = 0.93e-6
"""Change of the refractive index of air with temperature, 1/K at 20 C."""


@dataclass(frozen=True, eq=False)
class Shot:
    """One measurement: centre `p_T_mm` (3,) in the station frame T, `sigma_mm` (3,) of x, y, z as the device states it.

    `name` is the reflector asked for (by name) or found (by direction). Zeros when `status` is "no-target".
    """

    status: Literal["ok", "no-target", "inaccurate"]
    name: str
    p_T_mm: Array
    sigma_mm: Array


class Instrument:
    """A laser tracker or total station at the cell's station pose plus an unknown offset."""

    def __init__(self, plant: Plant, cell: CellFile, truth: TruthFile, seed: int) -> None:
        draws = Draws(truth, seed)
        self.measure_s: float = truth.instrument.measure_s
        self.station = StationMotion(pose_of(cell.tracker.station_pose), truth, draws)
        self.noise = cell.tracker.noise or CLASS_NOISE[cell.tracker.device_class]
        self._plant, self._draws = plant, draws
        self._up: Array = -gravity_unit(cell)
        self._cone_cos = float(np.cos(np.deg2rad(truth.instrument.search_cone_deg)))
        names = plant.target_names()
        self._index = {name: i for i, name in enumerate(names) if name not in plant.absent}
        self._seating_mm = draws.span("seating", truth.seating.sigma_um, (len(names),)) * 1e-3
        self._gross, self._fast = truth.gross_errors, truth.fast_outliers
        self._unseated: Array = self._draw_unseated(len(names))
        sign = draws.generator("refraction").choice((-1.0, 1.0))
        self._bend_per_mm = float(sign) * 0.5e-3 * _BENDING_PER_K * truth.refraction.k_per_m * draws.scale("refraction")
        self._zero_mm = truth.range_zero.um * 1e-3 * float(draws.normal("range_zero", (1,))[0])
        self._collimation_rad = truth.collimation.urad * 1e-6 * float(draws.normal("collimation", (1,))[0])

    def shoot(self, name: str, t_s: float, face: int = 1) -> Shot:
        """Measure the reflector `name` at loop time `t_s` with face 1 or 2."""
        luck = self._draws.generator("gross_errors").uniform(size=4)
        seat = self._draws.generator("seating").standard_normal(3)
        noise = self._draws.normal("instrument_noise", (3,))
        outlier_mm = self._draw_outlier()
        chance = self._draws.scale("gross_errors")
        index = self._index.get(name)
        if index is None or luck[0] < chance * self._gross.lost_beam:
            return Shot("no-target", name, np.zeros(3), np.zeros(3))
        seen_W = self._plant.targets_W_mm(t_s)
        station = self.station.pose(self._plant.elapsed_s(t_s))
        if luck[1] < chance * self._gross.wrong_nest:
            index = _neighbour(seen_W - station.t_mm, index, float(luck[2]))
        p_W = seen_W[index] + self._unseated[index] + self._seating_mm[index] * seat
        p_W = p_W + self._bend_per_mm * float(np.sum((p_W - station.t_mm) ** 2)) * self._up
        inaccurate = bool(luck[3] < chance * self._gross.inaccurate)
        p_T = station.inverse().apply(p_W)
        measured = self._read(p_T, noise * (self._gross.inaccurate_factor if inaccurate else 1.0), outlier_mm, face)
        return Shot("inaccurate" if inaccurate else "ok", name, measured, self._stated_sigma_mm(measured))

    def shoot_towards(self, direction_T: Array, t_s: float, face: int = 1) -> Shot:
        """Measure the reflector nearest to the aim `direction_T` (3,) inside the search cone."""
        station = self.station.pose(self._plant.elapsed_s(t_s))
        seen_T = station.inverse().apply(self._plant.targets_W_mm(t_s))
        aim = np.asarray(direction_T) / np.linalg.norm(direction_T)
        cosines = seen_T @ aim / np.linalg.norm(seen_T, axis=1)
        best = int(np.argmax(cosines))
        if not cosines[best] >= self._cone_cos:
            return Shot("no-target", "", np.zeros(3), np.zeros(3))
        return self.shoot(self._plant.target_names()[best], t_s, face)

    def _read(self, p_T: Array, noise: Array, outlier_mm: Array, face: int) -> Array:
        """The coordinates the device finds for the true direction and distance of `p_T`."""
        distance = float(np.linalg.norm(p_T))
        line = p_T / distance
        level = np.cross((0.0, 0.0, 1.0), line)
        level = level / np.linalg.norm(level)
        axes = np.column_stack((line, level, np.cross(line, level)))
        range_sigma, across_sigma = self._sigmas_mm(distance)
        local: Array = np.array((range_sigma, across_sigma, across_sigma)) * noise + outlier_mm
        local[0] += self._zero_mm
        local[1] += (1.0 if face == 1 else -1.0) * self._collimation_rad * distance
        measured: Array = p_T + axes @ local
        return measured

    def _sigmas_mm(self, distance_mm: float) -> tuple[float, float]:
        """Standard deviations along and across the line of sight."""
        metres = distance_mm * 1e-3
        along = self.noise.range_um + self.noise.range_um_per_m * metres
        across = self.noise.transverse_um + self.noise.transverse_um_per_m * metres
        return along * 1e-3, across * 1e-3

    def _stated_sigma_mm(self, p_T: Array) -> Array:
        distance = float(np.linalg.norm(p_T))
        along, across = self._sigmas_mm(distance)
        share = (p_T / distance) ** 2
        sigma: Array = np.sqrt(share * along**2 + (1.0 - share) * across**2)
        return sigma

    def _draw_unseated(self, count: int) -> Array:
        """(n, 3) offsets of reflectors that sit badly in their nests for the whole run; zero for nearly all."""
        generator = self._draws.generator("gross_errors")
        chance = generator.uniform(size=count) < self._draws.scale("gross_errors") * self._gross.unseated
        directions = generator.standard_normal((count, 3))
        sizes = generator.uniform(*self._gross.unseated_mm, size=count)
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        offsets: Array = np.where(chance, sizes, 0.0)[:, None] * unit
        return offsets

    def _draw_outlier(self) -> Array:
        """(3,) along, level, upright: rare, across the line of sight, only of readings taken in a hurry."""
        generator = self._draws.generator("fast_outliers")
        chance, turn, size = generator.uniform(size=3)
        if not (self.measure_s < self._fast.below_s and chance < self._fast.probability):
            return np.zeros(3)
        low, high = self._fast.um
        length = self._draws.scale("fast_outliers") * (low + (high - low) * float(size)) * 1e-3
        angle = 2.0 * np.pi * float(turn)
        return np.array((0.0, length * np.cos(angle), length * np.sin(angle)))


def _neighbour(sight: Array, index: int, luck: float) -> int:
    """One of the three reflectors that look nearest to reflector `index`; sight (n, 3) from the station."""
    unit = sight / np.linalg.norm(sight, axis=1, keepdims=True)
    near = np.argsort(-(unit @ unit[index]))
    others = [int(i) for i in near if int(i) != index][:3]
    return others[min(int(luck * len(others)), len(others) - 1)]
