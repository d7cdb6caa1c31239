"""Settings of the whole test session."""

from __future__ import annotations

import asyncio

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--all-cells", action="store_true", help="dock the full-size cells over real wires too, in real time"
    )


@pytest.fixture
def all_cells(request: pytest.FixtureRequest) -> bool:
    """Whether the full-size cells are asked for."""
    return bool(request.config.getoption("--all-cells"))


def pytest_configure() -> None:
    """Begin without an event loop: pytest-asyncio would make one to restore, never close it, and warn of it."""
    asyncio.set_event_loop(None)
