"""Optics without a plant: named reflectors at known places, an optional seeded noise, settable statuses."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

POINTS = {"N1": (4123.456, -876.05, 250.0), "N2": (-3000.0, 5200.25, -410.5), "N3": (10.0, 9000.0, 0.125)}


@dataclass(frozen=True)
class FakeShot:
    status: str
    name: str
    p_T_mm: Array
    sigma_mm: Array


@dataclass
class FakeOptics:
    measure_s: float = 2.0
    noise_mm: float = 0.02
    status: dict[str, str] = field(default_factory=dict)
    points: dict[str, tuple[float, float, float]] = field(default_factory=lambda: dict(POINTS))
    shots: list[tuple[str, float, int]] = field(default_factory=list)
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(7))

    def shoot(self, name: str, t_s: float, face: int = 1) -> FakeShot:
        self.shots.append((name, t_s, face))
        sigma = np.full(3, max(self.noise_mm, 0.001))
        if name not in self.points:
            return FakeShot("no-target", name, np.zeros(3), sigma)
        p = np.array(self.points[name]) + self.noise_mm * self.rng.standard_normal(3)
        return FakeShot(self.status.get(name, "ok"), name, p, sigma)

    def shoot_towards(self, direction_T: Array, t_s: float, face: int = 1) -> FakeShot:
        def off_rad(name: str) -> float:
            p = np.array(self.points[name])
            return float(np.arccos(np.clip(p @ direction_T / np.linalg.norm(p), -1.0, 1.0)))

        nearest = min(self.points, key=off_rad)
        if off_rad(nearest) > 0.02:
            return FakeShot("no-target", "", np.zeros(3), np.zeros(3))
        return self.shoot(nearest, t_s, face)
