"""Permissives: read from the wire where they are wired, declared where not, waited for while somebody is there."""

from __future__ import annotations

import asyncio

import pytest

from docking.errors import PermissiveMissing
from docking.operators import LOOK_S, AutomaticOperator, TerminalOperator
from docking.permissives import Permissives
from docking.types import InputState
from sim.virtual_time import run_virtual


class Wire:
    """A motion side that only has inputs."""

    def __init__(self, **given: bool | None) -> None:
        self.state = InputState(given)

    def inputs(self) -> InputState:
        return self.state

    def set(self, **given: bool | None) -> None:
        self.state = InputState({**self.state.given, **given})


class Book:
    """A journal that keeps what is written."""

    def __init__(self) -> None:
        self.bodies: list[dict] = []

    def write(self, kind: str, body: dict) -> None:
        self.bodies.append(body)


class Refusing(AutomaticOperator):
    """Declares nothing."""

    async def permissives(self, names):
        return names[:1]


def ask(wire: Wire, operator, *names: str):
    book = Book()
    try:
        run_virtual(lambda: Permissives(wire, book, operator).require(names, "align"))
    except PermissiveMissing as error:
        return error.where, book.bodies
    return "", book.bodies


def automatic(kind=AutomaticOperator):
    return kind(lambda text: None)


def test_wired_and_declared_are_told_apart():
    missing, bodies = ask(Wire(crane_free=True), automatic(), "crane_free", "reflectors_off")
    assert missing == ""
    assert bodies == [{"stage": "align", "wired": ["crane_free"], "declared": ["reflectors_off"], "missing": []}]


@pytest.mark.parametrize("level", [False, None])
def test_a_wired_one_that_is_not_given_is_never_declared_away(level):
    missing, bodies = ask(Wire(crane_free=level), automatic(), "crane_free", "reflectors_off")
    assert missing == "crane_free"
    assert bodies[0]["missing"] == ["crane_free"]
    assert bodies[0]["wired"] == []


def test_a_cell_without_inputs_asks_for_all():
    assert ask(Wire(), automatic(Refusing), "crane_free")[0] == "crane_free"
    assert ask(Wire(), automatic(), "crane_free")[1][0]["declared"] == ["crane_free"]


def test_at_a_terminal_it_is_said_once_and_goes_on_when_it_is_given():
    said: list[str] = []
    wire = Wire(crane_free=False)

    async def main() -> float:
        loop = asyncio.get_running_loop()
        loop.call_later(7.2, lambda: wire.set(crane_free=True))
        await Permissives(wire, Book(), TerminalOperator(said.append, "en")).require(("crane_free",), "align")
        return loop.time()

    assert run_virtual(main) == pytest.approx(7.2, abs=LOOK_S + 0.01)
    assert [text for text in said if "waiting for 'crane_free'" in text] == said
    assert len(said) == 1


def test_after_a_person_took_time_only_the_wired_ones_are_looked_at_again():
    async def main() -> str:
        wire = Wire(crane_free=False)
        permissives = Permissives(wire, Book(), automatic(Refusing))
        with pytest.raises(PermissiveMissing):
            await permissives.again(("crane_free", "reflectors_off"), "align")
        wire.set(crane_free=True)
        await permissives.again(("crane_free", "reflectors_off"), "align")
        return "given"

    assert run_virtual(main) == "given"
