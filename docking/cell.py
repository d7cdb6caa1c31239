"""The one orchestrating loop: events in, `step()`, effects out."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from typing import Generic, Protocol, TypeVar

from docking.errors import DockingError, EventRefused
from docking.ports import Journal, Motion, Operator
from docking.state import FINAL, Effect, Event, Situation, State, step

OPENING = {State.STANDBY: Event.CONNECT, State.DISABLED: Event.ENABLE, State.IDLE: Event.START_SEATED}
"""What `dock` asks for by itself until the first measurement."""

RELIEVING = OPENING | {State.IDLE: Event.START_RELIEF}
"""What `relieve` asks for by itself until the first weighing."""

REQUESTS = {Effect.HOLD: "hold", Effect.RESUME: "resume", Effect.STOP: "stop"}
"""Effects that only tell the running move something."""

SLOWING = (Effect.HOLD, Effect.STOP)
"""Requests that are passed on before they are recorded; what sets axes moving is recorded first."""

TOLD = {Effect.HOLD: "paused", Effect.RESUME: "resumed", Effect.STOP: "stopping"}
"""What the operator hears of them."""


class Activities(Protocol):
    """The effects of one run, and who it works with: a docking or a stress relief."""

    motion: Motion
    journal: Journal
    operator: Operator

    @property
    def effects(self) -> Mapping[Effect, Callable[[], Awaitable[Event]]]:
        """What to do for each effect that the run may have; each answers with an event."""
        ...

    def alarm(self, error: DockingError) -> None:
        """Keep an error in the journal and tell the operator."""
        ...

    async def close(self) -> None:
        """Release the devices."""
        ...


A = TypeVar("A", bound=Activities)


class Cell(Generic[A]):
    """A docking cell. `dock()` and `relieve()` run to their end, `post()` takes the operator's events and `override()`
    the speed."""

    def __init__(self, procedure: A) -> None:
        self.procedure = procedure
        self.percent = 100.0
        self.situation = Situation()
        self._events: asyncio.Queue[tuple[Event, DockingError | None]] = asyncio.Queue()
        self._activity: asyncio.Task[None] | None = None
        self._defect: BaseException | None = None

    def post(self, event: Event) -> None:
        """An event from the operator; one that the table refuses is told and changes nothing."""
        self._events.put_nowait((event, None))

    def override(self, percent: float) -> None:
        """Run at `percent` of the planned speed from now on, this move and those to come.

        Slower is passed on before it is recorded, faster after.
        """
        procedure, slower = self.procedure, percent < self.percent
        if slower:
            procedure.motion.override(percent)
        procedure.journal.write("command", {"verb": "override", "percent": percent})
        procedure.operator.notify("override", percent=percent)
        if not slower:
            procedure.motion.override(percent)
        self.percent = percent

    async def dock(self) -> State:
        """Run from OFFLINE to a final state and release the devices; a defect in an effect is raised when they are."""
        return await self._run(OPENING)

    async def relieve(self) -> State:
        """Run a stress relief from OFFLINE to IDLE, or to the final state that it ends in; else as `dock`."""
        return await self._run(RELIEVING, until=Event.RELIEVED)

    async def _run(self, opening: Mapping[State, Event], until: Event | None = None) -> State:
        self.post(Event.LOAD)
        asked: set[State] = set()
        ended = False
        try:
            while not ended:
                event, error = await self._events.get()
                self._handle(event, error)
                state = self.situation.state
                ended = state in FINAL or event is until
                if state in opening and state not in asked:
                    asked.add(state)
                    self.post(opening[state])
        finally:
            if self._activity is not None and not self._activity.done():
                self._activity.cancel()
                await asyncio.gather(self._activity, return_exceptions=True)
            await self.procedure.close()
        if self._defect is not None:
            raise self._defect
        return self.situation.state

    def _handle(self, event: Event, error: DockingError | None) -> None:
        before = self.situation.state
        try:
            self.situation, effects = step(self.situation, event, error.text() if error else None)
        except EventRefused as refusal:
            self.procedure.operator.notify("refused_event", error=refusal)
            return
        # What slows the axes down is asked for first: neither a slow disk nor a slow terminal lengthens a stop.
        for effect in effects:
            if effect in SLOWING:
                self._tell(effect)
        body = {"from": before.value, "event": event.value, "to": self.situation.state.value}
        self.procedure.journal.write("state", body)
        if error is not None:
            self.procedure.alarm(error)
        for effect in effects:
            self._begin(effect)

    def _begin(self, effect: Effect) -> None:
        verb = REQUESTS.get(effect)
        if verb is None:
            self._activity = asyncio.get_running_loop().create_task(self._perform(effect))
            self._activity.add_done_callback(self._ended)
            return
        self.procedure.journal.write("command", {"verb": verb})
        self.procedure.operator.notify(TOLD[effect])
        if effect not in SLOWING:
            self._tell(effect)

    def _tell(self, effect: Effect) -> None:
        """A move that has just ended takes no more requests: one kept for later would hold or stop the next move."""
        if self._activity is not None and not self._activity.done():
            self.procedure.motion.request(REQUESTS[effect])

    def _ended(self, activity: asyncio.Task[None]) -> None:
        """A defect (an error that is not the cell's own) ends the run as a fault; nothing may wait for it for ever."""
        if not activity.cancelled() and activity.exception() is not None:
            self._defect = activity.exception()
            self._events.put_nowait((Event.FAULTED, None))

    async def _perform(self, effect: Effect) -> None:
        error: DockingError | None = None
        try:
            event = await self.procedure.effects[effect]()
        except DockingError as raised:
            event, error = Event.FAULTED, raised
        self._events.put_nowait((event, error))
