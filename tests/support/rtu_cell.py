"""The laboratory cell with its positioner PLCs on one serial line (Modbus RTU)."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

CELLS = Path(__file__).parents[2] / "sim" / "cells"


def rtu_files(folder: Path, framing: str = "8E1", baud: int = 115200, poll_s: float = 0.1) -> Path:
    """Write cell, job and truth of the variant into `folder`; returns the cell file."""
    text = (CELLS / "lab-modbus.toml").read_text("utf-8")
    bus = f'kind = "modbus-rtu"\nline = "/dev/ttyUSB1"\nbaud = {baud}\nframing = "{framing}"\n'
    for old, fresh in (
        ('kind = "modbus-tcp"\n', bus),
        ("poll_s = 0.05\n# A", f"poll_s = {poll_s}\n# A"),
        ("watchdog_s = 0.12\n", "watchdog_s = 0.3\n"),
    ):
        assert text.count(old) == 1
        text = text.replace(old, fresh)
    for number, name in enumerate("ABCD", start=1):
        text = re.sub(rf'(name = "{name}"\n(?:(?!\[\[).*\n)*?unit = )1\n', rf"\g<1>{number}\n", text)
    # The modules of its inputs stay where they are: at TCP addresses.
    for suffix in ("job.toml", "sim.toml"):
        shutil.copy(CELLS / f"lab-modbus.{suffix}", folder / f"lab-rtu.{suffix}")
    path = folder / "lab-rtu.toml"
    path.write_text(text.replace('name = "lab-modbus"\n', 'name = "lab-rtu"\n'), "utf-8")
    return path
