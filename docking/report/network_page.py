"""An adjusted network as one self-contained HTML page: a map with uncertainties and residuals, and the tables."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from docking.calibration.network import Network
from docking.errors import FileUnwritable
from docking.network_report import network_text
from docking.report.figures import COLOURS, LIMIT, WIDTH_IN, style, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>Network</title>
<style>body{{font:15px/1.45 sans-serif;max-width:60em;margin:2em auto;padding:0 1em;color:#222}}
svg{{width:100%;height:auto}}pre{{overflow-x:auto;font-size:12px}}</style></head>
<body><h1>Network of {count} stations</h1>
{drawing}
<p>Plan and side view in W. Ellipses are one standard deviation of each point, {scale} times their true size; lines
from a point are the residuals of its observations, to the same scale, in the colour of the station.</p>
<pre>{text}</pre>
</body></html>
"""
_SHARE = 0.04


def write_network_page(network: Network, path: Path) -> None:
    """Write the page. Raises FileUnwritable."""
    from matplotlib.figure import Figure

    sigma = np.sqrt(np.linalg.eigvalsh(network.points.cov_mm2)[:, -1])
    scale = float(_SHARE * np.max(np.ptp(network.points.xyz_mm, axis=0)) / np.max(sigma))
    with style():
        figure = Figure(figsize=(WIDTH_IN, 1.1 * WIDTH_IN), layout="constrained")
        for panel, view in zip(figure.subplots(2, 1), ((0, 1), (0, 2)), strict=True):
            _view(panel, network, view, scale)
        drawing = svg(figure, "network")
    page = PAGE.format(
        count=len(network.stations), drawing=drawing, scale=f"{scale:.0f}", text=escape(network_text(network))
    )
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise FileUnwritable(str(path), error.strerror or str(error)) from error


def _view(panel: Axes, network: Network, view: tuple[int, int], scale: float) -> None:
    from matplotlib.patches import Ellipse

    across, up = view
    place = dict(zip(network.points.names, network.points.xyz_mm, strict=True))
    for name, cov in zip(network.points.names, network.points.cov_mm2, strict=True):
        values, vectors = np.linalg.eigh(cov[np.ix_(view, view)])
        turn = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
        size = [2.0 * scale * float(np.sqrt(value)) for value in reversed(values)]
        at = (place[name][across], place[name][up])
        shape = Ellipse(at, size[0], size[1], angle=turn)
        shape.set(facecolor="none", edgecolor="#444444", linewidth=0.8)
        panel.add_patch(shape)
        panel.annotate(name, at, (3.0, 3.0), textcoords="offset points", fontsize=6.5)
    colour = {name: COLOURS[k % len(COLOURS)] for k, name in enumerate(network.stations)}
    for (station, point), r in zip(network.observed, network.residuals_mm, strict=True):
        end = place[point] + scale * r
        at = [place[point][across], end[across]], [place[point][up], end[up]]
        panel.plot(*at, color=colour.get(station, LIMIT), linewidth=1.0)
    for name, X in zip(network.stations, network.poses, strict=True):
        panel.scatter([X.t_mm[across]], [X.t_mm[up]], s=45, marker="^", color=colour[name], label=name)
    panel.set_aspect("equal", adjustable="datalim")
    panel.set_xlabel(f"{'XYZ'[across]} / mm")
    panel.set_ylabel(f"{'XYZ'[up]} / mm")
    panel.legend(loc="upper right")
