"""A record of where the simulated axes were commanded and where they stood, for whoever judges a controller.

CSV, one row every 10 ms: `t_s` time of the loop, `heard_s` when the controller's heartbeat was heard last, and for each
axis `AXIS.commanded_mm` (the set-point inside the drive, its own ramps included) and `AXIS.actual_mm` (motor encoder).
An axis that is not under servo control is commanded to where it stands.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from docking.types import Array

PERIOD_S = 0.01


class Recorded(Protocol):
    """What is recorded: the plant."""

    axes: tuple[str, ...]

    def encoder_mm(self) -> Array: ...

    def following_error_mm(self) -> Array: ...


class AxisTrace:
    """Writes until it is closed; `heard_s` gives the time of the controller's last heartbeat, NaN before the first."""

    def __init__(
        self, path: Path, plant: Recorded, heard_s: Callable[[], float], loop: asyncio.AbstractEventLoop
    ) -> None:
        """Raises OSError where the file cannot be written."""
        self._plant, self._heard_s, self._loop = plant, heard_s, loop
        self._file = path.open("w", encoding="utf-8")
        names = [f"{axis}.{what}_mm" for axis in plant.axes for what in ("commanded", "actual")]
        self._file.write(",".join(["t_s", "heard_s", *names]) + "\n")
        self._due_s = loop.time()
        self._timer: asyncio.TimerHandle | None = None
        self._row()

    def _row(self) -> None:
        now_s = self._loop.time()
        actual = self._plant.encoder_mm()
        commanded = actual + self._plant.following_error_mm()
        pairs = ",".join([f"{c:.6f},{a:.6f}" for c, a in zip(commanded.tolist(), actual.tolist(), strict=True)])
        self._file.write(f"{now_s:.6f},{self._heard_s():.6f},{pairs}\n")
        # A late row is followed by the next one on the grid.
        self._due_s = max(self._due_s + PERIOD_S, now_s)
        self._timer = self._loop.call_at(self._due_s, self._row)

    def close(self) -> None:
        """Write what is left."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
            self._file.close()
