"""What every command shares: its options, its language, and how it prints."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

FILE = click.Path(path_type=Path)


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
