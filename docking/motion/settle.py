"""Wait until the component stands still: consecutive stationary readings, then one more second."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

import numpy as np

from docking.errors import NotSettled
from docking.ports import Motion


@dataclass(frozen=True)
class SettleSettings:
    """`readings` consecutive readings within `tolerance_mm`, spread over `window_s`, before `timeout_s`."""

    window_s: float
    readings: int
    tolerance_mm: float
    timeout_s: float


async def settle(motion: Motion, settings: SettleSettings) -> float:
    """Return the loop time at which the axes were at rest; raises NotSettled naming the axis that is not.

    Only a read-back that is newer than the one before says anything: the same one twice is no standstill.
    """
    loop = asyncio.get_running_loop()
    end_s = loop.time() + settings.timeout_s
    pause_s = settings.window_s / settings.readings
    still, moved = 0, np.zeros(len(motion.axes))
    before = motion.feedback()
    while still < settings.readings:
        await asyncio.sleep(pause_s)
        now = motion.feedback()
        if now.t_s > before.t_s:
            moved = np.abs(now.position_mm - before.position_mm)
            still = still + 1 if np.max(moved) <= settings.tolerance_mm else 0
            before = now
        if loop.time() > end_s:
            axis = motion.axes[int(np.argmax(moved))]
            raise NotSettled(axis, value=float(np.max(moved)), limit=settings.tolerance_mm)
    await asyncio.sleep(1.0 if settings.window_s >= 1.0 else settings.window_s)
    return loop.time()
