"""What a simulated tracker asks of the optics behind it; `sim.instrument.Instrument` provides it."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Shot(Protocol):
    """One attempt to measure: `status` is "ok", "no-target" or "inaccurate"; lengths mm, station frame."""

    @property
    def status(self) -> str: ...

    @property
    def name(self) -> str: ...

    @property
    def p_T_mm(self) -> Array: ...

    @property
    def sigma_mm(self) -> Array: ...


class Optics(Protocol):
    """The instrument without its electronics; `measure_s` is the time that one point takes."""

    @property
    def measure_s(self) -> float: ...

    def shoot(self, name: str, t_s: float, face: int = 1) -> Shot: ...

    def shoot_towards(self, direction_T: Array, t_s: float, face: int = 1) -> Shot: ...
