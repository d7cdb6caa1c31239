"""Settings of the whole test session."""

from __future__ import annotations

import asyncio


def pytest_configure() -> None:
    """Begin without an event loop: pytest-asyncio would make one to restore, never close it, and warn of it."""
    asyncio.set_event_loop(None)
