"""Pictures of the report as inline SVG: text stays text, nothing is loaded from elsewhere.

matplotlib is imported inside the functions: it is heavy and needed only when a report is made.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN: Final = 8.4
COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#b5518f", "#c98a00", "#3a9bd0", "#222222", "#7a6a00")
DASHES: Final = ("-", (0, (5, 1.5)), (0, (2, 1)), (0, (6, 1.5, 1, 1.5)))
LIMIT: Final = "#b00020"
GREY: Final = "#767676"
STYLE: Final[Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "docking-report",
    "font.family": "sans-serif",
    "font.size": 8.5,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.edgecolor": "#8c8c8c",
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "lines.linewidth": 1.1,
    "text.parse_math": False,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "figure.dpi": 100,
}


@contextmanager
def style() -> Iterator[None]:
    """Draw and save every figure of a report inside this context."""
    from matplotlib import rc_context

    with rc_context(STYLE), warnings.catch_warnings():
        # Chinese words are drawn by the reader's browser; only their widths are estimated without the glyphs.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        yield


def panels(height_in: float, rows: int = 1, **shape: Any) -> tuple[Figure, list[Axes]]:
    """A figure of the page's width with `rows` panels one under the other."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    return figure, [row[0] for row in figure.subplots(rows, 1, squeeze=False, **shape)]


def svg(figure: Figure, mark: str) -> str:
    """A figure as an <svg> element; `mark` keeps its ids apart from those of other figures."""
    target = io.StringIO()
    figure.savefig(target, format="svg", metadata={"Date": None})
    return inline(target.getvalue(), mark)


def inline(text: str, mark: str) -> str:
    """Make a stand-alone SVG file a part of a page: no prolog, no metadata, no fixed size, no foreign address."""
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", text)
    text = text.replace("xlink:href", "href")
    text = re.sub(r'(<svg[^>]*?)\swidth="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?)\sheight="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'\bid="([^"]*)"', rf'id="{mark}-\1"', text)
    text = re.sub(r"url\(#([^)]*)\)", rf"url(#{mark}-\1)", text)
    text = re.sub(r'\bhref="#([^"]*)"', rf'href="#{mark}-\1"', text)
    text = re.sub(r'\s(?:d|x|y|points|transform|style)="[^"]*"', _rounded, text)
    return re.sub(r"\n\s*", "\n", text).strip()


def _rounded(attribute: re.Match[str]) -> str:
    """Coordinates to 1/100 point: finer than any screen or printer, a third of the size."""
    return re.sub(r"-?\d+\.\d{3,}", lambda m: f"{float(m[0]):.2f}", attribute[0])


def limit_line(panel: Axes, limit: float, reach: float, texts: tuple[str, str]) -> None:
    """Draw a limit where the data come near it, else name it over the panel and leave the scale to the data.

    `reach` is the largest magnitude shown; `texts` names the limit with its unit, alone and as off the scale.
    """
    if not limit > 0.0:
        return
    look: dict[str, Any] = {"color": LIMIT, "fontsize": 8.0, "textcoords": "offset points"}
    if not reach >= 0.2 * limit:
        panel.annotate(texts[1], (0.0, 1.0), (2.0, 11.0), xycoords="axes fraction", va="bottom", **look)
        return
    low, high = panel.get_ylim()
    for line in (limit, -limit) if low < 0.0 else (limit,):
        panel.axhline(line, color=LIMIT, linewidth=1.0, linestyle=(0, (4, 2)))
    panel.set_ylim(min(low, -1.08 * limit) if low < 0.0 else low, max(high, 1.08 * limit))
    panel.annotate(
        texts[0], (1.0, limit), (-3.0, -2.0), xycoords=("axes fraction", "data"), ha="right", va="top", **look
    )
