"""What halts `docking home`: a wired stop, an enabling device let go, a module that says nothing, a person."""

from __future__ import annotations

from typing import cast

import pytest

from docking.assemble.homing import _announced, _stops
from docking.types import InputState
from drivers.inputs import WiredInputs
from tests.support.dry_cell import files

IN_ORDER = {"e_stop": False, "gate": False, "enabling": True, "crane_free": False}


class Contacts:
    """Wired inputs as they stand."""

    def __init__(self, given: dict[str, bool | None]) -> None:
        self.given = given

    def latest(self) -> InputState:
        return InputState(given=self.given)


def reason(given: dict[str, bool | None], asked: list[str] | None = None) -> str | None:
    cell, _ = files("lab-can")
    return _stops(asked or [], cast(WiredInputs, Contacts(given)), cell.inputs)()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({}, None),
        ({"e_stop": True}, "e_stop is pressed"),
        ({"e_stop": None}, "e_stop is pressed, or silent"),
        ({"gate": True}, "gate is pressed"),
        ({"gate": None}, "gate is pressed, or silent"),
        ({"enabling": False}, "enabling is not held"),
        ({"enabling": None}, "enabling is not held, or silent"),
    ],
)
def test_only_stops_that_say_they_are_free_and_a_held_device_let_it_go_on(
    change: dict[str, bool | None], told: str | None
) -> None:
    found = reason({**IN_ORDER, **change})
    assert found is None if told is None else found is not None and told in found


def test_inputs_that_said_nothing_yet_halt_and_so_does_a_person() -> None:
    assert reason({}) == "e_stop is pressed, or silent."
    assert reason(dict(IN_ORDER), ["Somebody interrupted it."]) == "Somebody interrupted it."
    assert _stops([], None, None)() is None, "a cell without inputs"


def test_it_is_announced_once_before_the_first_look() -> None:
    heard: list[str] = []

    def stop() -> str | None:
        heard.append("look")
        return None

    watched = _announced(stop, lambda: heard.append("HOMING"))
    watched()
    watched()
    assert heard == ["HOMING", "look", "look"]
