"""The reference cells as the plant's tests use them."""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import sim
from docking.config import CellFile, JobFile
from docking.types import Array
from sim.plant import Plant
from sim.truth import TruthFile, load_truth

CELLS = Path(sim.__file__).parent / "cells"


def _text(path: Path) -> str:
    return json.dumps(tomllib.loads(path.read_text("utf-8")))


@dataclass(frozen=True)
class Site:
    """One reference cell with its job and truth."""

    cell: CellFile
    job: JobFile
    truth: TruthFile

    def plant(self, truth: TruthFile | None = None, seed: int = 1) -> Plant:
        return Plant(self.cell, self.job, truth or self.truth, seed)


class Driver:
    """Feeds a plant with set-points at 100 Hz, all axes powered unless told otherwise."""

    def __init__(self, plant: Plant, t_s: float = 0.0) -> None:
        self.plant, self.t_s = plant, t_s
        count = len(plant.axes)
        self.powered, self.braked = np.ones(count, dtype=bool), np.zeros(count, dtype=bool)
        self.target: Array = plant.encoder_mm().copy()
        plant.step(t_s, self.target, self.powered, self.braked)
        self.wait(0.05)

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.01)):
            self.t_s += 0.01
            self.plant.step(self.t_s, self.target, self.powered, self.braked)

    def move(self, delta_mm: Array, seconds: float = 2.0, rest_s: float = 0.2) -> None:
        """A smooth move by `delta_mm` (m,), then rest."""
        start = self.target
        steps = round(seconds / 0.01)
        for i in range(1, steps + 1):
            u = i / steps
            self.target = start + delta_mm * (10 * u**3 - 15 * u**4 + 6 * u**5)
            self.t_s += 0.01
            self.plant.step(self.t_s, self.target, self.powered, self.braked)
        self.wait(rest_s)


@pytest.fixture(scope="session")
def site():
    """site(name) -> Site."""

    def load(name: str) -> Site:
        cell = CellFile.model_validate_json(_text(CELLS / f"{name}.toml"))
        job = JobFile.model_validate_json(_text(CELLS / f"{name}.job.toml"))
        return Site(cell, job, load_truth(CELLS / f"{name}.sim.toml"))

    return load


@pytest.fixture
def driver():
    return Driver
