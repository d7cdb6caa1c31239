"""How the simulated drives behave where makers differ."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

SyncLoss = Literal["hold", "ignore", "extrapolate", "quick-stop", "fault"]


@dataclass(frozen=True)
class DriveSettings:
    """Brake times and the reaction to a SYNC missing for `sync_loss_cycles`.

    `hold` and `ignore`: stand at the last target; `extrapolate`: go on at the last speed until something else stops
    the drive; `quick-stop` and `fault`: ramp down, with emergency 8700h. `shared_cpu`: the process that simulates the
    drives may be kept from the CPU, which real drives are not: SYNCs count as evenly spaced then. `watchdog_scatter_s`:
    every drive's clock for the controller's heartbeat (1016h) is fast or slow by at most this, node by node.
    """

    brake_open_s: float = 0.08
    brake_close_s: float = 0.06
    sync_loss: SyncLoss = "hold"
    sync_loss_cycles: float = 3.0
    shared_cpu: bool = False
    watchdog_scatter_s: float = 0.0
    vendor: int = 0x0000_05D0
    product: int = 0x0402_0008
    revision: int = 0x0001_0003
    supported_modes: int = 1 << 5 | 1 << 7 | 1 << 9
    """6502h: bit n - 1 is mode n. The drives know 6 (homing), 7 (interpolated), 8 (cyclic position) and 10 (cyclic
    torque)."""
    homed: bool = True
    """Whether the drives know their zero when they are switched on, as those with absolute encoders do."""
    zero_off_mm: float = 0.0
    """By how much they count wrong until they are homed."""
    first_serial: int = 402_000
    """Serial number of node n is `first_serial` + n."""

    def watchdog_offset_s(self, node: int) -> float:
        """What node `node` adds to the time of 1016h, the same in every run."""
        spread: float = np.random.default_rng([node, self.first_serial]).uniform(-1.0, 1.0)
        return self.watchdog_scatter_s * spread
