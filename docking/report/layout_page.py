"""The study of a layout as one self-contained HTML page: where the points are and how uncertain each thing will be."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from docking.errors import FileUnwritable
from docking.geometry import pose_from_vector
from docking.layout_study import LayoutStudy, direction_words, layout_text
from docking.pose.expected import normal_of
from docking.pose.least_squares import design
from docking.report.figures import COLOURS, GREY, LIMIT, WIDTH_IN, style, svg
from docking.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<style>body{{font:15px/1.45 sans-serif;max-width:60em;margin:2em auto;padding:0 1em;color:#222}}
svg{{width:100%;height:auto}}pre{{overflow-x:auto;font-size:12px}}h2{{margin-top:2em}}</style></head>
<body><h1>{title}</h1>
{drawing}
<p>Three views in the part's own axes. Ellipses are one standard deviation, {scale} times their true size: of a reading
with its nest (targets), of the whole error of a docking feature (features). Arrows: how the weakest direction of the
pose moves the features, to the same scale: {weak}. Grey lines point from the station to the targets.</p>
<pre>{text}</pre>
</body></html>
"""
VIEWS = ((0, 1), (0, 2), (1, 2))
TARGET, FEATURE, PLACE = COLOURS[0], COLOURS[1], COLOURS[2]
_SHARE = 0.08
"""Half axis of the largest ellipse in the page, as a share of the part's extent."""


def write_layout_page(study: LayoutStudy, path: Path) -> None:
    """Write the page of a study. Raises FileUnwritable."""
    with style():
        drawing, scale = _drawing(study)
    title = f"Targets of the {study.part} in {study.cell.name}"
    page = PAGE.format(
        title=escape(title),
        drawing=drawing,
        scale=f"{scale:.0f}",
        weak=escape(direction_words(study.weak[0])),
        text=escape(layout_text(study)),
    )
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise FileUnwritable(str(path), error.strerror or str(error)) from error


class _Scene:
    """Everything drawn, in the part's frame: points (n, 3), covariances (n, 3, 3), arrows (f, 3)."""

    def __init__(self, study: LayoutStudy) -> None:
        to_part = study.X_WN.inverse()
        normal = normal_of(study.layout)
        whole = design(study.aims.xyz_mm, normal.pivot_mm)
        cov = whole @ normal.cov() @ np.swapaxes(whole, 1, 2) + study.aims.rest_mm2
        turn = to_part.R
        weak = study.weak[0]
        self.names = study.layout.names
        self.targets, self.target_cov = to_part.apply(study.layout.xyz_mm), turn @ study.layout.cov_mm2 @ turn.T
        self.features, self.feature_cov = to_part.apply(study.aims.xyz_mm), turn @ cov @ turn.T
        self.feature_names = tuple(feature.name for feature in study.features)
        arm = self.features - to_part.apply(normal.pivot_mm)
        self.arrows: Array = np.cross(weak.rotation_rad, arm) + weak.translation_mm
        self.station = to_part.apply(pose_from_vector(study.cell.tracker.station_pose).t_mm)
        best = study.best_extra()[:1]
        self.best = to_part.apply(study.extra.xyz_mm[best])
        self.best_names = tuple(study.extra.names[i] for i in best)
        extent = float(np.max(np.ptp(np.vstack([self.targets, self.features]), axis=0)))
        largest = np.sqrt(np.max(np.linalg.eigvalsh(np.concatenate([self.target_cov, self.feature_cov]))))
        self.scale = float(_SHARE * extent / largest)


def _drawing(study: LayoutStudy) -> tuple[str, float]:
    from matplotlib.figure import Figure

    scene = _Scene(study)
    figure = Figure(figsize=(WIDTH_IN, 0.9 * WIDTH_IN), layout="constrained")
    panels = figure.subplots(2, 2).ravel()
    for panel, view in zip(panels, VIEWS, strict=False):
        _view(panel, scene, view)
    _legend(panels[3], scene)
    return svg(figure, "layout"), scene.scale


def _view(panel: Axes, scene: _Scene, view: tuple[int, int]) -> None:
    across, up = view
    for point in scene.targets:
        # A short piece of the line of sight shows where the station stands without shrinking the part to a dot.
        sight = (scene.station - point) / np.linalg.norm(scene.station - point)
        end = point + 0.15 * float(np.ptp(scene.targets[:, 0]) + np.ptp(scene.targets[:, 1])) * sight
        panel.plot([point[across], end[across]], [point[up], end[up]], color=GREY, linewidth=0.5)
    _ellipses(panel, scene.targets, scene.target_cov, (view, scene.scale, TARGET))
    _ellipses(panel, scene.features, scene.feature_cov, (view, scene.scale, FEATURE))
    panel.scatter(scene.targets[:, across], scene.targets[:, up], s=9, color=TARGET)
    panel.scatter(scene.features[:, across], scene.features[:, up], s=16, color=FEATURE, marker="D")
    panel.scatter(scene.best[:, across], scene.best[:, up], s=50, color=PLACE, marker="*")
    for tip, arrow in zip(scene.features, scene.scale * scene.arrows, strict=True):
        panel.annotate(
            "", (tip[across] + arrow[across], tip[up] + arrow[up]), (tip[across], tip[up]),
            arrowprops={"arrowstyle": "->", "color": LIMIT},
        )  # fmt: skip
    for name, point in zip(scene.names, scene.targets, strict=True):
        panel.annotate(name, (point[across], point[up]), (3.0, 3.0), textcoords="offset points", fontsize=6.5)
    panel.set_aspect("equal", adjustable="datalim")
    panel.set_xlabel(f"{'XYZ'[across]} / mm")
    panel.set_ylabel(f"{'XYZ'[up]} / mm")


def _ellipses(panel: Axes, points: Array, cov: Array, look: tuple[tuple[int, int], float, str]) -> None:
    from matplotlib.patches import Ellipse

    view, scale, colour = look
    for point, own in zip(points, cov, strict=True):
        values, vectors = np.linalg.eigh(own[np.ix_(view, view)])
        turn = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
        width, height = (2.0 * scale * float(np.sqrt(values[k])) for k in (1, 0))
        shape = Ellipse((point[view[0]], point[view[1]]), width, height, angle=turn)
        shape.set(facecolor="none", edgecolor=colour, linewidth=0.8)
        panel.add_patch(shape)


def _legend(panel: Axes, scene: _Scene) -> None:
    panel.scatter([], [], s=9, color=TARGET, label="target, with its sigma")
    panel.scatter([], [], s=16, color=FEATURE, marker="D", label="docking feature, with its whole sigma")
    panel.scatter(
        [], [], s=50, color=PLACE, marker="*", label=f"best place for one more: {', '.join(scene.best_names)}"
    )
    panel.plot([], [], color=LIMIT, label="weakest direction at the features")
    x, y, z = scene.station
    panel.plot([], [], color=GREY, linewidth=0.5, label=f"towards the station at ({x:.0f}, {y:.0f}, {z:.0f}) mm")
    panel.legend(loc="center")
    panel.axis("off")
