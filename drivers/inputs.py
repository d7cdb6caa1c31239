"""WiredInputs: the contacts and temperatures of a cell, whatever modules they are wired to."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Protocol

from docking.config.inputs import DigitalInput, InputsConfig, TemperatureInput
from docking.errors import BadReply
from docking.types import Identity, InputState

_ROUNDING_S = 1e-6
SILENT_AFTER = 3.0
"""Refresh times or polls without a fresh word after which the inputs of a module are not known."""
TOLD_K = 0.05
"""Temperatures that changed by less are no news."""


class InputModule(Protocol):
    """One module. `on_change` is called when an input changed, or the module fell silent or came back."""

    name: str
    on_change: Callable[[], None]

    @property
    def silent(self) -> bool:
        """True while the module is not heard: then no input of it is known."""
        ...

    @property
    def channels(self) -> tuple[int, int]:
        """How many digital and analogue inputs it has."""
        ...

    def level(self, channel: int) -> bool:
        """The level of a digital input: high or low."""
        ...

    def counts(self, channel: int) -> int | None:
        """The counts of an analogue input, None for a broken wire."""
        ...

    async def bring_up(self) -> Identity: ...

    async def close(self) -> None: ...


class _Contact:
    """One digital input and its debouncing: a level counts once it has lasted."""

    def __init__(self, config: DigitalInput, module: InputModule) -> None:
        self.config, self.module = config, module
        self.given: bool | None = None
        self._seen: bool | None = None
        self._since_s = float("-inf")

    def look(self, now_s: float) -> float | None:
        """Take the present level; return when to look again, None where nothing is pending."""
        level = None if self.module.silent else self.module.level(self.config.channel)
        seen = None if level is None else level is (self.config.on == "high")
        first = self._seen is None
        if seen is not self._seen:
            self._seen, self._since_s = seen, now_s
        if seen is self.given:
            return None
        due_s = self._since_s + self.config.debounce_s
        if seen is None or first or now_s >= due_s - _ROUNDING_S:
            self.given = seen
            return None
        return due_s


class WiredInputs:
    """The `Inputs` port over modules by name."""

    def __init__(self, config: InputsConfig, modules: dict[str, InputModule]) -> None:
        self.on_change: Callable[[], None] = lambda: None
        self._modules = modules
        self._contacts = [_Contact(item, modules[item.module]) for item in config.digital]
        self._sensors = config.temperatures
        self._state = InputState()
        self._timer: asyncio.TimerHandle | None = None

    async def bring_up(self) -> tuple[Identity, ...]:
        """Prove every module in the order of the file. Raises LinkError, BadReply where a channel does not exist."""
        found = [await module.bring_up() for module in self._modules.values()]
        for contact in self._contacts:
            _require(contact.config, contact.module.channels[0], "digital")
        for sensor in self._sensors:
            _require(sensor, self._modules[sensor.module].channels[1], "analogue")
        for module in self._modules.values():
            module.on_change = self._look
        self._look()
        return tuple(found)

    def latest(self) -> InputState:
        return self._state

    async def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        for module in self._modules.values():
            module.on_change = lambda: None
            await module.close()

    def _look(self) -> None:
        loop = asyncio.get_running_loop()
        now_s = loop.time()
        pending = [due for due in [contact.look(now_s) for contact in self._contacts] if due is not None]
        if self._timer is not None:
            self._timer.cancel()
        self._timer = loop.call_at(min(pending), self._look) if pending else None
        state = InputState(
            given={contact.config.name: contact.given for contact in self._contacts},
            temperature_c={sensor.name: self._celsius(sensor) for sensor in self._sensors},
            silent=tuple(name for name, module in self._modules.items() if module.silent),
        )
        if _news(self._state, state):
            self._state = state
            self.on_change()

    def _celsius(self, sensor: TemperatureInput) -> float:
        module = self._modules[sensor.module]
        counts = None if module.silent else module.counts(sensor.channel)
        return float("nan") if counts is None else sensor.offset_c + sensor.celsius_per_count * counts


def _require(item: DigitalInput | TemperatureInput, count: int, kind: str) -> None:
    if not item.channel < count:
        cause = f"{item.name}: the module has no {kind} input {item.channel}"
        raise BadReply(f"input module {item.module}", cause, value=count)


def _news(before: InputState, now: InputState) -> bool:
    if (before.given, before.silent) != (now.given, now.silent):
        return True
    pairs = [(before.temperature_c.get(name, float("nan")), value) for name, value in now.temperature_c.items()]
    return any((a == a) is not (b == b) or abs(a - b) >= TOLD_K for a, b in pairs)
