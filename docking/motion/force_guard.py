"""A move that ends as soon as a ball's force rises: the part, or what it meets, gives way before the axes do."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

import numpy as np

from docking.errors import DockingError, ForceRose
from docking.kinematics import Positioners
from docking.ports import Motion
from docking.types import Array, MoveResult

READINGS, PAUSE_S = 2, 0.02
"""Readings that the guard averages, as often as load cells report."""


@dataclass(frozen=True, eq=False)
class ForceGuard:
    """`before_n` (k,) size of the force at each ball before the move, `limit_n` (k,) how far each may rise over it.

    Where `zero_n` (m,) is given, forces along the axes count from there on.
    """

    positioners: Positioners
    before_n: Array
    limit_n: Array
    zero_n: Array | None = None

    @classmethod
    def of_change(cls, positioners: Positioners, force_n: Array, limit_n: float) -> ForceGuard:
        """What pushes or pulls from any side counts: the change of each ball's force against axis forces (m,) read at
        rest."""
        balls = len(positioners.names)
        return cls(positioners, np.zeros(balls), np.full(balls, limit_n), force_n)

    def check(self, force_n: Array) -> None:
        """Raise ForceRose for ball forces (k,) that rose too far, or are no numbers."""
        rise = force_n - self.before_n
        over = ~(rise <= self.limit_n)
        if over.any():
            i = int(np.argmax(over))
            where = f"ball {self.positioners.names[i]}"
            raise ForceRose(where, value=float(rise[i]), limit=float(self.limit_n[i]))

    async def run(self, motion: Motion, plan_hash: str) -> tuple[MoveResult, Exception | None]:
        """Run the loaded plan; on its way it is stopped on the path when a ball's force rises too far or is not known.

        Returns how it ended and why it must not go on: what the motion side says, else ForceRose.
        """
        watching = asyncio.ensure_future(self._watch(motion))
        try:
            result = await motion.start(plan_hash)
        finally:
            watching.cancel()
        (outcome,) = await asyncio.gather(watching, return_exceptions=True)
        return result, result.cause or (outcome if isinstance(outcome, DockingError) else None)

    async def _watch(self, motion: Motion) -> None:
        latest: list[Array] = []
        while True:
            await asyncio.sleep(PAUSE_S)
            try:
                latest = [*latest[1 - READINGS :], motion.feedback().force_n]
                if len(latest) == READINGS:
                    force_n = np.mean(latest, axis=0)
                    force_n = force_n if self.zero_n is None else force_n - self.zero_n
                    self.check(ball_forces_n(self.positioners, force_n))
            except DockingError:
                motion.request("stop")
                raise


def ball_forces_n(positioners: Positioners, force_n: Array) -> Array:
    """Size of the force at each ball (k,) from forces along the axes (m,)."""
    to_balls = np.transpose(positioners.axes_inverse, (0, 2, 1))
    result: Array = np.linalg.norm(np.einsum("kij,kj->ki", to_balls, force_n.reshape(-1, 3)), axis=1)
    return result
