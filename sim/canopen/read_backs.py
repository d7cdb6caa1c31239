"""What the simulated drives of one bus report at a SYNC: read-backs and load cells, as frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from docking.types import Array
from sim.canopen.plant_axes import NEWTON_PER_COUNT
from sim.wires.can_frames import CanFrame

_TPDO: Final = np.dtype([("statusword", "<u2"), ("position", "<i4"), ("error", "<i2")])
BROKEN: Final = -32768
"""What a broken load cell shows."""


class ReadBacks:
    """m axes; `shown_mm` makes reported positions (m,) of the encoders' ones."""

    def __init__(self, count: int, counts_per_mm: float, shown_mm: Callable[[Array], Array]) -> None:
        self._table = np.zeros(count, _TPDO)
        self._encoder: Array | None = None
        self._counts_per_mm, self._shown_mm = counts_per_mm, shown_mm

    def forget(self) -> None:
        """What is shown has changed although nothing has moved."""
        self._encoder = None

    def frames(
        self,
        reporting: Sequence[tuple[int, int]],
        encoder_mm: Array,
        error_mm: Array,
        statuswords: NDArray[np.uint16],
    ) -> list[CanFrame]:
        """One frame for each (COB-ID, row) of `reporting`; `encoder_mm` is the same array until something moves."""
        if encoder_mm is not self._encoder:
            self._table["position"] = np.rint(self._shown_mm(encoder_mm) * self._counts_per_mm)
            self._encoder = encoder_mm
        # The low 16 bits of the 32-bit following error: larger errors wrap, as on a real drive.
        self._table["error"] = np.rint(error_mm * self._counts_per_mm).astype(np.int64)
        self._table["statusword"] = statuswords
        raw = self._table.tobytes()
        return [(cob, raw[8 * i : 8 * i + 8]) for cob, i in reporting]


def force_frames(cobs: Sequence[int], force_n: Array) -> list[CanFrame]:
    """Load cells: one frame for each of `cobs`, forces (n,) in their order."""
    counts = np.rint(force_n / NEWTON_PER_COUNT)
    counts[np.isnan(counts)] = BROKEN
    raw = np.maximum(np.minimum(counts, 32767.0), BROKEN).astype("<i2").tobytes()
    return [(cob, raw[2 * i : 2 * i + 2]) for i, cob in enumerate(cobs)]
