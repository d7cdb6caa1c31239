"""`docking sim`: the simulated devices of a cell on real wires, until interrupted."""

from __future__ import annotations

import asyncio
import json
import tempfile
from pathlib import Path

from docking.assemble.real_time import on_interrupt, run_real
from docking.assemble.requests import RunRequest, Say, load_files, opened, prepare, writing
from docking.assemble.scenarios import runner_of, scenario_of
from docking.assemble.simulated import make_far_end, real_wires, truth_of
from docking.assemble.streams import stream_wires
from docking.words import tell
from sim.scenario import EventModel


def serve(request: RunRequest, wires_file: Path | None, say: Say, trace: Path | None = None) -> None:
    """Serve the simulated devices of a cell on real wires until interrupted; `trace` records how the axes move."""
    files = load_files(request)
    scenario = scenario_of(request.scenario, request.cell_path)
    for path in (wires_file, trace):
        if path is not None:
            prepare(path)
    with tempfile.TemporaryDirectory(prefix="docking-sim-") as folder:

        async def main() -> None:
            far = make_far_end(files.cell, files.job, truth_of(request.cell_path), request.seed)
            transcript = opened(request.transcript)
            found = await real_wires(files.cell, far, Path(folder), transcript)
            found |= stream_wires(files.cell, files.job, request.cell_path.parent, far)
            if trace is not None:
                with writing(trace):
                    far.trace(trace)
            asked_to_end = asyncio.Event()
            on_interrupt(asked_to_end.set)

            def told(what: str, event: EventModel) -> None:
                begins = tell(request.language, "scenario_begins", device=event.device, fault=event.fault)
                ends = tell(request.language, "scenario_ends", device=event.device, fault=event.fault)
                say(begins if what == "begins" else ends)

            if scenario is not None and request.scenario is not None:
                runner_of(scenario, request.scenario, files.cell, far, told)
            text = json.dumps(found, indent=2)
            if wires_file is not None:
                # Written whole and then renamed: a reader never meets half a file.
                part = wires_file.with_suffix(".part")
                with writing(wires_file):
                    part.write_text(text + "\n", "utf-8")
                    part.replace(wires_file)
            say(text)
            say(tell(request.language, "served"))
            try:
                await asked_to_end.wait()
            finally:
                await far.close()
                if transcript is not None:
                    transcript.close()

        run_real(main)
