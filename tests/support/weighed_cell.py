"""The laboratory cells with their load cells on I/O modules, one a positioner, instead of on the axes' controllers."""

from __future__ import annotations

import shutil
from pathlib import Path

CELLS = Path(__file__).parents[2] / "sim" / "cells"
FIRST_NODE, FIRST_PORT = 41, 15051


def weighed_files(folder: Path, name: str) -> Path:
    """Write cell, job and truth of the variant into `folder`; returns the cell file."""
    text = (CELLS / f"{name}.toml").read_text("utf-8")
    modules, forces = [], []
    for number, station in enumerate("ABCD"):
        at = f'"modbus-io", host = "127.0.0.1", port = {FIRST_PORT + number}'
        if name == "lab-can":
            at = f'"cia401", node = {FIRST_NODE + number}, refresh_s = 0.01'
        modules.append(f'  {{ name = "force_{station}", kind = {at} }},\n')
        forces.append(
            f'  {{ name = "cell_{station}", positioner = "{station}", module = "force_{station}", '
            "channels = [0, 1, 2] },\n"
        )
    assert text.count("modules = [\n") == text.count("temperatures = [\n") == 1
    text = text.replace("modules = [\n", "modules = [\n" + "".join(modules))
    text = text.replace("temperatures = [\n", "forces = [\n" + "".join(forces) + "]\ntemperatures = [\n")
    for suffix in ("job.toml", "sim.toml"):
        shutil.copy(CELLS / f"{name}.{suffix}", folder / f"weighed.{suffix}")
    path = folder / "weighed.toml"
    path.write_text(text.replace(f'name = "{name}"\n', 'name = "weighed"\n'), "utf-8")
    return path
