"""In-memory inputs without wire and bytes: what the port means, in a few lines."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from docking.errors import DeviceSilent
from docking.types import Identity, InputState

BRING_UP_S = 0.01


class FakeInputs:
    """`docking.ports.Inputs`: one module, one contact, one sensor."""

    module, contact, sensor = "io1", "crane_free", "warm"

    def __init__(self) -> None:
        self.on_change: Callable[[], None] = lambda: None
        self._given, self._celsius = True, 20.0
        self._muted = self._broken = self._up = False
        self._state = InputState()

    async def bring_up(self) -> tuple[Identity, ...]:
        await asyncio.sleep(BRING_UP_S)
        if self._muted:
            raise DeviceSilent(f"input module {self.module}", "it does not answer")
        self._up = True
        self._tell()
        return (Identity(f"input module {self.module}", "tests", "fake", "1", "1"),)

    def latest(self) -> InputState:
        return self._state

    async def close(self) -> None:
        self._up = False

    def hold(self, given: bool) -> None:
        self._given = given
        self._tell()

    def warm(self, celsius: float) -> None:
        self._celsius = celsius
        self._tell()

    def break_sensor(self, broken: bool) -> None:
        self._broken = broken
        self._tell()

    def mute(self, muted: bool) -> None:
        self._muted = muted
        self._tell()

    def _tell(self) -> None:
        if not self._up:
            return
        unknown = self._muted or self._broken
        self._state = InputState(
            given={self.contact: None if self._muted else self._given},
            temperature_c={self.sensor: float("nan") if unknown else self._celsius},
            silent=(self.module,) if self._muted else (),
        )
        self.on_change()
