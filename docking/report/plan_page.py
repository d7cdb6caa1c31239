"""The planned moves as one self-contained HTML page: curves of every axis along each path."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from docking.errors import FileUnwritable
from docking.preview import StageMove, curves
from docking.report.figures import COLOURS, DASHES, LIMIT, panels, style, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<style>body{{font:15px/1.45 sans-serif;max-width:60em;margin:2em auto;padding:0 1em;color:#222}}
svg{{width:100%;height:auto}}pre{{overflow-x:auto;font-size:12px}}h2{{margin-top:2em}}</style></head>
<body><h1>{title}</h1><pre>{head}</pre>
{stages}
</body></html>
"""


LABELS = ("position / mm", "speed / mm/s", "acceleration / mm/s²", "jammed: force / N", "jammed: warp / N")


def write_plan_page(title: str, head: str, moves: Sequence[tuple[StageMove, str]], path: Path) -> None:
    """Write the page of `moves`, each with its table as text. Raises FileUnwritable."""
    with style():
        parts = [
            f"<h2>{escape(move.stage.name)}</h2>\n{_drawing(move, number)}\n<pre>{escape(text.strip())}</pre>"
            for number, (move, text) in enumerate(moves)
        ]
    page = PAGE.format(title=escape(title), head=escape(head), stages="\n".join(parts))
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise FileUnwritable(str(path), error.strerror or str(error)) from error


def _drawing(move: StageMove, number: int) -> str:
    figure, drawn = panels(7.2, len(LABELS), sharex=True)
    s, quantities = curves(move)
    axes = move.plan.axes
    for panel, label, values in zip(drawn, LABELS, quantities, strict=True):
        for k, axis in enumerate(axes):
            panel.plot(s, values[:, k], label=axis, **_line(axes, k))
        panel.set_ylabel(label)
        panel.set_xlim(0.0, 1.0)
    jam = move.jam.settings
    _limit(drawn[-2], jam.force_n)
    _limit(drawn[-1], jam.warp_n, *([jam.held_warp_n] if np.isfinite(move.jam.tolerance_mm).any() else []))
    drawn[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.02), ncols=6, borderaxespad=0.0)
    drawn[-1].set_xlabel("s")
    return svg(figure, f"plan{number}")


def _line(axes: tuple[str, ...], k: int) -> dict[str, Any]:
    """One colour a positioner, one dash an axis letter."""
    owners = list(dict.fromkeys(axis.rpartition(".")[0] for axis in axes))
    owner, _, letter = axes[k].rpartition(".")
    return {"color": COLOURS[owners.index(owner) % len(COLOURS)], "linestyle": DASHES["XYZ".index(letter)]}


def _limit(panel: Axes, *limits_n: float) -> None:
    """Where the limit is; a second one is that of axes that hold a force."""
    for limit_n in limits_n:
        panel.axhline(limit_n, color=LIMIT, linewidth=1.0, linestyle=(0, (4, 2)))
    panel.set_ylim(0.0, 1.1 * max(limits_n))
