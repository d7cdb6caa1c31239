"""What a check of a file says: severity, key and text."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum


class Severity(Enum):
    """`ERROR` refuses the file; `WARNING` is shown."""

    ERROR = "error"
    WARNING = "warning"


@dataclass(frozen=True)
class Finding:
    """One statement about one key (`positioners[1].axes[0].stroke_mm`) of a file."""

    severity: Severity
    key: str
    text: str

    def __str__(self) -> str:
        return f"{self.key}: {self.text}"


def error(key: str, text: str) -> Finding:
    """A finding that refuses the file."""
    return Finding(Severity.ERROR, key, text)


def warning(key: str, text: str) -> Finding:
    """A finding that is shown but refuses nothing."""
    return Finding(Severity.WARNING, key, text)


def errors_of(findings: Iterable[Finding]) -> list[Finding]:
    """Those that refuse the file."""
    return [f for f in findings if f.severity is Severity.ERROR]
