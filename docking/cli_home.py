"""`docking home`: drives of free positioners find their zeros."""

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


@click.command()
@click.argument("cell", type=FILE)
@click.option("--positioner", "positioners", multiple=True, help="Only this one; may be given again (default: all).")
@click.option("--free", is_flag=True, help="Nothing rests on the positioners: needed where they have no load cells.")
@click.option("--yes", is_flag=True, help="Do not ask.")
@click.option("--sim", is_flag=True, help="Home simulated devices on real wires.")
@click.option("--wires", type=FILE, help="Addresses that `docking sim` wrote; without it --sim starts its own devices.")
@transcript_option
@json_option
def home(
    cell: Path,
    positioners: tuple[str, ...],
    free: bool,
    yes: bool,
    sim: bool,
    wires: Path | None,
    transcript: Path | None,
    as_json: bool,
) -> int:
    """Home the drives of a CELL, free of any component, as its [homing] table says.

    All axes of the group begin together. When one fails, or a stop is pressed, all of them halt and none counts as
    homed. Refused where a load cell shows a component.

    \b
    Example: docking home sim/cells/lab-can-free.toml --sim
    Example: docking home cell.toml --positioner A --positioner B
    """
    from docking.assemble.homing import HomeRequest, home_axes, home_text, homing_plan
    from docking.assemble.looking import LookRequest

    look = LookRequest(cell, wire_choice(sim, wires), transcript=transcript, language=language())
    request = HomeRequest(look, positioners, free)
    names = ", ".join(homing_plan(request).positioners)
    if not (sim or yes):
        ask_before("home", tell(language(), "home_question", names=names))
    report = home_axes(request, notifier(as_json))
    if as_json:
        print_json(report)
    else:
        print_text(home_text(report, language()))
    return EXIT_OK
