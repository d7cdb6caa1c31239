"""Check points and measured features: what is not seen does not count as agreeing."""

from __future__ import annotations

from pathlib import Path

import pytest

from docking.assemble.runs import RunRequest, dry_run_files, load_files
from docking.assemble.simulated import truth_of
from sim.instrument import Instrument, Shot

CELL = Path(__file__).parents[2] / "sim" / "cells" / "lab-can.toml"


@pytest.mark.parametrize(
    ("hidden", "codes"),
    [
        (("K01", "K02", "K03"), {3001}),
        (("upper-left.C",), {3007}),
        (("lower-right.M",), {3007}),
    ],
)
def test_what_cannot_be_seen_is_not_agreed_with(
    hidden: tuple[str, ...], codes: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    shoot = Instrument.shoot

    def blind(self: Instrument, name: str, t_s: float, face: int = 1) -> Shot:
        shot = shoot(self, name, t_s, face)
        lost = Shot("no-target", shot.name, shot.p_T_mm, shot.sigma_mm)
        return lost if name in hidden else shot

    monkeypatch.setattr(Instrument, "shoot", blind)
    request = RunRequest(CELL, None, 1, None, None, "en")
    summary = dry_run_files(load_files(request), truth_of(CELL), request, lambda text: None)
    assert (summary["outcome"], summary["moves"]) == ("refused", 0)
    assert {alarm["code"] for alarm in summary["alarms"]} == codes


def test_one_hidden_check_point_is_no_reason_to_refuse(monkeypatch: pytest.MonkeyPatch) -> None:
    shoot = Instrument.shoot

    def blind(self: Instrument, name: str, t_s: float, face: int = 1) -> Shot:
        shot = shoot(self, name, t_s, face)
        return Shot("no-target", shot.name, shot.p_T_mm, shot.sigma_mm) if name == "K02" else shot

    monkeypatch.setattr(Instrument, "shoot", blind)
    request = RunRequest(CELL, None, 1, None, None, "en")
    summary = dry_run_files(load_files(request), truth_of(CELL), request, lambda text: None)
    assert summary["outcome"] == "docked"
