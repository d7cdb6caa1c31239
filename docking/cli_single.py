"""`docking single`: move an axis that stands beside the positioners."""

from __future__ import annotations

from pathlib import Path

import click

from docking.errors import EXIT_OK
from docking.terminal import (
    FILE,
    ask_before,
    json_option,
    language,
    notifier,
    print_json,
    print_text,
    transcript_option,
    wire_choice,
)
from docking.words import tell


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("cell", type=FILE)
@click.argument("name")
@click.argument("target_mm", type=float)
@click.option("--speed", type=float, help="mm/s (default: that of the cell file).")
@click.option("--yes", is_flag=True, help="Do not ask.")
@click.option("--sim", is_flag=True, help="Move a simulated axis on a real wire.")
@click.option("--wires", type=FILE, help="Addresses that `docking sim` wrote; without it --sim starts its own devices.")
@transcript_option
@json_option
def single(
    cell: Path,
    name: str,
    target_mm: float,
    speed: float | None,
    yes: bool,
    sim: bool,
    wires: Path | None,
    transcript: Path | None,
    as_json: bool,
) -> int:
    """Move the single axis NAME of a CELL to TARGET_MM: a work platform or a gate, never anything that carries a part.

    \b
    Example: docking single cell.toml platform-left 250
    """
    from docking.assemble.looking import LookRequest
    from docking.assemble.single import SingleMove, move_single, single_axis

    look = LookRequest(cell, wire_choice(sim, wires), transcript=transcript, language=language())
    move = SingleMove(look, name, target_mm, speed)
    single_axis(move)
    if not (sim or yes):
        ask_before("single", tell(language(), "single_question", name=name, target_mm=target_mm))
    report = move_single(move, notifier(as_json))
    if as_json:
        print_json(report)
    else:
        print_text(tell(language(), "single_there", **report))
    return EXIT_OK
