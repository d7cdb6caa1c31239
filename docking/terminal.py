"""What every command shares: its options, its language, and how it prints."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from docking.errors import BadArgument, StoppedByOperator

if TYPE_CHECKING:
    from docking.assemble.requests import WireChoice

FILE = click.Path(path_type=Path)
YES = frozenset({"y", "yes", "是"})


class Range(click.FloatRange):
    """A range of numbers; NaN, which the bounds of click let pass, is in none."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number = float(super().convert(value, param, ctx))
        if math.isnan(number):
            self.fail(f"{value} is no number.", param, ctx)
        return number


def wire_choice(sim: bool, wires: Path | None) -> WireChoice:
    """What `--sim` and `--wires` say together. Raises BadArgument for addresses without `--sim`."""
    from docking.assemble.requests import WireChoice

    if wires is not None and not sim:
        raise BadArgument("--wires", "addresses of simulated devices need --sim", value=str(wires))
    return WireChoice(sim, wires)


def language() -> str:
    """`zh` when DOCKING_LANGUAGE (or the locale) asks for it, else `en`."""
    asked = os.environ.get("DOCKING_LANGUAGE") or os.environ.get("LC_ALL") or os.environ.get("LANG") or "en"
    return "zh" if asked.lower().startswith("zh") else "en"


def json_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """The option `--json` of a command."""
    return click.option("--json", "as_json", is_flag=True, help="Print one JSON object on stdout and nothing else.")(
        command
    )


def transcript_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """The option `--transcript` of a command."""
    text = "Write all bytes of all wires with their times into this text file."
    return click.option("--transcript", type=FILE, help=text)(command)


def print_text(text: str, *, err: bool = False) -> None:
    """Print; a terminal that has gone away changes neither what the cell does nor the exit code."""
    with contextlib.suppress(OSError):
        click.echo(text, err=err)


def print_json(body: dict[str, Any]) -> None:
    """Print one JSON object in its canonical form."""
    from docking.journal import canonical

    print_text(canonical(body))


def ask_before(command: str, question: str) -> None:
    """Ask on stderr, in the language of the user. Raises StoppedByOperator for any answer but yes."""
    from docking.words import tell

    text = tell(language(), "confirmed", question=question)
    answer = click.prompt(text, prompt_suffix="", default="", show_default=False, err=True)
    if answer.strip().lower() not in YES:
        raise StoppedByOperator(command, "The question was not answered with yes: nothing was done.")


def notifier(as_json: bool) -> Callable[..., None]:
    """`notify(key, **facts)`: progress in the language of the user, on stderr where stdout carries JSON."""
    from docking.words import tell

    spoken = language()
    return lambda key, **facts: print_text(tell(spoken, key, **facts), err=as_json)
