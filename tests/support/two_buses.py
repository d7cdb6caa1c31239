"""The laboratory cell with its drives on two CAN buses: A and B on can0, C and D on can1."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

CELLS = Path(__file__).parents[2] / "sim" / "cells"
FIRST, SECOND = "can0", "can1"


def two_bus_files(folder: Path, skew_s: float = 0.001) -> Path:
    """Write cell, job and truth of the variant into `folder`; returns the cell file."""
    text = (CELLS / "lab-can.toml").read_text("utf-8")
    text = text.replace(
        'channel = "can0"\n', f'channel = "can0"\nfurther_channels = ["can1"]\nsync_skew_s = {skew_s}\n'
    )
    text, count = re.subn(r'(\[\[positioners\]\]\nname = "[CD]"\n)', rf'\1can_channel = "{SECOND}"\n', text)
    assert count == 2
    for suffix in ("job.toml", "sim.toml"):
        shutil.copy(CELLS / f"lab-can.{suffix}", folder / f"lab-can2.{suffix}")
    path = folder / "lab-can2.toml"
    path.write_text(text, "utf-8")
    return path
