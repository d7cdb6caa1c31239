"""What a person types: one key a relief step, in time; retreat only where there is a way; the speed at any time."""

from __future__ import annotations

import asyncio
import os
import select
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import pytest

from docking import operators
from docking.errors import TooFewPoints
from docking.operators import AutomaticOperator, TerminalOperator
from docking.state import Event

FACTS = {"number": 1, "duration_s": 0.5, "force_n": 1500.0}
UNSEEN = TooFewPoints("component", value=2, limit=4)


class Keyboard:
    """Standard input as a pipe, and what the operator heard of it."""

    def __init__(self) -> None:
        self.near, self._far = os.pipe()
        self.said: list[str] = []
        self.events: list[Event] = []
        self.percents: list[float] = []

    def fileno(self) -> int:
        return self.near

    def type(self, *lines: str) -> None:
        os.write(self._far, "".join(f"{line}\n" for line in lines).encode())

    def close(self) -> None:
        for end in (self.near, self._far):
            os.close(end)


@pytest.fixture
def keyboard(monkeypatch: pytest.MonkeyPatch) -> Iterator[Keyboard]:
    keys = Keyboard()
    monkeypatch.setattr(operators.sys, "stdin", keys)
    yield keys
    keys.close()


async def asked(keys: Keyboard, ask: Callable[[TerminalOperator], Awaitable[Any]], *lines: str) -> Any:
    """The answer to a question while `lines` are typed after it has been put."""
    loop, operator = asyncio.get_running_loop(), TerminalOperator(keys.said.append, "en")
    operator.attend(keys.events.append, keys.percents.append)
    try:
        question = loop.create_task(ask(operator))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        keys.type(*lines) if lines else None
        return await asyncio.wait_for(question, 5.0)
    finally:
        loop.remove_reader(keys.near)


@pytest.mark.parametrize(("word", "goes"), [("s", True), ("step", True), ("一步", True), ("n", False), ("no", False)])
async def test_one_key_asks_for_one_step(keyboard, word, goes):
    assert await asked(keyboard, lambda operator: operator.hold_to_run(FACTS), word) is goes


async def test_another_word_is_no_step_and_the_question_stands(keyboard):
    assert await asked(keyboard, lambda operator: operator.hold_to_run(FACTS), "g", "s") is True
    assert any("hard-wired" in text for text in keyboard.said)


async def test_no_key_in_time_lets_go_and_a_late_one_does_nothing(keyboard, monkeypatch):
    monkeypatch.setattr(operators, "HOLD_S", 0.05)
    assert await asked(keyboard, lambda operator: operator.hold_to_run(FACTS)) is False
    operator = TerminalOperator(keyboard.said.append, "en")
    operator._take("s")
    assert keyboard.events == []


async def test_what_was_typed_ahead_asks_for_no_step(keyboard, monkeypatch):
    monkeypatch.setattr(operators, "HOLD_S", 0.05)
    keyboard.type("s", "s")
    assert await asked(keyboard, lambda operator: operator.hold_to_run(FACTS)) is False


async def test_a_key_in_a_step_lets_go_of_it(keyboard):
    operator = TerminalOperator(keyboard.said.append, "en")
    operator.attend(keyboard.events.append, keyboard.percents.append)
    for word in ("h", "a"):
        operator._take(word)
    asyncio.get_running_loop().remove_reader(keyboard.near)
    assert keyboard.events == [Event.HOLD, Event.ABORT]


@pytest.mark.parametrize(
    ("word", "way", "event"),
    [("m", True, Event.AGAIN), ("r", True, Event.RETREAT), ("退回", True, Event.RETREAT), ("m", False, Event.AGAIN)],
)
async def test_a_blocked_view_is_measured_again_or_retreated_from(keyboard, word, way, event):
    ask = lambda operator: operator.blocked(UNSEEN, retreatable=way)  # noqa: E731
    assert await asked(keyboard, ask, word) is event
    assert any("cannot be measured" in text for text in keyboard.said)


async def test_without_a_way_back_no_retreat_is_taken(keyboard):
    ask = lambda operator: operator.blocked(UNSEEN, retreatable=False)  # noqa: E731
    assert await asked(keyboard, ask, "r", "m") is Event.AGAIN


PLACES = ("approach-10", "Align", "align", "lift", "start")


@pytest.mark.parametrize(
    ("words", "moves"),
    [
        (("1",), 1),
        (("3",), 3),
        (("align",), 2),
        (("LIFT",), 4),
        (("start",), 5),
        (("all",), 5),
        (("全部",), 5),
        (("0", "6", "-1", "1.5", "dock", "", "2"), 2),
    ],
)
async def test_how_far_back_is_a_number_a_place_or_all(keyboard, words, moves):
    assert await asked(keyboard, lambda operator: operator.how_far(PLACES), *words) == moves
    assert any("1 = approach-10, 2 = Align" in text for text in keyboard.said)


@pytest.mark.parametrize(
    ("way", "word", "event"),
    [(False, "g", Event.CONFIRMED), (True, "g", Event.CONFIRMED), (True, "r", Event.RETREAT)],
)
async def test_at_the_question_for_go_the_way_back_is_open_where_there_is_one(keyboard, way, word, event):
    assert await asked(keyboard, lambda operator: operator.confirm(None, {"retreatable": way}), word) is event


async def test_the_speed_is_taken_at_any_time_within_its_bounds(keyboard):
    words = ["50%", "0%", "100 %", "100%", "12.5％", "101%", "-5%", "nan%", "g"]
    await asked(keyboard, lambda operator: operator.confirm(None, {}), *words)
    assert keyboard.percents == [50.0, 0.0, 100.0, 100.0, 12.5]


async def test_nobody_decides_by_itself():
    nobody = AutomaticOperator([].append)
    assert await nobody.hold_to_run(FACTS) is False
    assert await nobody.blocked(UNSEEN, retreatable=True) is None


async def test_a_question_that_takes_what_was_typed_ahead_leaves_nothing_to_wait_for(keyboard, monkeypatch):
    """Both happen in one turn of the loop, which also serves the lease: it must not sit until the next line."""
    real_read, waits = os.read, []

    def read(descriptor: int, size: int) -> bytes:
        if select.select([descriptor], [], [], 0.0)[0]:
            return real_read(descriptor, size)
        waits.append(descriptor)
        return b"\n"

    monkeypatch.setattr(operators.os, "read", read)
    loop, operator = asyncio.get_running_loop(), TerminalOperator(keyboard.said.append, "en")
    operator.attend(keyboard.events.append, keyboard.percents.append)
    try:
        question = loop.create_task(operator.blocked(UNSEEN, retreatable=False))
        keyboard.type("m")
        await asyncio.sleep(0.01)
        assert not question.done(), "what was typed ahead confirms nothing"
        keyboard.type("m")
        assert await asyncio.wait_for(question, 5.0) is Event.AGAIN
    finally:
        loop.remove_reader(keyboard.near)
    assert waits == [], "the loop waited for the next line"
