"""An instrument out of adjustment stops the docking before anything is located, and the cause is told in words."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from docking.cli import call
from tests.support.program import cell_copy


def test_a_collimation_error_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    bent = (".sim.toml", "[collimation]  # two-face error, 1 sigma [K]\nurad = ", "[collimation]\nurad = 900")
    assert call(["dry-run", str(cell_copy(tmp_path, "wing-modbus", bent)), "--json"]) == 1
    alarm = json.loads(capsys.readouterr().out)["alarms"][0]
    assert alarm["code"] == 3009
    assert "collimation beyond 3 sigma" in alarm["message"]
    assert "height index beyond" not in alarm["message"]
