"""What is found behind an address when it is only looked at: nothing is written, started or enabled."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from dataclasses import dataclass
from typing import TypeVar

from docking.errors import DockingError
from docking.types import Identity

T = TypeVar("T")


@dataclass(frozen=True)
class Found:
    """One device: `where` as in the cell file, `address` on its wire, what it says of itself, `state`, how it counts
    (`units`), its `watchdog`, the seconds that each exchange took, and the `problem` that stands in the way."""

    where: str
    address: str
    identity: Identity | None = None
    state: str = ""
    units: str = ""
    watchdog: str = ""
    round_trips_s: tuple[float, ...] = ()
    problem: DockingError | None = None


@dataclass(frozen=True)
class AxisValue:
    """One axis as it stands; NaN where it does not say."""

    axis: str
    state: str
    position_mm: float
    following_error_mm: float
    force_n: float


class Stopwatch:
    """Keeps how long each exchange took."""

    def __init__(self) -> None:
        self.taken_s: list[float] = []

    async def time(self, exchange: Awaitable[T]) -> T:
        loop = asyncio.get_running_loop()
        began_s = loop.time()
        result = await exchange
        self.taken_s.append(loop.time() - began_s)
        return result
