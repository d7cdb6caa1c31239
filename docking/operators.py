"""Who confirms: nobody in a dry-run, a person at the terminal step by step."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Callable
from typing import Any

from docking.state import Event
from docking.types import Plan

Say = Callable[[str], None]
Post = Callable[[Event], None]


class AutomaticOperator:
    """Confirms every plan and declares every permissive; for simulated devices only."""

    def __init__(self, say: Say) -> None:
        self._say = say

    def attend(self, post: Post) -> None:
        """There is nobody who could hold or abort."""

    async def confirm(self, plan: Plan, shown: dict[str, Any]) -> bool:
        return True

    async def permissives(self, names: tuple[str, ...]) -> tuple[str, ...]:
        return ()

    def notify(self, text: str) -> None:
        self._say(text)


class TerminalOperator:
    """A person at the terminal: go, hold, resume, abort. Lines are read from standard input as they come."""

    def __init__(self, say: Say, language: str) -> None:
        self._say, self._words = say, WORDS[language]
        self._answers: asyncio.Queue[str] = asyncio.Queue()
        self._asking = False
        self._post: Post = lambda event: None

    def attend(self, post: Post) -> None:
        """Begin to listen; `post` takes hold, resume and abort while a move runs."""
        self._post = post
        asyncio.get_running_loop().add_reader(sys.stdin.fileno(), self._line)

    def _line(self) -> None:
        text = sys.stdin.readline()
        if text == "":
            # The terminal is gone: nobody can watch, so nothing may go on moving.
            asyncio.get_running_loop().remove_reader(sys.stdin.fileno())
            text = "a"
        word = text.strip().lower()
        if self._asking:
            self._answers.put_nowait(word)
            if word in _ABORT:
                self._asking = False
            return
        event = Event.HOLD if word in _HOLD else Event.RESUME if word in _GO else None
        if word in _ABORT:
            event = Event.ABORT
        if event is None:
            self._say(self._words["keys"])
        else:
            self._post(event)

    async def confirm(self, plan: Plan, shown: dict[str, Any]) -> bool:
        """Show the measured deviation and the displacement of every axis, then wait."""
        self._say(_deviation(shown, self._words))
        self._say(_displacements(plan, self._words))
        answer = await self._ask(self._words["go?"], _GO | _ABORT)
        return answer in _GO

    async def permissives(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """The operator declares each named condition; the journal keeps the state change that follows."""
        missing = []
        for name in names:
            answer = await self._ask(self._words["permissive"].format(name=name), _YES | _NO | _ABORT)
            if answer not in _YES:
                missing.append(name)
        return tuple(missing)

    async def _ask(self, question: str, expected: frozenset[str]) -> str:
        self._asking = True
        try:
            while True:
                self._say(question)
                answer = await self._answers.get()
                if answer in expected:
                    return answer
        finally:
            self._asking = False

    def notify(self, text: str) -> None:
        self._say(text)


_GO = frozenset({"g", "go", "r", "resume", "继续", "执行"})
_HOLD = frozenset({"h", "hold", "保持", "暂停"})
_ABORT = frozenset({"a", "abort", "q", "中止"})
_YES = frozenset({"y", "yes", "是"})
_NO = frozenset({"n", "no", "否"})

WORDS = {
    "en": {
        "keys": "keys: h hold, r resume, a abort (each with Enter). The emergency stop is hard-wired, not here.",
        "go?": "g = go, a = abort; while moving: h = hold, r = resume, a = abort > ",
        "permissive": "is '{name}' given? y / n > ",
        "deviation": "measured deviation of the docking features (mm):",
        "sigma": "sigma",
        "tolerance": "tolerance",
        "move": "planned move: {kind} to {stage}, {duration:.0f} s, limited by {limit}; axis displacements (mm):",
    },
    "zh": {
        "keys": "按键:h 保持,r 继续,a 中止(均需回车)。急停为硬接线,不在此处。",
        "go?": "g = 执行,a = 中止;运动中:h = 保持,r = 继续,a = 中止 > ",
        "permissive": "许可条件 '{name}' 是否满足?y / n > ",
        "deviation": "对接特征实测偏差(mm):",
        "sigma": "σ",
        "tolerance": "公差",
        "move": "计划运动:{kind} 到 {stage},{duration:.0f} s,受限于 {limit};各轴位移(mm):",
    },
}


def _deviation(shown: dict[str, Any], words: dict[str, str]) -> str:
    if not shown:
        return words["deviation"] + " -"
    lines = [words["deviation"]]
    rows = zip(shown["names"], shown["error_mm"], shown["sigma_mm"], shown["tolerance_mm"], strict=True)
    for name, (x, y, z), sigma, tolerance in rows:
        numbers = f"dx {x:+9.3f}  dy {y:+9.3f}  dz {z:+9.3f}"
        lines.append(f"  {name:<12} {numbers}  {words['sigma']} {sigma:.3f}  {words['tolerance']} {tolerance:.3f}")
    return "\n".join(lines)


def _displacements(plan: Plan, words: dict[str, str]) -> str:
    head = words["move"].format(kind=plan.kind, stage=plan.stage, duration=plan.duration_s, limit=plan.speed_limited_by)
    cells = [f"{axis:>6} {dq:+9.3f}" for axis, dq in zip(plan.axes, plan.displacement_mm, strict=True)]
    rows = ["  " + "  ".join(cells[i : i + 3]) for i in range(0, len(cells), 3)]
    return "\n".join([head, *rows])
