"""Load cells in the positioners: cross-talk, zero drift, noise."""

from __future__ import annotations

import numpy as np

from docking.config import CellFile
from docking.types import Array
from sim.truth import Draws, TruthFile

_HOUR_S = 3600.0


class LoadCells:
    """Turns true axis forces into readings; axes without a cell read NaN. `offset_n` (m,) is what a fault adds."""

    def __init__(self, cell: CellFile, truth: TruthFile, draws: Draws) -> None:
        count = len(cell.positioners)
        fitted = [p.load_cell and cell.load_cells is not None for p in cell.positioners]
        ranges = cell.load_cells.range_n if cell.load_cells is not None else (1.0, 1.0, 1.0)
        self._mask: Array = np.repeat(np.where(fitted, 0.0, np.nan), 3)
        self._range_n = np.tile(np.array(ranges), count)
        cross = truth.load_cell_crosstalk.fraction * draws.normal("load_cell_crosstalk", (count, 3, 3))
        cross[:, np.arange(3), np.arange(3)] = 0.0
        self._gain: Array = np.eye(3) + cross
        self._drift_n_s = (
            truth.load_cell_drift.fraction * draws.uniform("load_cell_drift", (3 * count,)) * self._range_n / _HOUR_S
        )
        self.offset_n: Array = np.zeros(3 * count)
        self._noise_n = truth.load_cell_noise.fraction * self._range_n
        self._draws = draws

    def read_n(self, force_n: Array, elapsed_s: float) -> Array:
        """(m,) readings for the true axis forces (m,)."""
        mixed = np.einsum("kij,kj->ki", self._gain, force_n.reshape(-1, 3)).ravel()
        noise = self._noise_n * self._draws.normal("load_cell_noise", (len(force_n),))
        reading: Array = mixed + self._drift_n_s * elapsed_s + noise + self._mask + self.offset_n
        return reading
