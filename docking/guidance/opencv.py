"""OpenCV is an extra: the one place that imports it, and says how to get it where it is missing."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

from docking.errors import ExtraMissing


@cache
def opencv() -> Any:
    """The module `cv2`, single-threaded and with a fixed seed so that a map is the same twice. Raises ExtraMissing."""
    try:
        cv2 = import_module("cv2")
    except ImportError as error:
        raise ExtraMissing("guidance", str(error), value="OpenCV", limit="pip install '.[guidance]'") from error
    cv2.setNumThreads(1)
    cv2.setRNGSeed(1)
    return cv2
