"""Commands for commissioning: who is on the wires, and what they say. Neither enables anything."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from docking.errors import EXIT_FAULT, EXIT_OK
from docking.terminal import (
    FILE,
    Range,
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

WIRES = "Addresses that `docking sim` wrote; without it --sim starts its own devices."
CLEAR = "\x1b[H\x1b[J"


@click.command()
@click.argument("cell", type=FILE)
@click.option("--sim", is_flag=True, help="Look at simulated devices on real wires.")
@click.option("--wires", type=FILE, help=WIRES)
@click.option(
    "--prove",
    is_flag=True,
    help="Bring the positioners up as before a docking: settings are written and read back, nothing is enabled.",
)
@click.option(
    "--prove-watchdogs",
    is_flag=True,
    help="Fall silent on a CAN bus until every drive has missed the heartbeat: axes at rest, disabled and braked.",
)
@click.option("--yes", is_flag=True, help="Do not ask before --prove-watchdogs.")
@transcript_option
@json_option
def devices(
    cell: Path,
    sim: bool,
    wires: Path | None,
    prove: bool,
    prove_watchdogs: bool,
    yes: bool,
    transcript: Path | None,
    as_json: bool,
) -> int:
    """Say who answers on the wires of a CELL: identity, firmware, state, units, watchdogs, round trip, start skew.

    Nothing is enabled or moved; without --prove and --prove-watchdogs positioners are only read. Exits with 0 when
    every device answers as it should, else with 1 and its name.

    \b
    Example: docking devices sim/cells/lab-can.toml --sim
    Example: docking devices cell.toml --prove --transcript bring-up.txt
    """
    from docking.assemble.commissioning import Proving, devices_text, find_devices, require_watchdogs

    request = _request(cell, sim, wires, transcript)
    if prove_watchdogs:
        require_watchdogs(request)
        if not (sim or yes):
            ask_before("devices --prove-watchdogs", tell(language(), "silence_question"))
    report = find_devices(request, Proving(prove, prove_watchdogs, notifier(as_json)))
    if as_json:
        print_json(report)
    else:
        print_text(devices_text(report, language()))
    return EXIT_OK if report["ok"] else EXIT_FAULT


@click.command()
@click.argument("cell", type=FILE)
@click.option("--sim", is_flag=True, help="Look at simulated devices on real wires.")
@click.option("--wires", type=FILE, help=WIRES)
@click.option("--seconds", type=Range(min=0.1), help="End after so long (default: with Ctrl-C).")
@transcript_option
@json_option
def monitor(
    cell: Path, sim: bool, wires: Path | None, seconds: float | None, transcript: Path | None, as_json: bool
) -> int:
    """Show live what positioners and inputs of a CELL say: positions, following errors, forces, states, contacts.

    Reads only and never enables. Beside a running controller it listens to a CAN bus and asks nothing of the axes.
    With --json the last values are printed at the end.

    \b
    Example: docking monitor sim/cells/lab-can.toml --wires wires.json --sim --seconds 10
    """
    from docking.assemble.monitoring import monitor as watch
    from docking.assemble.monitoring import monitor_text

    screen = CLEAR if sys.stdout.isatty() else ""

    def show(values: dict[str, Any]) -> None:
        if not as_json:
            print_text(screen + monitor_text(values))

    values = watch(_request(cell, sim, wires, transcript), seconds, show)
    if as_json:
        print_json(values)
    return EXIT_OK


def _request(cell: Path, sim: bool, wires: Path | None, transcript: Path | None) -> Any:
    from docking.assemble.looking import LookRequest

    return LookRequest(cell, wire_choice(sim, wires), transcript=transcript, language=language())
