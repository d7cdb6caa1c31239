"""Who confirms: nobody in a dry-run, a person at the terminal step by step."""

from __future__ import annotations

import asyncio
import os
import re
import select
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from docking.errors import DockingError
from docking.state import Event
from docking.types import Plan
from docking.words import tell

Say = Callable[[str], None]
Post = Callable[[Event], None]
Override = Callable[[float], None]

LOOK_S = 0.5
"""How often the terminal looks again at a wired input that is not given."""
HOLD_S = 30.0
"""How long a relief step waits to be asked for; the supervisor has let go when the time is up."""


class AutomaticOperator:
    """Confirms every plan and declares every permissive; for simulated devices only. It never retreats and never asks
    for a relief step: both are decisions of a person."""

    def __init__(self, say: Say, language: str = "en") -> None:
        self._say, self._language = say, language

    def attend(self, post: Post, override: Override) -> None:
        """There is nobody who could hold, abort or slow down."""

    def show(self, plan: Plan, shown: dict[str, Any]) -> None:
        """There is nobody who could look."""

    async def permissives(self, names: tuple[str, ...]) -> tuple[str, ...]:
        return ()

    async def wait_for(self, name: str) -> bool:
        return False

    async def confirm(self, plan: Plan, shown: dict[str, Any]) -> Event:
        return Event.CONFIRMED

    async def blocked(self, error: DockingError, *, retreatable: bool) -> Event | None:
        return None

    async def how_far(self, places: tuple[str, ...]) -> int:
        return 1

    async def hold_to_run(self, facts: dict[str, Any]) -> bool:
        return False

    def notify(self, key: str, **facts: Any) -> None:
        self._say(tell(self._language, key, **facts))


class TerminalOperator:
    """A person at the terminal: go, hold, resume, abort, the speed in percent, measure again, retreat, one relief step.
    Lines are read from standard input as they come.

    Abort and speed are taken at any time. An answer counts only for a question that has been put: what was typed ahead
    confirms nothing. When the input ends nobody watches, and the docking is aborted.
    """

    def __init__(self, say: Say, language: str) -> None:
        self._say, self._language = say, language
        self._descriptor = -1
        self._typed = b""
        self._asked: frozenset[str] = frozenset()
        self._answer: asyncio.Future[str] | None = None
        self._engaged = self._gone = False
        self._awaited = ""
        self._post: Post = lambda event: None
        self._override: Override = lambda percent: None

    def attend(self, post: Post, override: Override) -> None:
        """Begin to listen; `post` takes hold, resume and abort, `override` the speed in percent."""
        self._post, self._override, self._descriptor = post, override, sys.stdin.fileno()
        asyncio.get_running_loop().add_reader(self._descriptor, self._readable)

    def _readable(self) -> None:
        """Take what was typed, and return at once where nothing is: a question put in the same turn of the loop may
        have taken it already, and the loop must not wait for the next line."""
        if not self._pending():
            return
        try:
            data = os.read(self._descriptor, 4096)
        except OSError:
            # A terminal that was closed answers with an input/output error.
            data = b""
        if not data:
            asyncio.get_running_loop().remove_reader(self._descriptor)
            self._gone = True
            if self._engaged:
                self._leave()
            return
        *lines, self._typed = (self._typed + data).split(b"\n")
        for line in lines:
            self._take(line.decode("utf-8", "replace").strip().lower())

    def _pending(self) -> bool:
        return bool(select.select([self._descriptor], [], [], 0.0)[0])

    def _take(self, word: str) -> None:
        if word in _ABORT:
            self._post(Event.ABORT)
        elif (speed := _PERCENT.fullmatch(word)) is not None and float(speed[1]) <= 100.0:
            self._override(float(speed[1]))
        elif self._answer is not None and word in self._asked:
            self._answer.set_result(word)
            self._answer = None
        elif self._answer is None and word in _HOLD:
            self._post(Event.HOLD)
        elif self._answer is None and word in _RESUME:
            self._post(Event.RESUME)
        else:
            self.notify("keys")

    def _leave(self) -> None:
        self.notify("end_of_input")
        self._post(Event.ABORT)

    def show(self, plan: Plan, shown: dict[str, Any]) -> None:
        """The deviation of every feature and the displacement of every axis."""
        deviation = self._deviation(shown) if "names" in shown else []
        self._say("\n".join([*deviation, *self._displacements(plan, shown)]))

    def _deviation(self, shown: dict[str, Any]) -> list[str]:
        rows = zip(shown["names"], shown["error_mm"], shown["sigma_mm"], shown["tolerance_mm"], strict=True)
        lines = [tell(self._language, "deviation")]
        for name, error, sigma, tolerance in rows:
            facts = dict(zip("xyz", error, strict=True), norm=float(np.linalg.norm(error)))
            lines.append(tell(self._language, "feature", name=name, sigma=sigma, tolerance=tolerance, **facts))
        return lines

    def _displacements(self, plan: Plan, shown: dict[str, Any]) -> list[str]:
        facts = {"kind": plan.kind, "stage": plan.stage, "limited_by": plan.speed_limited_by}
        head = tell(self._language, "move", number=plan.plan_id, duration_s=plan.duration_s, **facts)
        cells = [
            f"{axis + '*' * (axis in shown['passive']):>8} {moved:+9.3f}"
            for axis, moved in zip(plan.axes, plan.displacement_mm, strict=True)
        ]
        rows = ["  ".join(cells[i : i + 3]) for i in range(0, len(cells), 3)]
        return [head, tell(self._language, "displacements"), *rows]

    async def permissives(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """The operator declares each named condition; nothing goes on before all are given."""
        for name in names:
            while await self._ask(_YES | _NO, "permissive", name=name) in _NO:
                self.notify("not_yet", name=name)
        return ()

    async def wait_for(self, name: str) -> bool:
        """Say once that a wired input is waited for, then look again; an abort ends the run by itself."""
        if self._awaited != name:
            self._engaged, self._awaited = True, name
            self.notify("waiting_for", name=name)
            if self._gone:
                self._leave()
        await asyncio.sleep(LOOK_S)
        return True

    async def confirm(self, plan: Plan, shown: dict[str, Any]) -> Event:
        """Wait for go, or for the choice to go back the way the component came; an abort ends the run by itself."""
        self._awaited = ""
        if not shown.get("retreatable"):
            await self._ask(_GO, "go")
            return Event.CONFIRMED
        return Event.RETREAT if await self._ask(_GO | _RETREAT, "go_or_retreat") in _RETREAT else Event.CONFIRMED

    async def blocked(self, error: DockingError, *, retreatable: bool) -> Event:
        """Wait for the choice to measure again or to retreat; an abort ends the run by itself."""
        self.notify("unseen", error=error)
        if not retreatable:
            await self._ask(_AGAIN, "again_only")
            return Event.AGAIN
        word = await self._ask(_AGAIN | _RETREAT, "again_or_retreat")
        return Event.RETREAT if word in _RETREAT else Event.AGAIN

    async def how_far(self, places: tuple[str, ...]) -> int:
        """Wait for a number of moves, `all`, or the name of the place to go back to: the nearest of that name."""
        listed = ", ".join(f"{number} = {place}" for number, place in enumerate(places, 1))
        numbers = {str(number): number for number in range(1, len(places) + 1)}
        names = {place.lower(): number for number, place in reversed(list(enumerate(places, 1)))}
        choices = {**names, **dict.fromkeys(_ALL, len(places)), **numbers}
        expected = frozenset(choices)
        return choices[await self._ask(expected, "how_far", places=listed)]

    async def hold_to_run(self, facts: dict[str, Any]) -> bool:
        """Wait for the one key that asks for one step; any other answer, and none in time, lets go."""
        try:
            word = await asyncio.wait_for(self._ask(_STEP | _NO, "relief_step", **facts, hold_s=HOLD_S), HOLD_S)
        except TimeoutError:
            return False
        return word in _STEP

    async def _ask(self, expected: frozenset[str], key: str, **facts: Any) -> str:
        self._engaged, self._asked = True, expected
        while not self._gone and self._pending():
            # What was typed ahead reaches nobody but an abort.
            self._readable()
        answer: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._answer = answer
        self.notify(key, **facts)
        if self._gone:
            self._leave()
        try:
            return await answer
        finally:
            if self._answer is answer:
                self._answer = None

    def notify(self, key: str, **facts: Any) -> None:
        self._say(tell(self._language, key, **facts))


_GO = frozenset({"g", "go", "执行"})
_HOLD = frozenset({"h", "hold", "保持", "暂停"})
_RESUME = frozenset({"r", "resume", "继续"})
_ABORT = frozenset({"a", "abort", "q", "中止"})
_YES = frozenset({"y", "yes", "是"})
_NO = frozenset({"n", "no", "否"})
_AGAIN = frozenset({"m", "measure", "测量"})
_RETREAT = frozenset({"r", "retreat", "退回"})
_ALL = frozenset({"all", "全部"})
_STEP = frozenset({"s", "step", "一步"})
_PERCENT = re.compile(r"(\d{1,3}(?:\.\d)?) ?[%％]")
