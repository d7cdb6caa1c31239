"""Scenarios: faults of the simulated devices, scripted in time or by what the cell is doing.

A file lists events; each names a device, one of its faults, when it happens and for how long it lasts.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from docking.config.base import Model, NonNegative, Positive
from sim.fault_book import Fault, FaultBook
from sim.toml_model import read_toml

LOOK_S = 0.005
"""How often a move is looked at while an event waits for a place on its path."""
Text = Annotated[str, Field(min_length=1, max_length=200)]
Value = bool | int | float | str | tuple[Any, ...] | dict[str, Any]


class Expected(Model):
    """How a run with this scenario ends."""

    outcome: Literal["docked", "out_of_tolerance", "stopped", "fault", "refused"] = Field(description="of the run")
    codes: tuple[int, ...] = Field(default=(), description="codes that its alarms may have; none: no alarm at all")
    where: str = Field(default="", description="part of what the first alarm names")


class EventModel(Model):
    """One fault: either at a time, or when the cell comes into a state."""

    device: Text = Field(description="axis, bus, positioner, tracker, input, module, sensor, component or mate")
    fault: Text = Field(description="one of the device's faults")
    at_s: NonNegative | None = Field(default=None, description="time since the start of the run, s")
    at_state: Text | None = Field(default=None, description="when the cell comes into this state")
    stage: Text | None = Field(default=None, description="only at this station")
    visit: Annotated[int, Field(ge=1)] = Field(default=1, description="at the n-th time that this is so")
    s: Annotated[float, Field(ge=0.0, le=1.0)] | None = Field(
        default=None, description='with at_state = "move": at this fraction of the way'
    )
    after_s: NonNegative = Field(default=0.0, description="so long after the condition, s")
    for_s: Positive | None = Field(default=None, description="it is taken back after so long, s; without: never")
    values: dict[str, Value] = Field(default={}, description="what the fault takes, such as offset_mm = 0.1")

    @model_validator(mode="after")
    def _one_condition(self) -> Self:
        if (self.at_s is None) is (self.at_state is None):
            raise ValueError("give either at_s or at_state")
        if self.at_state is None and (self.stage is not None or self.visit != 1 or self.s is not None):
            raise ValueError("stage, visit and s belong to at_state")
        if self.s is not None and self.at_state != "move":
            raise ValueError('s is a place on the path of a move: at_state = "move"')
        return self


class ScenarioFile(Model):
    """A whole scenario."""

    schema_version: Literal[1] = Field(description="of this file format")
    name: Text = Field(description="what happens, in a few words")
    expected: Expected | None = Field(default=None, description="how the run ends")
    event: tuple[EventModel, ...] = Field(min_length=1, description="in any order")


def load_scenario(path: Path) -> ScenarioFile:
    """Read a scenario. Raises FileUnreadable, ConfigInvalid with all problems."""
    return read_toml(path, ScenarioFile)


@dataclass(frozen=True)
class Known:
    """What conditions may name: states of the cell and stations of the job; none where no cell is in reach."""

    states: tuple[str, ...] = ()
    stages: tuple[str, ...] = ()


def problems_of(scenario: ScenarioFile, book: FaultBook, known: Known) -> tuple[str, ...]:
    """What of a scenario these devices and this job do not have, each with the list of what they have."""
    problems = []
    for i, event in enumerate(scenario.event):
        problems += [f"event[{i}].{text}" for text in _device_problems(event, book)]
        if event.at_state is not None and not known.states:
            problems.append(f"event[{i}].at_state: no cell is in reach here, only at_s counts")
            continue
        for key, name, names in (("at_state", event.at_state, known.states), ("stage", event.stage, known.stages)):
            if name is not None and name not in names:
                problems.append(f"event[{i}].{key}: {name!r} is none of {', '.join(names)}")
    return tuple(problems)


def _device_problems(event: EventModel, book: FaultBook) -> list[str]:
    faults = book.devices.get(event.device)
    if faults is None:
        return [f"device: {event.device!r} is not simulated here; there are {', '.join(book.devices)}"]
    fault = faults.get(event.fault)
    if fault is None:
        return [f"fault: {event.device} has no {event.fault!r}; it has {', '.join(sorted(faults))}"]
    complaint = fault.complaint(event.values)
    problems = [f"values: {complaint}"] if complaint else []
    if event.for_s is not None and fault.end is None:
        problems.append(f"for_s: nothing takes {event.fault!r} back; leave for_s out")
    return problems


class ScenarioRunner:
    """Lets the events of a scenario happen on `loop`. `told(what, event)` hears `begins` and `ends`."""

    def __init__(
        self,
        scenario: ScenarioFile,
        book: FaultBook,
        loop: asyncio.AbstractEventLoop,
        told: Callable[[str, EventModel], None],
    ) -> None:
        self._book, self._loop, self._told = book, loop, told
        self._waiting = [event for event in scenario.event if event.at_state is not None]
        self._visits = dict.fromkeys(range(len(self._waiting)), 0)
        self._timers = [
            loop.call_at(loop.time() + event.at_s, self._begin, event)
            for event in scenario.event
            if event.at_s is not None
        ]

    def entered(self, state: str, stage: str, share: Callable[[], float]) -> None:
        """The cell has come into `state` for station `stage`; `share()` is how much of a move is behind it now."""
        for i, event in enumerate(self._waiting):
            if event.at_state != state or event.stage not in (None, stage):
                continue
            self._visits[i] += 1
            if self._visits[i] == event.visit:
                act = partial(self._begin, event) if event.s is None else partial(self._on_path, event, share)
                self._timers.append(self._loop.call_at(self._loop.time() + event.after_s, act))

    def close(self) -> None:
        """Nothing more happens."""
        for timer in self._timers:
            timer.cancel()

    def _on_path(self, event: EventModel, share: Callable[[], float]) -> None:
        if event.s is not None and not share() >= event.s:
            self._timers.append(self._loop.call_at(self._loop.time() + LOOK_S, self._on_path, event, share))
            return
        self._begin(event)

    def _begin(self, event: EventModel) -> None:
        fault: Fault = self._book.devices[event.device][event.fault]
        self._told("begins", event)
        fault.begin(**event.values)
        if event.for_s is not None and fault.end is not None:
            self._timers.append(self._loop.call_at(self._loop.time() + event.for_s, self._end, event, fault.end))

    def _end(self, event: EventModel, end: Callable[[], None]) -> None:
        self._told("ends", event)
        end()
