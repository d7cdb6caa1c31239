"""What the report draws: each function makes one picture from rows or traces and returns it as SVG text."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from docking.report.figures import COLOURS, DASHES, GREY, LIMIT, limit_line, panels, svg
from docking.report.run import Run
from docking.report.tables import Row, feature_rows, largest, numeric
from docking.report.traces import Track
from docking.report.words import plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Words = dict[str, str]


def _line_style(index: int) -> dict[str, Any]:
    return {"color": COLOURS[index % len(COLOURS)], "linestyle": DASHES[(index // len(COLOURS)) % len(DASHES)]}


def acceptance(rows: list[Row], words: Words) -> str:
    """Every feature's e with e + 2 sigma against its tolerance, one bar a feature."""
    figure, (panel,) = panels(0.75 + 0.3 * len(rows))
    places = np.arange(len(rows))
    for place, row in zip(places, rows, strict=True):
        colour = COLOURS[2] if row["inside"] else LIMIT
        panel.barh(place, row["e_mm"], height=0.42, color=colour, alpha=0.85)
        panel.plot([row["e_mm"], row["e2s_mm"]], [place, place], color="#222222", linewidth=1.4)
        panel.plot([row["e2s_mm"]], [place], marker="|", markersize=9, color="#222222")
        panel.plot([row["tolerance_mm"]] * 2, [place - 0.42, place + 0.42], color=LIMIT, linewidth=1.8)
    panel.set_yticks(places, [row["name"] for row in rows])
    panel.invert_yaxis()
    panel.set_xlim(left=0.0)
    panel.grid(visible=False, axis="y")
    panel.set_xlabel("e, e + 2σ, " + words["tolerance"] + " / mm")
    return svg(figure, "acc")


def convergence(run: Run, words: Words) -> str:
    """e with e +- 2 sigma of every feature at each judgement on a logarithmic scale, stages side by side."""
    bodies = run.bodies("features")
    tables = [feature_rows(body) for body in bodies]
    rows = [row for table in tables for row in table]
    tolerances = {row["tolerance_mm"] for row in rows if row["tolerance_mm"] > 0.0}
    floor_mm = 0.5 * min([row["e_mm"] for row in rows if row["e_mm"] > 0.0] + list(tolerances), default=1e-3)
    figure, (panel,) = panels(3.1)
    names = list(dict.fromkeys(row["name"] for row in rows))
    for i, name in enumerate(names):
        points = [(place, row) for place, table in enumerate(tables) for row in table if row["name"] == name]
        shift = 0.5 * ((i + 0.5) / len(names) - 0.5)
        _whiskers(panel, [(place + shift, row) for place, row in points], floor_mm, i)
    panel.set_yscale("log")
    panel.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    panel.yaxis.set_minor_formatter(lambda value, _: "")
    panel.set_ylim(floor_mm, 2.0 * max([row["e2s_mm"] for row in rows if row["e2s_mm"] > 0.0], default=1.0))
    panel.set_xlim(-0.6, max(len(bodies), 4) - 0.4)
    for tolerance in tolerances:
        panel.axhline(tolerance, color=LIMIT, linewidth=1.1, linestyle=(0, (4, 2)))
    _stages(panel, bodies, words)
    panel.set_ylabel(words["ax_error"] + " / mm")
    _legend(panel, names)
    return svg(figure, "con")


def _whiskers(panel: Axes, points: list[tuple[float, Row]], floor_mm: float, index: int) -> None:
    """One feature's e and e +- 2 sigma at its places; whiskers end at the floor of the logarithmic scale."""
    x = np.array([place for place, _ in points])
    e = np.array([row["e_mm"] for _, row in points])
    reach = 2.0 * np.array([row["sigma_mm"] for _, row in points])
    lower = np.minimum(reach, np.maximum(e - floor_mm, 0.0))
    shape: dict[str, Any] = {"fmt": "o", "markersize": 3.2, "capsize": 2.0, "elinewidth": 0.9}
    panel.errorbar(x, e, yerr=(lower, reach), label=points[0][1]["name"], color=COLOURS[index % len(COLOURS)], **shape)


def _stages(panel: Axes, bodies: list[dict[str, Any]], words: Words) -> None:
    """Name the judgements and part the stages."""
    for place in range(1, len(bodies)):
        if bodies[place].get("stage") != bodies[place - 1].get("stage"):
            panel.axvline(place - 0.5, color="#bdbdbd", linewidth=0.8)
    labels = [f"{body.get('stage')}\n{words.get(str(body.get('when')), body.get('when'))}" for body in bodies]
    panel.set_xticks(range(len(bodies)), labels, rotation=45 if len(bodies) > 8 else 0)
    panel.grid(visible=False, axis="x")


def residuals(groups: list[tuple[str, dict[str, list[float]]]], words: Words) -> str:
    """dx, dy, dz of every target, one panel a fit."""
    height = 0.55 + sum(0.42 + 0.17 * len(points) for _, points in groups)
    figure, drawn = panels(height, len(groups), sharex=True, height_ratios=[len(points) + 1 for _, points in groups])
    reach = max(0.01, largest([v for _, points in groups for vector in points.values() for v in vector]))
    for panel, (what, points) in zip(drawn, groups, strict=True):
        places = np.arange(len(points))
        for k, letter in enumerate("xyz"):
            values = [vector[k] for vector in points.values()]
            panel.plot(values, places, "os^"[k], markersize=4.0, color=COLOURS[k], label=f"d{letter}", alpha=0.9)
        panel.axvline(0.0, color=GREY, linewidth=0.8)
        panel.set_yticks(places, list(points))
        panel.set_ylim(len(points) - 0.5, -0.5)
        panel.set_xlim(-1.15 * reach, 1.15 * reach)
        panel.set_title(words.get(f"fit_{what}", what))
    drawn[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, handletextpad=0.2, borderaxespad=0.0)
    drawn[-1].set_xlabel(words["ax_deviation"] + " / mm")
    return svg(figure, "res")


def axis_lines(track: Track, axes: list[str], key: str, limits: Row, words: Words) -> str:
    """One quantity of every axis over time in motion, one panel an axis letter, one colour a positioner.

    `limits` holds the quantity's `unit` and `label` and its limit for all axes ("all") or for an axis letter.
    """
    letters = list(dict.fromkeys(axis.rpartition(".")[2] for axis in axes))
    owners = list(dict.fromkeys(axis.rpartition(".")[0] for axis in axes))
    figure, drawn = panels(0.5 + 1.45 * len(letters), len(letters), sharex=True)
    for panel, letter in zip(drawn, letters, strict=True):
        reach = 0.0
        for axis in (axis for axis in axes if axis.rpartition(".")[2] == letter):
            t, v = track.line(key, axis)
            if key == "position_mm" and len(v):
                v = v - v[0]
            owner = axis.rpartition(".")[0]
            panel.plot(t, v, label=owner, **_line_style(owners.index(owner)))
            reach = max(reach, float(np.nanmax(np.abs(v))) if np.isfinite(v).any() else 0.0)
        panel.set_ylabel(f"{letter}: {limits['label']} / {limits['unit']}")
        _moves(panel, track)
        limit = numeric(limits.get("all", limits.get(letter)))
        limit_line(panel, limit, reach, _limit_texts(f"±{plain(limit)} {limits.get('unit')}", words))
    _legend(drawn[0], owners, 1.13)
    drawn[-1].set_xlabel(words["time_in_motion"] + " / s")
    return svg(figure, key)


def coupling(track: Track, limits: Row, words: Words) -> str:
    """Consistency residual and internal force over time in motion, each with its limit."""
    figure, drawn = panels(3.4, 2, sharex=True)
    quantities = (
        ("residual_mm", "ax_residual", "mm", "ball_residual_mm"),
        ("internal_force_n", "ax_internal", "N", "internal_force_n"),
    )
    for panel, (key, label, unit, limit_key) in zip(drawn, quantities, strict=True):
        t, v = track.line(key)
        panel.plot(t, v, color=COLOURS[0])
        panel.set_ylabel(f"{words[label]} / {unit}")
        panel.set_ylim(bottom=0.0)
        limit = numeric(limits.get(limit_key))
        limit_line(panel, limit, largest(v.tolist()), _limit_texts(f"{plain(limit)} {unit}", words))
        _moves(panel, track)
    drawn[-1].set_xlabel(words["time_in_motion"] + " / s")
    return svg(figure, "cou")


def states(run: Run, words: Words) -> str:
    """The state of the cell over the run, alarms as red lines."""
    changes = [(run.age_s(record), str(record["body"].get("to"))) for record in run.of("state")]
    if not changes:
        return ""
    end_s = max(run.age_s(run.records[-1]), changes[-1][0])
    names = list(dict.fromkeys(name for _, name in changes))
    figure, (panel,) = panels(0.8 + 0.19 * len(names))
    for (begin_s, name), (stop_s, _) in zip(changes, [*changes[1:], (end_s, "")], strict=True):
        panel.barh(names.index(name), max(stop_s - begin_s, 0.002 * end_s) / 60.0, left=begin_s / 60.0, height=0.62)
        panel.patches[-1].set_color(LIMIT if name.lower() in ("fault", "stopping") else COLOURS[0])
    for record in run.of("alarm"):
        panel.axvline(run.age_s(record) / 60.0, color=LIMIT, linewidth=1.2)
    panel.set_yticks(range(len(names)), names)
    panel.invert_yaxis()
    panel.set_xlabel(words["ax_time"] + " / min")
    return svg(figure, "sta")


def _moves(panel: Axes, track: Track) -> None:
    """Number the moves and part them by dotted lines."""
    total_s = track.ends_s[-1]
    for move, start_s, end_s in zip(track.moves, track.starts_s, track.ends_s, strict=True):
        panel.axvline(start_s, color="#9a9a9a", linewidth=0.6, linestyle=(0, (1, 2)))
        if end_s - start_s > 0.015 * total_s:
            panel.annotate(
                str(move.number),
                ((start_s + end_s) / 2.0, 1.0),
                xycoords=("data", "axes fraction"),
                ha="center",
                va="bottom",
                fontsize=7.5,
                color=GREY,
            )
    panel.set_xlim(0.0, total_s if math.isfinite(total_s) and total_s > 0.0 else 1.0)


def _limit_texts(limit: str, words: Words) -> tuple[str, str]:
    return f"{words['limit']} {limit}", words["limit_off"].format(limit=limit)


def _legend(panel: Axes, names: list[str], height: float = 1.02) -> None:
    columns = max(1, min(len(names), 8))
    panel.legend(loc="lower right", bbox_to_anchor=(1.0, height), ncols=columns, borderaxespad=0.0)
