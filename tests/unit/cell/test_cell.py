"""The loop between events and effects: what reaches the motion side when, and what ends a run."""

from __future__ import annotations

import asyncio

import pytest

from docking.cell import Cell
from docking.errors import DriveFault, TargetLost
from docking.state import Effect, Event, State
from sim.virtual_time import run_virtual

ANSWERS = {
    Effect.CONNECT: Event.CONNECTED,
    Effect.ENABLE: Event.ENABLED,
    Effect.LOCATE: Event.FRAME_MEASURED,
    Effect.MEASURE: Event.MEASURED,
    Effect.FIT: Event.FITTED,
    Effect.PLAN: Event.PLANNED,
    Effect.ASK: Event.CONFIRMED,
    Effect.ASK_BACK: Event.CONFIRMED,
    Effect.MOVE: Event.MOVED,
    Effect.SETTLE: Event.SETTLED,
}


class Everything:
    """Procedure, motion, journal and operator in one: it answers each effect after a second and keeps what it is told.

    `answers` replaces the answer of an effect by an event, an error to raise, or a coroutine function.
    """

    def __init__(self, moves: int = 2, **answers) -> None:
        self.motion = self.journal = self.operator = self
        self.moves = moves
        self.said: list[str] = []
        self.records: list[tuple[str, dict]] = []
        self.requests: list[tuple[float, str]] = []
        self.alarms: list[Exception] = []
        self.closed = 0
        self.began: list[Effect] = []
        self._answers = ANSWERS | {Effect[name]: answer for name, answer in answers.items()}
        self.effects = {effect: self._effect(effect) for effect in Effect}

    def _effect(self, effect: Effect):
        async def perform() -> Event:
            self.began.append(effect)
            if effect is Effect.JUDGE:
                self.moves -= 1
                return Event.MOVE_NEEDED if self.moves >= 0 else Event.ACCEPTED
            await asyncio.sleep(1.0)
            answer = self._answers[effect]
            if isinstance(answer, Exception):
                raise answer
            return await answer() if callable(answer) else answer

        return perform

    def write(self, kind: str, body: dict) -> None:
        self.records.append((kind, body))

    def notify(self, key: str, **facts: object) -> None:
        self.said.append(" ".join([key, *map(str, facts.values())]))

    def request(self, verb: str) -> None:
        self.requests.append((asyncio.get_running_loop().time(), verb))

    def override(self, percent: float) -> None:
        self.requests.append((asyncio.get_running_loop().time(), f"{percent:g} %"))

    def alarm(self, error: Exception) -> None:
        self.alarms.append(error)

    async def close(self) -> None:
        self.closed += 1

    def states(self) -> list[str]:
        return [body["to"] for kind, body in self.records if kind == "state"]


def dock(parts: Everything, *posts: tuple[float, Event]) -> State:
    """Dock with events posted at their times."""

    async def main() -> State:
        cell = Cell(parts)
        for at_s, event in posts:
            asyncio.get_running_loop().call_later(at_s, cell.post, event)
        state = await asyncio.wait_for(cell.dock(), 1000.0)
        assert asyncio.all_tasks() == {asyncio.current_task()}
        return state

    return run_virtual(main)


MOVE_AT_S = 7.0
"""When the first move begins: seven effects of a second before it."""


def test_a_docking_runs_through_the_table_and_closes():
    parts = Everything(moves=2)
    assert dock(parts) is State.DOCKED
    assert parts.closed == 1
    assert parts.began.count(Effect.MOVE) == 2
    assert parts.states()[:6] == ["standby", "standby", "disabled", "disabled", "idle", "measure-frame"]
    assert parts.states()[-3:] == ["fit", "verify", "docked"]


@pytest.mark.parametrize("late_s", [1e-6, 0.5, 0.999])
def test_a_hold_reaches_the_motion_side_during_the_move(late_s):
    parts = Everything()
    assert dock(parts, (MOVE_AT_S + late_s, Event.HOLD)) is State.DOCKED
    assert parts.requests == [(pytest.approx(MOVE_AT_S + late_s), "hold")]
    assert ("command", {"verb": "hold"}) in parts.records


@pytest.mark.parametrize(("event", "verb"), [(Event.HOLD, "hold"), (Event.ABORT, "stop"), (Event.RESUME, "resume")])
def test_what_slows_the_axes_is_asked_for_before_it_is_written_and_what_moves_them_after(event, verb):
    async def moving() -> Event:
        await asyncio.sleep(3.0)
        return Event.STOPPED if verb == "stop" else Event.MOVED

    order: list[str] = []
    parts = Everything(moves=1, MOVE=moving)
    write, notify, request = parts.write, parts.notify, parts.request
    parts.write = lambda kind, body, **how: (
        order.append(f"write {body.get('verb', body.get('event'))}"),
        write(kind, body),
    )
    parts.notify = lambda key, **facts: (order.append(f"notify {key}"), notify(key, **facts))
    parts.request = lambda asked: (order.append(f"request {asked}"), request(asked))
    first = [(MOVE_AT_S + 0.5, Event.HOLD)] if verb == "resume" else []
    dock(parts, *first, (MOVE_AT_S + 1.0, event))
    at = order.index(f"request {verb}")
    state, command = (
        order.index(f"write {event.value}"),
        order.index(f"write {verb}", order.index(f"write {event.value}")),
    )
    if verb == "resume":
        assert max(state, command) < at
    else:
        assert at < min(state, command)


def test_a_journal_that_fails_does_not_keep_a_hold_from_the_axes():
    def write(kind: str, body: dict) -> None:
        if body.get("event") == Event.HOLD.value:
            raise OSError("the disk is full")

    parts = Everything()
    parts.write = write
    with pytest.raises(OSError, match="full"):
        dock(parts, (MOVE_AT_S + 0.5, Event.HOLD))
    assert [verb for _, verb in parts.requests] == ["hold"]


def test_a_hold_directly_behind_the_confirmation_is_not_lost():
    async def confirm_and_hold() -> Event:
        cells[0].post(Event.CONFIRMED)
        cells[0].post(Event.HOLD)
        await asyncio.sleep(0.0)
        raise asyncio.CancelledError

    cells: list[Cell] = []
    parts = Everything(moves=1, ASK=confirm_and_hold)

    async def main() -> State:
        cells.append(Cell(parts))
        return await cells[0].dock()

    assert run_virtual(main) is State.DOCKED
    assert [verb for _, verb in parts.requests] == ["hold"]


def test_a_hold_after_the_end_of_a_move_is_not_kept_for_the_next():
    async def moved_then_held() -> Event:
        asyncio.get_running_loop().call_soon(cells[0].post, Event.HOLD)
        cells[0].post(Event.HOLD)
        return Event.MOVED

    cells: list[Cell] = []
    parts = Everything(moves=2, MOVE=moved_then_held)

    async def main() -> State:
        cells.append(Cell(parts))
        return await cells[0].dock()

    assert run_virtual(main) is State.DOCKED
    assert parts.requests == []


@pytest.mark.parametrize("event", [Event.HOLD, Event.RESUME, Event.RESET])
def test_what_the_table_refuses_is_told_and_changes_nothing(event):
    parts = Everything()
    assert dock(parts, (5.5, event)) is State.DOCKED
    assert parts.requests == []
    assert any(event.value in text and "possible here" in text for text in parts.said)


@pytest.mark.parametrize("at_s", [3.5, 4.5, 5.5, 6.5, 8.5])
def test_an_abort_at_rest_ends_the_run_at_once(at_s):
    parts = Everything()
    assert dock(parts, (at_s, Event.ABORT)) is State.RECOVER
    assert parts.closed == 1
    assert parts.requests == []
    assert parts.states()[-1] == "recover"


def test_an_abort_during_a_move_waits_for_the_motion_to_stop():
    async def stopping() -> Event:
        await asyncio.sleep(3.0)
        return Event.STOPPED

    parts = Everything(MOVE=stopping)
    assert dock(parts, (MOVE_AT_S + 0.5, Event.ABORT)) is State.RECOVER
    assert [verb for _, verb in parts.requests] == ["stop"]
    assert parts.states()[-2:] == ["stopping", "recover"]
    assert Effect.SETTLE not in parts.began


@pytest.mark.parametrize("effect", ["CONNECT", "ENABLE", "MEASURE", "FIT", "PLAN", "ASK", "MOVE", "SETTLE"])
def test_an_error_ends_the_run_as_a_fault_with_its_alarm(effect):
    error = TargetLost("J07") if effect == "MEASURE" else DriveFault("B.Y", "overcurrent", value=1)
    parts = Everything(**{effect: error})
    assert dock(parts) is State.FAULT
    assert parts.alarms == [error]
    assert parts.closed == 1


def test_the_cause_of_a_fault_is_kept():
    parts = Everything(MOVE=DriveFault("B.Y", "overcurrent", value=1))

    async def main() -> str | None:
        cell = Cell(parts)
        await cell.dock()
        return cell.situation.cause

    cause = run_virtual(main)
    assert cause is not None
    assert "B.Y" in cause


@pytest.mark.parametrize("effect", ["MEASURE", "MOVE"])
def test_a_defect_closes_the_devices_and_is_raised(effect):
    parts = Everything(**{effect: ZeroDivisionError("a defect")})
    with pytest.raises(ZeroDivisionError):
        dock(parts)
    assert parts.closed == 1
    assert parts.states()[-1] == "fault"


def test_a_cancelled_run_closes_the_devices():
    parts = Everything()

    async def main() -> None:
        task = asyncio.get_running_loop().create_task(Cell(parts).dock())
        await asyncio.sleep(MOVE_AT_S + 0.5)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    run_virtual(main)
    assert parts.closed == 1


def relieve(parts: Everything, *posts: tuple[float, Event]) -> State:
    """Relieve with events posted at their times."""

    async def main() -> State:
        cell = Cell(parts)
        for at_s, event in posts:
            asyncio.get_running_loop().call_later(at_s, cell.post, event)
        return await asyncio.wait_for(cell.relieve(), 1000.0)

    return run_virtual(main)


@pytest.mark.parametrize("steps", [0, 1, 3])
def test_a_relief_steps_until_the_part_is_relieved_and_ends_idle(steps):
    answers = iter([Event.STEP_ASKED] * steps + [Event.RELIEVED])

    async def weighed() -> Event:
        return next(answers)

    parts = Everything(WEIGH=weighed, STEP=Event.MOVED)
    assert relieve(parts) is State.IDLE
    assert parts.began.count(Effect.STEP) == steps
    assert Effect.LOCATE not in parts.began
    assert parts.closed == 1


@pytest.mark.parametrize("event", [Event.HOLD, Event.ABORT])
def test_letting_go_in_a_relief_step_stops_the_axes(event):
    async def stopping() -> Event:
        await asyncio.sleep(1.0)
        return Event.STOPPED

    parts = Everything(WEIGH=Event.STEP_ASKED, STEP=stopping)
    assert relieve(parts, (3.0 + 1.5, event)) is State.RECOVER
    assert [verb for _, verb in parts.requests] == ["stop"]


def test_an_abort_before_the_step_moves_nothing():
    parts = Everything(WEIGH=Event.STEP_ASKED)
    assert relieve(parts, (2.5, Event.ABORT)) is State.RECOVER
    assert Effect.STEP not in parts.began
    assert parts.requests == []


@pytest.mark.parametrize(("percents", "last"), [((50.0, 20.0), "request"), ((50.0, 80.0), "write")])
def test_slower_is_passed_on_before_it_is_recorded_and_faster_after(percents, last):
    parts, order = Everything(), []
    write, override = parts.write, parts.override
    parts.write = lambda kind, body, **how: (order.append("write"), write(kind, body))
    parts.override = lambda percent: (order.append("request"), override(percent))

    async def main() -> Cell:
        cell = Cell(parts)
        for percent in percents:
            order.clear()
            cell.override(percent)
        return cell

    cell = run_virtual(main)
    assert order == [last, "write" if last == "request" else "request"]
    assert [verb for _, verb in parts.requests] == [f"{p:g} %" for p in percents]
    assert [body["percent"] for kind, body in parts.records if kind == "command"] == list(percents)
    assert cell.percent == percents[-1]


def test_a_blocked_view_is_measured_again_or_retreated_from():
    answers = iter([Event.AGAIN, Event.RETREAT])
    views = iter([Event.MEASURED, Event.UNSEEN, Event.UNSEEN, Event.MEASURED])

    async def measured() -> Event:
        return next(views, Event.MEASURED)

    async def chosen() -> Event:
        return next(answers)

    parts = Everything(moves=1, MEASURE=measured, OFFER=chosen, PLAN_RETREAT=Event.PLANNED)
    assert dock(parts) is State.DOCKED
    walked = parts.states()
    at = walked.index("blocked")
    rest = ["blocked", "measure", "blocked", "retreat", "confirm-retreat", "move", "settle", "measure", "fit"]
    assert walked[at : at + len(rest)] == rest
    assert parts.began.count(Effect.MOVE) == 2
