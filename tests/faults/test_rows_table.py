"""The table of rows and tests beside this file names tests and labels that are there, and no row is missing."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
TABLE = (HERE / "README.md").read_text("utf-8")
LAST = {"TRK": 11, "CAN": 16, "MB": 8, "AX": 10, "PLN": 6, "IO": 2}
WHOLE = [f"{kind}-{n:02d}" for kind, last in LAST.items() for n in range(1, last + 1)]
ROWS = dict(re.findall(r"^\| ([A-Z]+-\d\d) \|[^|]*\| (.*) \|$", TABLE, re.MULTILINE))


def test_no_row_is_missing() -> None:
    assert list(ROWS) == WHOLE


@pytest.mark.parametrize("row", WHOLE)
def test_a_row_names_tests_that_are_there(row: str) -> None:
    named = re.findall(r"`([^`]*)::(\w+)`(?: \[([A-Z0-9-]+)\])?", ROWS[row])
    assert named
    for path, test, label in named:
        text = ((ROOT if "/" in path else HERE) / path).read_text("utf-8")
        assert re.search(rf"^(async )?def {test}\(", text, re.MULTILINE), f"{path} has no {test}"
        assert not label or f'"{label}' in text, f"{path} has no case {label}"
