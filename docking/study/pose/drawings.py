"""The study's pictures: each stands for one table or figure of the paper."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from docking.report.figures import COLOURS, GREY, LIMIT, panels
from docking.study.pose.curves import AMPLITUDES_MM
from docking.study.pose.table import PAPER_MM

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_METHODS = (("svd", "SVD = least squares"), ("three-point", "three points, largest triangle"))
_THIN: dict[str, Any] = {"color": GREY, "linewidth": 0.7, "alpha": 0.8}


def drawings(result: dict[str, Any]) -> dict[str, Figure]:
    """Every picture by the name of its file."""
    figures = {
        "table-1": _table_1(result["table"]),
        "figure-2": _figure_2(result["counts"]),
        "figure-3": _figure_3(result["sizes"]),
        "starts": _starts(result["starts"]),
    }
    for figure in figures.values():
        _clear(figure)
    return figures


def _clear(figure: Figure) -> None:
    """No paper of its own: the page is light or dark."""
    figure.set_facecolor("none")
    for panel in figure.axes:
        panel.set_facecolor("none")
        panel.grid(color=GREY, alpha=0.35)
        panel.tick_params(color=GREY)


def _table_1(rows: list[dict[str, Any]]) -> Figure:
    figure, (panel,) = panels(2.9)
    for k, row in enumerate(rows):
        for m, (method, _) in enumerate(_METHODS):
            band, y = row[method], k + (m - 0.5) * 0.3
            panel.plot(
                (band["p5"], band["p95"]), (y, y), color=COLOURS[m], linewidth=5.0, alpha=0.35, solid_capstyle="butt"
            )
            panel.plot(band["p50"], y, "o", color=COLOURS[m], markersize=5.0)
    for m, (method, label) in enumerate(_METHODS):
        panel.axvline(PAPER_MM[method], color=COLOURS[m], linewidth=1.2, linestyle=(0, (4, 2)))
        note: dict[str, Any] = {"color": COLOURS[m], "fontsize": 8.0, "ha": ("right", "left")[m], "va": "bottom"}
        panel.annotate(
            f"paper {PAPER_MM[method]:.3f}",
            (PAPER_MM[method], -0.62),
            ((-3, 3)[m], 0),
            textcoords="offset points",
            **note,
        )
        panel.plot([], [], "o-", color=COLOURS[m], label=label)
    panel.set_yticks(range(len(rows)), [row["layout"] for row in rows])
    panel.set_ylim(len(rows) - 0.4, -0.9)
    panel.set_xlim(0.0, 1.55)
    panel.set_xlabel("fitting error (largest of ten points) / mm; bar 5 to 95 %, dot median")
    panel.legend(loc="center right")
    return figure


def _band(panel: Axes, x: Any, cells: list[dict[str, Any]], colour: str, label: str) -> None:
    low, middle, high = (np.array([cell[key] for cell in cells]) for key in ("p5", "p50", "p95"))
    panel.fill_between(x, low, high, color=colour, alpha=0.2, linewidth=0.0)
    panel.plot(x, middle, "o-", color=colour, markersize=3.5, label=f"{label}: median, 5 to 95 %")


def _figure_2(rows: list[dict[str, Any]]) -> Figure:
    figure, (top, bottom) = panels(5.6, 2, sharex=True)
    barrel = rows[0]
    for k, line in enumerate(barrel["single"]):
        top.plot(barrel["counts"], line, **_THIN, label="" if k else "single draws, as the paper's figure is one")
    _band(top, barrel["counts"], barrel["all"], COLOURS[0], "at all ten targets")
    _band(top, barrel["counts"], barrel["fitted"], COLOURS[2], "at the fitted targets")
    top.set_title(barrel["layout"])
    for k, row in enumerate(rows):
        bottom.plot(
            row["counts"], [c["p50"] for c in row["all"]], "o-", color=COLOURS[k], markersize=3.5, label=row["layout"]
        )
    bottom.set_title("medians at all ten targets")
    bottom.set_xlabel("points fitted")
    for panel in (top, bottom):
        panel.axvspan(6.5, 10.2, color=GREY, alpha=0.1, linewidth=0.0)
        panel.set_ylim(0.0, 2.2)
        panel.set_ylabel("fitting error / mm")
        panel.legend(loc="upper right")
    bottom.annotate("the paper: not fewer than 7", (6.6, 0.06), fontsize=8.0, color=LIMIT)
    return figure


def _figure_3(sizes: dict[str, Any]) -> Figure:
    figure, (top, bottom) = panels(5.6, 2, sharex=True, sharey=True)
    rows = [row for row in sizes["rows"] if row["amplitude_mm"] <= AMPLITUDES_MM[-1]]
    for panel, lines, label in (
        (top, sizes["scaled"], "one draw, scaled"),
        (bottom, sizes["fresh"], "a fresh draw at every amplitude"),
    ):
        _band(panel, AMPLITUDES_MM, rows, COLOURS[0], "many draws")
        for k, line in enumerate(lines[:3]):
            panel.plot(AMPLITUDES_MM, line, color=COLOURS[1], linewidth=0.9, label="" if k else label)
        panel.set_ylabel("fitting error / mm")
        panel.set_ylim(0.0, None)
        panel.legend(loc="upper left")
    top.set_title("the same errors, larger and larger")
    bottom.set_title("other errors every time: how the paper's curve comes to oscillate")
    bottom.set_xlabel("errors uniform in +- this / mm")
    return figure


def _starts(rows: list[dict[str, Any]]) -> Figure:
    figure, (panel,) = panels(2.9)
    names = list(dict.fromkeys(row["start"] for row in rows))
    looks = {"docking": COLOURS[0], "as printed": COLOURS[1]}
    for solver, colour in looks.items():
        for attitude, dash in (("any attitude", "-"), ("beta = 90 deg", (0, (3, 2)))):
            own = {row["start"]: row for row in rows if row["solver"] == solver and row["attitude"] == attitude}
            y = [own[name]["iterations"] if own[name]["iterations"] is not None else np.nan for name in names]
            panel.plot(
                range(len(names)), y, "o", linestyle=dash, color=colour, markersize=3.5, label=f"{solver}, {attitude}"
            )
    panel.set_xticks(range(len(names)), names)
    panel.set_ylabel("iterations (median)")
    panel.set_ylim(0.0, None)
    panel.legend(loc="upper left", ncols=2)
    return figure
