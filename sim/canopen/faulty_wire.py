"""What a bus and the electronics on it may do to frames: lose, delay, double and forge them."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

from sim.wires.can_frames import CanEnd, CanFrame


def _ignore(_: list[CanFrame]) -> None:
    """Nobody listens yet."""


class FaultyWire:
    """Between the drives and their end of the bus; satisfies `CanEnd`.

    Identifiers say the direction: 080h, 000h and 200h + node come from the controller, 180h, 280h, 580h and 700h + node
    go to it. While no fault is on, the sender's own list passes.
    """

    def __init__(self, link: CanEnd, loop: asyncio.AbstractEventLoop) -> None:
        self.on_frames: Callable[[list[CanFrame]], None] = _ignore
        self._link, self._loop = link, loop
        self._losing: dict[int, float] = {}
        self._doubled: set[int] = set()
        self._late_s: Callable[[], float] | None = None
        self._due_s = 0.0
        self._dead = False

    def open(self) -> None:
        """Begin to hear what the bus brings."""
        self._link.on_frames = self._arrived

    def lose(self, cob: int, frames: float = math.inf) -> None:
        """Lose the next so many frames with this identifier; 0 ends it."""
        self._losing[cob] = frames
        if not frames > 0:
            del self._losing[cob]

    def double(self, cob: int) -> None:
        """From now on a second device sends what the drive with this identifier sends, too."""
        self._doubled.add(cob)

    def delay(self, late_s: Callable[[], float] | None) -> None:
        """From now on the controller's batches arrive late, each by what `late_s()` says, in order; None ends it."""
        self._late_s = late_s

    def forge(self, cob: int, data: bytes) -> None:
        """Somebody else on the bus sends a frame: the controller and the drives hear it."""
        self._link.send([(cob, data)])
        self.on_frames([(cob, data)])

    def silence(self, dead: bool = True) -> None:
        """Bus-off without a word: nothing passes in either direction."""
        self._dead = dead

    def send(self, frames: list[CanFrame]) -> None:
        """Frames of the drives on their way to the bus."""
        if self._dead:
            return
        if self._losing:
            frames = self._survivors(frames)
        if self._doubled:
            frames = [frame for frame in frames for _ in range(1 + (frame[0] in self._doubled))]
        if frames:
            self._link.send(frames)

    def _arrived(self, batch: list[CanFrame]) -> None:
        if self._dead:
            return
        if self._losing:
            batch = self._survivors(batch)
        if self._late_s is None and not self._loop.time() < self._due_s:
            self.on_frames(batch)
            return
        late_s = 0.0 if self._late_s is None else self._late_s()
        self._due_s = max(self._due_s, self._loop.time() + late_s)
        self._loop.call_at(self._due_s, self.on_frames, batch)

    def _survivors(self, frames: list[CanFrame]) -> list[CanFrame]:
        """The frames that get through, counting down what is still to be lost."""
        kept: list[CanFrame] = []
        for frame in frames:
            left = self._losing.get(frame[0], 0)
            if not left > 0:
                kept.append(frame)
            elif left > 1:
                self._losing[frame[0]] = left - 1
            else:
                del self._losing[frame[0]]
        return kept
