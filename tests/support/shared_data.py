"""Where the real data lie that nobody on this project made; a test that needs them is skipped where they are absent."""

import os
from pathlib import Path

import pytest


def shared_data(*parts: str) -> Path:
    """The path of a file or folder among the real data: beside the checkout, or at DOCKING_TEST_DATA.

    Skips the test, or the whole file of tests that asks on import, where it is not there.
    """
    beside = Path(__file__).parents[3] / "shared" / "data"
    path = Path(os.environ.get("DOCKING_TEST_DATA") or beside).joinpath(*parts)
    if not path.exists():
        pytest.skip(f"the real data are not at {path}", allow_module_level=True)
    return path
