"""Markers to print: an ArUco square with four circles, at true size, with its id and a bar to check the scale.

SVG is written as it is; PDF likewise, as one content stream a page: both hold exact lengths (1 pt = 25.4/72 mm).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from docking.errors import BadArgument, FileUnwritable
from docking.guidance.opencv import opencv

PAGES_MM = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "letter": (215.9, 279.4)}
MARGIN_MM = 10.0
BAR_MM = 100.0
_FOOT_MM = 14.0
_GAP_MM = 4.0
_LABEL_MM = 4.0
_MOST_MARKERS = 1000
_KAPPA = 0.5522847498307936
"""Control arm of the cubic that is nearest to a quarter of a unit circle."""
_CRISP = 'shape-rendering="crispEdges"'
"""Cells side by side without a grey seam between them."""


@dataclass(frozen=True)
class MarkerDrawing:
    """One kind of marker: dictionary, side of the black square, radius of the circles, their offset from the centre."""

    dictionary: str = "DICT_4X4_50"
    side_mm: float = 50.0
    radius_mm: float = 9.0
    offset_mm: float = 42.0

    @property
    def size_mm(self) -> float:
        """Side of the whole white square."""
        return 2.0 * (self.offset_mm + 1.75 * self.radius_mm)


class Rectangle(NamedTuple):
    """A filled rectangle, mm from the top-left corner of the page."""

    x_mm: float
    y_mm: float
    width_mm: float
    height_mm: float
    black: bool = True


class Disc(NamedTuple):
    """A black disc."""

    x_mm: float
    y_mm: float
    radius_mm: float


class Label(NamedTuple):
    """A text, left end of its base line."""

    x_mm: float
    y_mm: float
    text: str


Shape = Rectangle | Disc | Label


def read_ids(text: str) -> tuple[int, ...]:
    """Ids of a list such as `0-3,7`. Raises BadArgument."""
    ids: list[int] = []
    for part in text.split(","):
        first, _, last = part.strip().partition("-")
        if not (first.isascii() and first.isdigit()) or not (last == "" or (last.isascii() and last.isdigit())):
            raise BadArgument("--ids", "numbers and ranges, as in 0-3,7", value=text)
        if int(last or first) - int(first) not in range(_MOST_MARKERS):
            raise BadArgument("--ids", f"a range runs upwards and has at most {_MOST_MARKERS} markers", value=text)
        ids += range(int(first), int(last or first) + 1)
    if len(set(ids)) != len(ids):
        raise BadArgument("--ids", "a marker stands in it twice", value=text)
    return tuple(ids)


def code_bits(name: str, marker_id: int) -> list[list[bool]]:
    """The code with its black border, rows from the top, True = black. Raises BadArgument, ExtraMissing."""
    dictionary = predefined(name)
    if marker_id >= dictionary.bytesList.shape[0]:
        raise BadArgument("--ids", f"{name} has the markers 0 to {dictionary.bytesList.shape[0] - 1}", value=marker_id)
    cells = int(dictionary.markerSize) + 2
    image = opencv().aruco.generateImageMarker(dictionary, marker_id, cells, borderBits=1)
    return [[bool(value < 128) for value in row] for row in image]


def predefined(name: str) -> Any:
    """OpenCV's dictionary of this name. Raises BadArgument, ExtraMissing."""
    aruco = opencv().aruco
    if not (name.startswith("DICT_") and hasattr(aruco, name)):
        raise BadArgument("dictionary", "as OpenCV names them, for instance DICT_4X4_50", value=name)
    return aruco.getPredefinedDictionary(getattr(aruco, name))


def _checked(drawing: MarkerDrawing) -> None:
    half, radius, offset = drawing.side_mm / 2.0, drawing.radius_mm, drawing.offset_mm
    if not (min(half, radius) > 0.0) or not (drawing.size_mm < 2000.0):
        raise BadArgument("markers", "sizes are greater than 0 and the sheet at most 2 m", value=f"{drawing}")
    gap = (offset - half) * 2.0**0.5 - radius
    if not (gap >= radius * 0.5):
        cause = f"corner of the square to edge of a circle: at least {radius * 0.5:g} mm"
        raise BadArgument("--offset-mm", cause, value=f"{gap:.3f} mm are left")


def marker_shapes(drawing: MarkerDrawing, marker_id: int, x_mm: float, y_mm: float) -> list[Shape]:
    """All shapes of one marker whose centre is at (x, y) of the page."""
    bits = code_bits(drawing.dictionary, marker_id)
    cell, left, top = drawing.side_mm / len(bits), x_mm - drawing.side_mm / 2.0, y_mm - drawing.side_mm / 2.0
    shapes: list[Shape] = [Rectangle(left, top, drawing.side_mm, drawing.side_mm)]
    shapes += [
        Rectangle(left + column * cell, top + row * cell, cell, cell, black=False)
        for row, line in enumerate(bits)
        for column, black in enumerate(line)
        if not black
    ]
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    shapes += [Disc(x_mm + i * drawing.offset_mm, y_mm + j * drawing.offset_mm, drawing.radius_mm) for i, j in signs]
    text = f"{drawing.dictionary} id {marker_id}  side {drawing.side_mm:g}  r {drawing.radius_mm:g} mm"
    shapes.append(Label(left, y_mm + drawing.offset_mm + drawing.radius_mm + 1.2 * _LABEL_MM, text))
    return shapes


def sheets(ids: tuple[int, ...], drawing: MarkerDrawing, page_mm: tuple[float, float]) -> list[list[Shape]]:
    """The shapes of every page. Raises BadArgument when one marker does not fit."""
    _checked(drawing)
    pitch = drawing.size_mm + _GAP_MM
    room = (page_mm[0] - 2.0 * MARGIN_MM + _GAP_MM, page_mm[1] - 2.0 * MARGIN_MM - _FOOT_MM + _GAP_MM)
    columns, rows = int(room[0] // pitch), int(room[1] // pitch)
    if columns * rows == 0:
        raise BadArgument(
            "--page", f"a marker is {drawing.size_mm:g} mm wide", value=f"{page_mm[0]:g} x {page_mm[1]:g}"
        )
    pages = []
    for first in range(0, len(ids), columns * rows):
        shapes = _bar(page_mm)
        for k, marker_id in enumerate(ids[first : first + columns * rows]):
            x = MARGIN_MM + drawing.size_mm / 2.0 + pitch * (k % columns)
            y = MARGIN_MM + drawing.size_mm / 2.0 + pitch * (k // columns)
            shapes += marker_shapes(drawing, marker_id, x, y)
        pages.append(shapes)
    return pages


def _bar(page_mm: tuple[float, float]) -> list[Shape]:
    """A bar of 100 mm with ends, at the foot."""
    y = page_mm[1] - MARGIN_MM - 3.0
    return [
        Rectangle(MARGIN_MM, y, BAR_MM, 0.5),
        Rectangle(MARGIN_MM, y - 2.0, 0.25, 4.5),
        Rectangle(MARGIN_MM + BAR_MM - 0.25, y - 2.0, 0.25, 4.5),
        Label(MARGIN_MM + BAR_MM + 3.0, y + 1.5, f"{BAR_MM:g} mm over the ends: print at 100 %"),
    ]


def svg(shapes: list[Shape], page_mm: tuple[float, float]) -> str:
    """One page as SVG; its user unit is the mm."""
    width, height = page_mm
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}mm" height="{height:g}mm" '
        f'viewBox="0 0 {width:g} {height:g}">',
        f'<rect width="{width:g}" height="{height:g}" fill="white"/>',
    ]
    for shape in shapes:
        match shape:
            case Rectangle(x, y, w, h, black):
                colour = "black" if black else "white"
                size = f'width="{w:.6g}" height="{h:.6g}"'
                lines.append(f'<rect x="{x:.6g}" y="{y:.6g}" {size} fill="{colour}" {_CRISP}/>')
            case Disc(x, y, radius):
                lines.append(f'<circle cx="{x:.6g}" cy="{y:.6g}" r="{radius:.6g}" fill="black"/>')
            case Label(x, y, text):
                style = f'font-family="sans-serif" font-size="{_LABEL_MM:g}"'
                lines.append(f'<text x="{x:.6g}" y="{y:.6g}" {style}>{text}</text>')
    return "\n".join([*lines, "</svg>", ""])


def _pdf_content(shapes: list[Shape], height_mm: float) -> bytes:
    """Drawing commands of one page; the first makes the mm the unit and the top the origin's side."""
    lines = [f"{72.0 / 25.4:.10f} 0 0 {72.0 / 25.4:.10f} 0 0 cm"]
    for shape in shapes:
        match shape:
            case Rectangle(x, y, w, h, black):
                lines.append(f"{0 if black else 1} g {x:.6f} {height_mm - y - h:.6f} {w:.6f} {h:.6f} re f")
            case Disc(x, y, radius):
                lines.append("0 g " + _pdf_disc(x, height_mm - y, radius))
            case Label(x, y, text):
                size = f"/F1 {_LABEL_MM:g} Tf"
                lines.append(f"0 g BT {size} {x:.6f} {height_mm - y:.6f} Td ({text}) Tj ET")
    return "\n".join(lines).encode("ascii")


def _pdf_disc(x: float, y: float, r: float) -> str:
    """Four cubics: 0.03 % of the radius from the circle, 3 um on a marker."""
    k = r * _KAPPA
    corners = (
        (x + r, y + k, x + k, y + r, x, y + r),
        (x - k, y + r, x - r, y + k, x - r, y),
        (x - r, y - k, x - k, y - r, x, y - r),
        (x + k, y - r, x + r, y - k, x + r, y),
    )
    arcs = " ".join(" ".join(f"{value:.6f}" for value in corner) + " c" for corner in corners)
    return f"{x + r:.6f} {y:.6f} m {arcs} f"


def pdf(pages: list[list[Shape]], page_mm: tuple[float, float]) -> bytes:
    """All pages as one PDF."""
    box = f"[0 0 {page_mm[0] * 72.0 / 25.4:.4f} {page_mm[1] * 72.0 / 25.4:.4f}]"
    kids = " ".join(f"{4 + 2 * i} 0 R" for i in range(len(pages)))
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        f"<< /Type /Pages /Kids [{kids}] /Count {len(pages)} >>".encode(),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    for i, shapes in enumerate(pages):
        page = f"/Parent 2 0 R /MediaBox {box} /Contents {5 + 2 * i} 0 R /Resources << /Font << /F1 3 0 R >> >>"
        content = _pdf_content(shapes, page_mm[1])
        objects.append(f"<< /Type /Page {page} >>".encode())
        objects.append(f"<< /Length {len(content)} >>\nstream\n".encode() + content + b"\nendstream")
    return _pdf_file(objects)


def _pdf_file(objects: list[bytes]) -> bytes:
    data, offsets = b"%PDF-1.4\n", []
    for number, body in enumerate(objects, 1):
        offsets.append(len(data))
        data += f"{number} 0 obj\n".encode() + body + b"\nendobj\n"
    table = "".join(f"{offset:010d} 00000 n \n" for offset in offsets)
    size = len(objects) + 1
    tail = f"xref\n0 {size}\n0000000000 65535 f \n{table}trailer\n<< /Size {size} /Root 1 0 R >>\n"
    return data + f"{tail}startxref\n{len(data)}\n%%EOF\n".encode()


def write_sheets(out: Path, ids: tuple[int, ...], drawing: MarkerDrawing, page: str = "A4") -> list[Path]:
    """Write FILE.pdf (all pages) or FILE.svg, FILE-2.svg ... Raises BadArgument, FileUnwritable, ExtraMissing."""
    if out.suffix.lower() not in (".pdf", ".svg"):
        raise BadArgument("--out", "a file that ends with .pdf or .svg", value=str(out))
    page_mm = PAGES_MM[page]
    pages = sheets(ids, drawing, page_mm)
    if out.suffix.lower() == ".pdf":
        files = [(out, pdf(pages, page_mm))]
    else:
        names = [out] + [out.with_name(f"{out.stem}-{k}{out.suffix}") for k in range(2, len(pages) + 1)]
        files = [(name, svg(shapes, page_mm).encode()) for name, shapes in zip(names, pages, strict=True)]
    for name, data in files:
        try:
            name.write_bytes(data)
        except OSError as error:
            raise FileUnwritable(str(name), error.strerror or str(error)) from error
    return [name for name, _ in files]
