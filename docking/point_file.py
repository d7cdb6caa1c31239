"""Point files: CSV with the header `name,x_mm,y_mm,z_mm` and, optionally, `sx_mm,sy_mm,sz_mm` (1 sigma a coordinate)
and `weight` (how much more the point counts in a fit).

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
_WEIGHT = "weight"
_PLAIN, _FULL = ("name", *_COORDINATES), ("name", *_COORDINATES, *_SIGMAS)
_HEADERS = (_PLAIN, _FULL)
_WEIGHTED = (*_HEADERS, (*_PLAIN, _WEIGHT), (*_FULL, _WEIGHT))
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
        cause = f"more than {_LARGEST_MM:.0e} mm" if _NUMBER.fullmatch(text) else "a decimal number of mm is needed"
        _bad(path, f"line {line}, column {column}: {text!r}", cause)
    if column in (*_SIGMAS, _WEIGHT) and not (value > 0.0):
        what = "a weight" if column == _WEIGHT else "a standard deviation"
        _bad(path, f"line {line}, column {column}: {text!r}", f"{what} is greater than zero")
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


def _header(
    path: Path, rows: list[tuple[int, list[str]]], known: tuple[tuple[str, ...], ...] = _WEIGHTED
) -> tuple[str, ...]:
    if not rows:
        _bad(path, "the file is empty", "the header is missing")
    line, fields = rows[0]
    header = tuple(f.lower() for f in fields)
    if header not in known:
        _bad(path, f"line {line}: {','.join(fields)[:80]!r}", _not_understood(header))
    return header


def _not_understood(header: tuple[str, ...]) -> str:
    """What is wrong with a header, as far as it can be told."""
    text = ",".join(header)
    for mark, word in ((";", "semicolons"), ("\t", "tabs")):
        if mark in text:
            return f"{word} separate its columns: commas are needed, and a point in numbers"
    needed = _FULL if any(column in header for column in _SIGMAS) else _PLAIN
    missing = [column for column in needed if column not in header]
    return f"missing: {', '.join(missing)}" if missing else "the header is not understood"


def read_points(path: Path, role: Role, *, weighted: bool = False) -> Points:
    """Read a point file; the frame is what the file says it is. Without sigma columns covariances are NaN (not known).

    A nominal file names every point once. A column of weights is refused unless `weighted`: who does not use weights
    must not pass over them; `read_weights` reads them. Raises FileUnreadable, BadPointFile.
    """
    rows = _rows(path)
    header = _header(path, rows, _WEIGHTED if weighted else _HEADERS)
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
    table = np.array(values, dtype=np.float64).reshape(len(names), len(header) - 1)
    return _points(names, table[:, : len(_FULL) - 1] if _SIGMAS[0] in header else table[:, :3], passes)


def read_weights(path: Path) -> dict[str, float]:
    """The weights of a point file by name; none where it has no such column.

    Raises FileUnreadable, BadPointFile also where the passes of a point differ in weight.
    """
    rows = _rows(path)
    header = _header(path, rows)
    weights: dict[str, float] = {}
    if header[-1] != _WEIGHT:
        return weights
    for line, fields in rows[1:]:
        weight = _number(path, line, _WEIGHT, fields[-1])
        if weights.setdefault(fields[0], weight) != weight:
            where = f"line {line}, column {_WEIGHT}: {fields[-1]!r}"
            _bad(path, where, f"{fields[0]} has the weight {weights[fields[0]]:g} further up; a point has one")
    return weights


def _points(names: list[str], table: np.ndarray[tuple[int, int], np.dtype[np.float64]], passes: list[int]) -> Points:
    sigma = table[:, 3:] if table.shape[1] == 6 else np.full((len(names), 3), np.nan)
    cov = np.full((len(names), 3, 3), np.nan) if table.shape[1] == 3 else sigma[:, :, None] ** 2 * np.eye(3)
    return Points(tuple(names), table[:, :3], cov, tuple(passes))
