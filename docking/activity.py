"""What every run with the positioners does alike, a docking or a stress relief: devices, alarms, the end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from docking import records
from docking.errors import DockingError
from docking.permissives import Permissives
from docking.ports import Journal, Motion, Operator
from docking.progress import Standing, stop_of
from docking.state import Event
from docking.types import Identity

P = TypeVar("P", bound=Standing)


class Device(Protocol):
    """What a run opens and releases beside the positioners, such as a tracker."""

    async def connect(self) -> Identity:
        """Open the line, prove that the device answers, return what it says of itself."""
        ...

    async def close(self) -> None: ...


class Activity(Generic[P]):
    """A run's company and how far it is: `progress`; `clock` is the loop's, s."""

    def __init__(
        self, motion: Motion, journal: Journal, operator: Operator, clock: Callable[[], float], progress: P
    ) -> None:
        self.motion, self.journal, self.operator = motion, journal, operator
        self.progress = progress
        self._clock = clock
        self.permissives = Permissives(motion, journal, operator)
        self._devices: tuple[Device, ...] = ()

    def alarm(self, error: DockingError) -> None:
        """Keep an error in the journal and tell the operator; of one that ended a move, how the axes stopped, too."""
        alarm = error.alarm(self._clock(), stop=stop_of(self.progress.result, error))
        self.progress.alarms.append(alarm)
        self.journal.write("alarm", records.alarm_record(alarm))
        self.operator.notify("alarm", code=alarm.code, error=error)
        ended = self.progress.result
        if ended is None or ended.cause is not error or not ended.reaction:
            return
        self.operator.notify("stopped_by", kind=ended.reaction)
        for other in ended.also:
            self.operator.notify("also", error=other)

    async def close(self) -> None:
        """Release the devices, the positioners first; what goes wrong is told, and the rest is still released."""
        for close in (self.motion.close, *(device.close for device in self._devices)):
            try:
                await close()
            except DockingError as error:
                self.alarm(error)

    async def _connect(self) -> Event:
        found = [await device.connect() for device in self._devices]
        found += await self.motion.connect()
        for identity in found:
            self.journal.write("identity", vars(identity))
        self.operator.notify("devices", count=len(found))
        return Event.CONNECTED

    async def _enable(self) -> Event:
        self.progress.commanded_mm = await self.motion.enable()
        return Event.ENABLED
