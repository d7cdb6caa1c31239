"""Files a user hands over: the camera's calibration (TOML) and the layout of the markers (CSV)."""

from __future__ import annotations

import csv
import re
import tomllib
from pathlib import Path

import numpy as np

from docking.errors import BadMarkerFile, ConfigInvalid, FileUnreadable
from docking.guidance.types import Camera, MarkerLayout

CIRCLES = 4
SURVEY_SIGMA_MM = 0.2
"""Where the file states none: a laser tracker on a printed circle."""
_COLUMNS = ["marker_id", "circle", "x_mm", "y_mm", "z_mm"]
_SIGMAS = ["sx_mm", "sy_mm", "sz_mm"]
_NEEDED = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")
_LARGEST_MM = 1e7
_HEADER = re.compile(
    r"(?P<dictionary>DICT_\w+).*?side\s+(?P<side>[\d.]+)\s*mm.*?radius\s+(?P<radius>[\d.]+)\s*mm"
    r".*?\(\+-(?P<offset>[\d.]+)"
)


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8-sig")
    except OSError as error:
        raise FileUnreadable(str(path), error.strerror or type(error).__name__) from error
    except UnicodeDecodeError as error:
        raise FileUnreadable(str(path), f"not UTF-8 text at byte {error.start}") from error


def read_camera(path: Path) -> Camera:
    """The calibration: width_px, height_px, fx_px, fy_px, cx_px, cy_px, distortion = [k1, k2, p1, p2(, k3)]."""
    try:
        table = tomllib.loads(_text(path))
    except tomllib.TOMLDecodeError as error:
        raise ConfigInvalid(str(path), (str(error),)) from error
    problems = [f"{key}: missing" for key in _NEEDED if key not in table]
    problems += [f"{key}: unknown" for key in table if key not in (*_NEEDED, "distortion")]
    values = {key: table.get(key, 1.0) for key in _NEEDED}
    problems += [f"{key}: a number greater than 0 is needed" for key, v in values.items() if not _positive(v)]
    distortion = table.get("distortion", [0.0] * 5)
    if not (isinstance(distortion, list) and len(distortion) in (4, 5) and all(_number(v) for v in distortion)):
        problems.append("distortion: four or five numbers k1, k2, p1, p2(, k3) are needed")
    if problems:
        raise ConfigInvalid(str(path), tuple(problems))
    sizes = (int(values["width_px"]), int(values["height_px"]))
    return Camera(*sizes, *(float(values[key]) for key in _NEEDED[2:]), *(float(v) for v in distortion))


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e6


def _positive(value: object) -> bool:
    return _number(value) and value > 0  # type: ignore[operator]


def read_layout(path: Path) -> MarkerLayout:
    """Measured circle centres: `marker_id,circle,x_mm,y_mm,z_mm[,sx_mm,sy_mm,sz_mm]`, four rows a marker.

    A comment line states the marker itself: `# DICT_4X4_50, ArUco side 50 mm, circles radius 9 mm at (+-42, +-42) mm`.
    Raises FileUnreadable, BadMarkerFile (line and column named).
    """
    comments, rows = _rows(path)
    header = _HEADER.search(" ".join(comments))
    if header is None:
        cause = "a comment must say: DICT_..., ArUco side S mm, circles radius R mm at (+-O, +-O) mm"
        raise BadMarkerFile(str(path), cause, value="no description of the marker")
    if not rows or rows[0][1] not in (_COLUMNS, _COLUMNS + _SIGMAS):
        raise BadMarkerFile(str(path), ",".join(_COLUMNS), value="the header is not understood")
    centres: dict[tuple[int, int], list[float]] = {}
    for line, fields in rows[1:]:
        key, values = _row(path, line, fields, len(rows[0][1]))
        if key in centres:
            raise BadMarkerFile(str(path), "this circle stands in the file already", value=f"line {line}")
        centres[key] = values
    ids = tuple(sorted({marker for marker, _ in centres}))
    missing = [f"{marker}/{circle}" for marker in ids for circle in range(CIRCLES) if (marker, circle) not in centres]
    if missing or not ids:
        raise BadMarkerFile(str(path), "each marker has the circles 0 to 3", value=f"missing: {', '.join(missing)}")
    table = np.array([[centres[marker, circle] for circle in range(CIRCLES)] for marker in ids])
    name, sizes = header["dictionary"], (float(header[key]) for key in ("side", "radius", "offset"))
    return MarkerLayout(ids, table[..., :3], table[..., 3:], name, *sizes)


def _rows(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """(comments, (line, fields) of all other rows)."""
    lines = [(number, line.strip()) for number, line in enumerate(_text(path).splitlines(), 1) if line.strip()]
    comments = [line for _, line in lines if line.startswith("#")]
    rows = [(n, [f.strip() for f in next(csv.reader([line]))]) for n, line in lines if not line.startswith("#")]
    return comments, rows


def _row(path: Path, line: int, fields: list[str], columns: int) -> tuple[tuple[int, int], list[float]]:
    """((marker, circle), x, y, z, sx, sy, sz) of one row."""
    try:
        key, values = (int(fields[0]), int(fields[1])), [float(text) for text in fields[2:]]
    except (ValueError, IndexError) as error:
        raise BadMarkerFile(str(path), str(error), value=f"line {line}") from error
    if len(fields) != columns or key[0] < 0 or key[1] not in range(CIRCLES):
        raise BadMarkerFile(str(path), f"{columns} columns, circle 0 to 3", value=f"line {line}")
    sigmas = values[3:] or [SURVEY_SIGMA_MM] * 3
    if not (max(abs(v) for v in values) <= _LARGEST_MM) or not (min(sigmas) > 0.0):
        raise BadMarkerFile(str(path), "finite mm and sigmas greater than 0 are needed", value=f"line {line}")
    return key, values[:3] + sigmas
