"""What the load cells read at standstill, averaged."""

from __future__ import annotations

import asyncio

import numpy as np

from docking.motion.settle import SettleSettings, settle
from docking.planning.relief import Weighing
from docking.ports import Motion
from docking.types import readonly

READINGS = 20
PAUSE_S = 0.05
"""Load cells report at 50 Hz or slower: each reading is a fresh one."""


async def weigh(motion: Motion, settings: SettleSettings) -> Weighing:
    """Wait for standstill, then average `READINGS` read-backs. Raises NotSettled, and what the motion side holds.

    The standard error assumes readings that err independently of each other, which is true of noise and not of drift.
    """
    await settle(motion, settings)
    forces, positions = [], []
    for _ in range(READINGS):
        await asyncio.sleep(PAUSE_S)
        feedback = motion.feedback()
        forces.append(feedback.force_n)
        positions.append(feedback.position_mm)
    spread = np.std(forces, axis=0, ddof=1) / np.sqrt(READINGS)
    return Weighing(readonly(np.mean(positions, axis=0)), readonly(np.mean(forces, axis=0)), readonly(spread))
