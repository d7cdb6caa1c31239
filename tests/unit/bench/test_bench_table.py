"""The bench runs at tiny sizes and its table says what was met."""

from __future__ import annotations

import pytest

from tests.bench.__main__ import main
from tests.bench.metric import Metric, median_ratio
from tests.bench.registry import GROUPS
from tests.bench.table import table


def test_the_table_tells_on_which_side_of_the_target_a_ratio_lies() -> None:
    text = table(
        [
            Metric("P1", "frames", "300/s", "100/s", 3.0, 2.0),
            Metric("P2", "fit", "9 us", "4 us", 2.25, 2.0, at_least=False),
            Metric("P3", "nothing", "-", "-", float("nan"), 2.0, at_least=False),
        ]
    )
    head, _, *lines = text.splitlines()
    assert head.split() == ["metric", "product", "peer", "ratio", "target", "met"]
    assert [line.split()[-1] for line in lines] == ["yes", "NO", "NO"]
    assert [line[head.index("target") :].split()[:2] for line in lines] == [[">=", "2"], ["<=", "2"], ["<=", "2"]]


def test_ratios_are_taken_turn_by_turn() -> None:
    assert median_ratio([2.0, 8.0, 30.0], [1.0, 2.0, 10.0]) == 3.0


def test_all_groups_measure_at_tiny_sizes(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--tiny"])
    printed = capsys.readouterr().out
    for key in GROUPS:
        assert f"\n{key} " in printed
    for peer in ("trio MockClock", "looptime", "real", "with 1"):
        assert peer in printed


def test_an_unknown_group_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["P99"])
    assert "P99" in capsys.readouterr().err
