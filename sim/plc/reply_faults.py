"""Faults between a Modbus unit and its host, of every kind that a frame can have, at run time.

Each may last for so many requests (`count`), or until it is taken back. What a fault does to an answer is the same on
TCP and on a serial line, where the wire has such a thing: only TCP numbers its requests, only a line has a check sum.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

SERVER_BUSY = 6


class Answer(NamedTuple):
    """One answer on its way: numbers of request and unit, function with data; sent `late_s` later, `cut` in the middle,
    with a bit `flipped` behind its check sum, its second half `apart_s` after the first."""

    transaction: int
    unit: int
    pdu: bytes
    late_s: float = 0.0
    cut: bool = False
    flipped: bool = False
    apart_s: float = 0.0


def _shortened(pdu: bytes) -> bytes:
    """One register fewer than was asked for, in a frame that is whole."""
    shorter = pdu[:-2]
    counted = len(pdu) > 5 and pdu[1] == len(pdu) - 2
    return shorter[:1] + bytes((len(shorter) - 2,)) + shorter[2:] if counted else shorter


_TREATED: dict[str, Callable[[Answer, float], Answer]] = {
    "late": lambda answer, late_s: answer._replace(late_s=late_s),
    "short": lambda answer, _: answer._replace(cut=True),
    "sliced": lambda answer, apart_s: answer._replace(apart_s=apart_s),
    "damaged": lambda answer, _: answer._replace(flipped=True),
    "wrong_length": lambda answer, _: answer._replace(pdu=_shortened(answer.pdu)),
    "wrong_transaction": lambda answer, _: answer._replace(transaction=answer.transaction ^ 0x5555),
    "wrong_unit": lambda answer, _: answer._replace(unit=answer.unit ^ 0x08),
    "wrong_function": lambda answer, _: answer._replace(pdu=bytes((answer.pdu[0] ^ 1,)) + answer.pdu[1:]),
}


@dataclass
class _Running:
    """A fault that goes on: for how many requests, and how much of it."""

    left: float
    value: float


class ReplyFaults:
    """The faults of one unit. Every public method but `answers` and `heal` begins one."""

    def __init__(self) -> None:
        self._running: dict[str, _Running] = {}
        self._before: Answer | None = None

    # what may go wrong -------------------------------------------------------------------------------------------
    def lose_requests(self, count: int | None = None) -> None:
        """Requests do not arrive: nothing is done, nothing is answered."""
        self._begin("lose_requests", count)

    def lose_replies(self, count: int | None = None) -> None:
        """What was asked is done; the answer is lost."""
        self._begin("lose_replies", count)

    def late(self, late_s: float, count: int | None = None) -> None:
        """Answers come so much later."""
        self._begin("late", count, late_s)

    def short(self, count: int | None = None) -> None:
        """Answers break off in the middle."""
        self._begin("short", count)

    def sliced(self, apart_s: float = 0.004, count: int | None = None) -> None:
        """Answers come in two pieces."""
        self._begin("sliced", count, apart_s)

    def damaged(self, count: int | None = None) -> None:
        """A bit flips on the line, behind the check sum; TCP repairs that by itself."""
        self._begin("damaged", count)

    def wrong_length(self, count: int | None = None) -> None:
        """Whole frames with one register too few."""
        self._begin("wrong_length", count)

    def wrong_transaction(self, count: int | None = None) -> None:
        """Answers bear the number of another request."""
        self._begin("wrong_transaction", count)

    def wrong_unit(self, count: int | None = None) -> None:
        """Answers bear the number of another unit."""
        self._begin("wrong_unit", count)

    def wrong_function(self, count: int | None = None) -> None:
        """Answers bear another function."""
        self._begin("wrong_function", count)

    def exception(self, code: int = SERVER_BUSY, count: int | None = None) -> None:
        """Requests are refused with this exception; nothing is done."""
        self._begin("exception", count, code)

    def stale(self, count: int | None = None) -> None:
        """The answer before comes once more, in front of the right one."""
        self._begin("stale", count)

    def repeat(self, count: int | None = None) -> None:
        """Every answer is that of the request before, under the new number."""
        self._begin("repeat", count)

    def double(self, count: int | None = None) -> None:
        """Answers come twice."""
        self._begin("double", count)

    def heal(self, name: str) -> None:
        """Take the fault `name` back."""
        self._running.pop(name, None)

    def _begin(self, name: str, count: int | None, value: float = 0.0) -> None:
        self._running[name] = _Running(math.inf if count is None else count, value)

    # what becomes of a request -----------------------------------------------------------------------------------
    def answers(self, transaction: int, unit: int, function: int, carry_out: Callable[[], bytes]) -> tuple[Answer, ...]:
        """What leaves the unit for one request; `carry_out()` does it and returns function and data of its answer."""
        if not self._running:
            self._before = right = Answer(transaction, unit, carry_out())
            return (right,)
        if self._due("lose_requests") is not None:
            return ()
        code = self._due("exception")
        pdu = carry_out() if code is None else bytes((function | 0x80, int(code)))
        before, self._before = self._before, Answer(transaction, unit, pdu)
        answer = self._before
        if self._due("repeat") is not None and before is not None and before.pdu[0] == function:
            answer = answer._replace(pdu=before.pdu)
        for name, treat in _TREATED.items():
            value = self._due(name)
            answer = answer if value is None else treat(answer, value)
        if self._due("lose_replies") is not None:
            return ()
        behind = (before,) if self._due("stale") is not None and before is not None else ()
        return (*behind, answer, *((answer,) if self._due("double") is not None else ()))

    def _due(self, name: str) -> float | None:
        """The value of a fault that goes on for this request, None where it does not."""
        running = self._running.get(name)
        if running is None:
            return None
        running.left -= 1
        if not running.left > 0:
            del self._running[name]
        return running.value


KINDS = tuple(name for name in vars(ReplyFaults) if not name.startswith("_") and name not in ("answers", "heal"))
"""Names of all faults, each a method of `ReplyFaults`."""
