"""Real measurements and what others published of them: `docking study real-data` against both."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.cli import call
from docking.study.real_data import study_real
from tests.data_truth.faro_bad_epochs import bad_epochs
from tests.support.shared_data import shared_data

DATA = shared_data()


@pytest.fixture(scope="module")
def published() -> dict[str, Any]:
    result = study_real(DATA)
    assert result["held"]
    return {row["set"]: row for row in result["sets"]}


def test_every_bad_epoch_is_found_and_no_good_one(published: dict[str, Any]) -> None:
    truth = bad_epochs(DATA / "faro_epochs")
    assert truth["floor"] == {"lost": [115, 133, 134, 143, 178], "wrong": [21, 50, 135]}
    for body, row in published["faro_epochs"]["bodies"].items():
        assert {key: row[key] for key in ("lost", "wrong")} == truth[body]
        assert row["epochs"] == 200
        assert row["rms_mm"] < 0.005
        assert row["largest_rms_mm"] < 0.03
    floor = published["faro_epochs"]["bodies"]["floor"]
    for k in truth["floor"]["lost"]:
        assert floor["named"][str(k)] == {"base_3": "lost-beam"}


def test_seven_parameters_are_the_printed_ones(published: dict[str, Any]) -> None:
    row = published["helmert3d"]
    assert row["off"]["rotation"] <= 1e-10
    assert row["off"]["translation"] <= 2e-4
    assert row["off"]["scale"] <= 1e-10
    assert row["scale"] - 1.0 == pytest.approx(7.9e-10, rel=0.01)
    theirs = np.loadtxt(DATA / "helmert3d" / "SK-42-SK-95-diff-1.0.5.txt")
    own = np.sqrt(np.mean(np.sum((theirs - theirs.mean(axis=0)) ** 2, axis=1)))
    assert row["rms_m"] == pytest.approx(own, abs=2e-6)


def test_module_shifts_are_the_published_ones(published: dict[str, Any]) -> None:
    row = published["clas12_svt"]
    assert (row["modules"], row["compared"], row["used"]) == (66, 66, 198)
    assert row["largest_difference_mm"] <= 3.4e-4
    assert row["rms_mm"] == pytest.approx(0.368, abs=0.001)


def test_a_tampered_epoch_is_noticed(tmp_path: Path) -> None:
    """One reading moved by 0.3 mm makes one more bad epoch, for the product and for the distances."""
    for file in (DATA / "faro_epochs").iterdir():
        table = np.loadtxt(file)
        if file.name == "measured_base_2.txt":
            table[60, 0] += 0.3
        np.savetxt(tmp_path / file.name, table)
    assert 60 in bad_epochs(tmp_path)["floor"]["wrong"]
    from docking.study.real_data import faro_epochs

    row = faro_epochs(tmp_path)
    assert row["held"]
    assert row["bad_epochs"] == [21, 50, 60, 115, 133, 134, 135, 143, 178]


def test_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert call(["study", "real-data", str(DATA), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["held"] is True
    assert call(["study", "real-data", str(DATA / "nothing"), "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["code"] == 4001
