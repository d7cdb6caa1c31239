"""Words and numbers of the report as a person reads them."""

from __future__ import annotations

import math
import tomllib
from functools import cache
from importlib import resources
from typing import Any

from docking.errors import BadArgument

LANGUAGES = ("en", "zh")
UNKNOWN = "–"


@cache
def words(language: str) -> dict[str, str]:
    """The report's words of one language. Raises BadArgument for a language without a catalogue."""
    if language not in LANGUAGES:
        raise BadArgument("report language", "no such catalogue", value=language, limit=", ".join(LANGUAGES))
    text = resources.files("docking.locale").joinpath(f"report.{language}.toml").read_text("utf-8")
    return tomllib.loads(text)


def number(value: Any, digits: int = 3) -> str:
    """A number with fixed decimals and a true minus sign; a dash when unknown."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return UNKNOWN
    text = f"{value:,.{digits}f}".replace(",", "\u202f")
    return text.replace("-", "−") if float(f"{value:.{digits}f}") else text.replace("-", "")


def signed(value: Any, digits: int = 3) -> str:
    """As `number`, with a plus sign on what is over zero."""
    text = number(value, digits)
    return f"+{text}" if text != UNKNOWN and float(f"{value:.{digits}f}") > 0.0 else text


def clock(seconds: Any) -> str:
    """A time in the run as h:mm:ss."""
    if not isinstance(seconds, int | float) or not math.isfinite(seconds):
        return UNKNOWN
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"


def plain(value: Any, digits: int = 4) -> str:
    """Any value of a record: numbers with a few significant digits, text as it is, a dash when unknown."""
    if isinstance(value, float):
        return number(value, 0) if abs(value) >= 1e5 else f"{value:.{digits}g}".replace("-", "−")
    return UNKNOWN if value is None or value == "" else str(value)


def css_string(text: str) -> str:
    """Text for the inside of a quoted CSS string: everything but letters, digits and spaces becomes an escape."""
    return "".join(c if c.isalnum() or c == " " else f"\\{ord(c):06x}" for c in text)
