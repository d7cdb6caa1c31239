"""Point files: CSV with the header `name,x_mm,y_mm,z_mm` and, optionally, `sx_mm,sy_mm,sz_mm` (1 sigma a coordinate).

A point measured in several passes appears in several rows. Every fault names the line, the column and the value.
"""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path
from typing import Literal, NoReturn

import numpy as np

from docking.errors import BadPointFile, FileUnreadable
from docking.types import Points

_COORDINATES = ("x_mm", "y_mm", "z_mm")
_SIGMAS = ("sx_mm", "sy_mm", "sz_mm")
_HEADERS = (("name", *_COORDINATES), ("name", *_COORDINATES, *_SIGMAS))
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_LARGEST_MM = 1e7
_MOST_NAMES = 2000
"""More points than this are refused: the screening compares every pair."""
_MOST_BYTES = 64 * 1024 * 1024

Role = Literal["nominal", "measured"]


def _bad(path: Path, value: str, cause: str) -> NoReturn:
    raise BadPointFile(str(path), cause, value=value)


def _text(path: Path) -> str:
    """The file as text; a byte-order mark is dropped."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FileUnreadable(str(path), error.strerror or type(error).__name__) from error
    if len(data) > _MOST_BYTES:
        raise FileUnreadable(str(path), f"{len(data)} bytes, at most {_MOST_BYTES} are read")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileUnreadable(str(path), f"not UTF-8 text at byte {error.start}") from error


def _number(path: Path, line: int, column: str, text: str) -> float:
    """A finite decimal number in strict grammar, as `float` alone would also take nan, inf and 1_000."""
    value = float(text) if _NUMBER.fullmatch(text) else float("nan")
    if not (abs(value) <= _LARGEST_MM):
        _bad(path, f"line {line}, column {column}: {text!r}", "a finite decimal number of mm is needed")
    if column in _SIGMAS and not (value > 0.0):
        _bad(path, f"line {line}, column {column}: {text!r}", "a standard deviation is greater than zero")
    return value


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """(line number, stripped fields) of every row that is not blank."""
    reader = csv.reader(io.StringIO(_text(path), newline=""), strict=True)
    rows = []
    try:
        for fields in reader:
            stripped = [f.strip() for f in fields]
            if any(stripped):
                rows.append((reader.line_num, stripped))
    except csv.Error as error:
        _bad(path, f"line {reader.line_num}", f"not CSV: {error}")
    return rows


def _header(path: Path, rows: list[tuple[int, list[str]]]) -> tuple[str, ...]:
    if not rows:
        _bad(path, "the file is empty", "the header is missing")
    line, fields = rows[0]
    header = tuple(f.lower() for f in fields)
    if header not in _HEADERS:
        _bad(path, f"line {line}: {','.join(fields)[:80]!r}", "the header is not understood")
    return header


def read_points(path: Path, role: Role) -> Points:
    """Read a point file; the frame is what the file says it is. Without sigma columns covariances are NaN (not known).

    A nominal file names every point once. Raises FileUnreadable, BadPointFile.
    """
    rows = _rows(path)
    header = _header(path, rows)
    first_line: dict[str, int] = {}
    seen: dict[str, int] = {}
    names, values, passes = [], [], []
    for line, fields in rows[1:]:
        if len(fields) != len(header):
            _bad(path, f"line {line}: {len(fields)} fields", f"{len(header)} fields are needed: {','.join(header)}")
        name = fields[0]
        if not name:
            _bad(path, f"line {line}, column name: ''", "every point has a name")
        if role == "nominal" and name in first_line:
            _bad(
                path,
                f"line {line}, column name: {name!r}",
                f"already on line {first_line[name]}; a nominal point stands once",
            )
        first_line.setdefault(name, line)
        seen[name] = seen.get(name, 0) + 1
        passes.append(seen[name])
        names.append(name)
        values.append([_number(path, line, column, text) for column, text in zip(header[1:], fields[1:], strict=True)])
    if len(first_line) > _MOST_NAMES:
        _bad(path, f"{len(first_line)} points", f"at most {_MOST_NAMES} are screened")
    return _points(names, np.array(values, dtype=np.float64).reshape(len(names), len(header) - 1), passes)


def _points(names: list[str], table: np.ndarray[tuple[int, int], np.dtype[np.float64]], passes: list[int]) -> Points:
    sigma = table[:, 3:] if table.shape[1] == 6 else np.full((len(names), 3), np.nan)
    cov = np.full((len(names), 3, 3), np.nan) if table.shape[1] == 3 else sigma[:, :, None] ** 2 * np.eye(3)
    return Points(tuple(names), table[:, :3], cov, tuple(passes))
