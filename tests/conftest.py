"""Settings of the whole test session."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Generator

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--all-cells", action="store_true", help="dock the full-size cells over real wires too, in real time"
    )
    parser.addoption(
        "--hardware", metavar="CELL", help="a cell file: the tests marked hardware run on its real devices"
    )
    parser.addoption("--full", action="store_true", help="the full sets of cases that are marked so, not only a few")


NO_SKIPS = bool(os.environ.get("CI"))
"""In CI everything that a peer test needs is installed: one that is skipped has tested nothing."""


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """A whole file of peers that is skipped fails in CI."""
    report = yield
    if NO_SKIPS and report.skipped and "peers" in collector.path.parts:
        report.outcome = "failed"
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A peer test that is skipped fails in CI."""
    report = yield
    if NO_SKIPS and report.skipped and item.get_closest_marker("peer") and not hasattr(report, "wasxfail"):
        report.outcome = "failed"
    return report


@pytest.fixture
def all_cells(request: pytest.FixtureRequest) -> bool:
    """Whether the full-size cells are asked for."""
    return bool(request.config.getoption("--all-cells"))


def pytest_configure(config: pytest.Config) -> None:
    """Begin without an event loop: pytest-asyncio would make one to restore, never close it, and warn of it."""
    asyncio.set_event_loop(None)
    config.addinivalue_line("markers", "full: a case of a full set, run with --full only")
    config.addinivalue_line("markers", "hardware: runs on the real devices of --hardware CELL only")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave the cases marked `full` or `hardware` out unless they are asked for."""
    unasked = [marker for marker in ("full", "hardware") if not config.getoption(f"--{marker}")]
    left_out = [item for item in items if any(item.get_closest_marker(marker) for marker in unasked)]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]
