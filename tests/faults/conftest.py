"""Settings of the fault suite: one parametrised case a row of the fault matrix, in virtual time.

Cases marked `full` belong to the full sets (`pytest tests/faults --full`).
"""

from __future__ import annotations

import logging

import pytest


@pytest.fixture(autouse=True)
def _no_library_complains(caplog):
    """What a library logs as a warning is a fault that nobody has looked at."""
    caplog.set_level(logging.WARNING)
    yield
    assert not [r.getMessage() for r in caplog.records if r.name.partition(".")[0] in ("asyncio", "pymodbus", "can")]
