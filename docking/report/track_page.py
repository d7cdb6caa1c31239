"""One followed recording as a self-contained HTML page: path, error with its predicted size, table of gaps."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from docking.report.figures import COLOURS, GREY, LIMIT, panels, style, svg
from docking.report.sheet import table, write_sheet
from docking.track_bodies import BodiesTracked, JointTrack, bodies_text
from docking.track_report import track_text
from docking.tracking.follow import Followed

_MOST_DRAWN = 4000
"""More points than this a curve are thinned: nobody sees them and the file stays small."""


def write_track_page(result: Followed, path: Path) -> None:
    """Write the page of one `docking track`. Raises FileUnwritable."""
    words = track_text(result).splitlines()
    head = [line for line in words if not line.startswith("  ")]
    with style():
        course, errors = _course(result), _errors(result)
    body = [
        *(f'<p class="{"bad" if line.startswith("ALARM") else ""}">{escape(line)}</p>' for line in head),
        "<h2>Path</h2>",
        f"<figure>{course}<figcaption>Estimate of the first point in W against the frames' time, its mean taken off; "
        "grey: where it was seen or would have been; bands: hidden.</figcaption></figure>",
        "<h2>Error</h2>",
        f"<figure>{errors}<figcaption>Distance to the recorded point, and the predicted 3-D standard deviation; "
        "logarithmic.</figcaption></figure>",
        "<h2>Gaps</h2>",
        _table(result),
    ]
    write_sheet(f"{result.recording.name} followed by {result.method}", body, path)


def write_bodies_page(result: BodiesTracked, path: Path) -> None:
    """Write the page of one `docking track` with several bodies. Raises FileUnwritable."""
    with style():
        figures = [("Predicted error of each body, its worst point.", _known(result))]
        figures += [(f"Hinge {j.first}:{j.second}, one sigma as a band.", _angle(j)) for j in result.joints if j.rows]
    body = [f"<p>{escape(line)}</p>" for line in bodies_text(result).splitlines()]
    body += [f"<figure>{drawing}<figcaption>{escape(text)}</figcaption></figure>" for text, drawing in figures]
    write_sheet(" and ".join(one.name for one in result.bodies), body, path)


def _known(result: BodiesTracked) -> str:
    figure, axes = panels(2.8)
    _clear(figure, axes)
    for k, one in enumerate(result.bodies):
        table = one.as_json()
        axes[0].plot(
            table["t_s"], table["predicted_sd_mm"], color=COLOURS[k % len(COLOURS)], linewidth=0.8, label=one.name
        )
    axes[0].set_ylabel("predicted sd / mm")
    axes[0].set_xlabel("t / s")
    axes[0].legend(loc="upper right")
    return svg(figure, "known")


def _angle(joint: JointTrack) -> str:
    figure, axes = panels(2.8)
    _clear(figure, axes)
    table = joint.as_json()
    t, angle, sd = (np.array(table[key]) for key in ("t_s", "angle_deg", "angle_sd_deg"))
    axes[0].fill_between(t, angle - sd, angle + sd, color=GREY, alpha=0.4, linewidth=0)
    axes[0].plot(t, angle, color=COLOURS[0], linewidth=0.8)
    axes[0].set_ylabel("angle / deg")
    axes[0].set_xlabel("t / s")
    return svg(figure, f"{joint.first}-{joint.second}")


def _thin(count: int) -> slice:
    return slice(None, None, max(1, count // _MOST_DRAWN))


def _bands(panel: Any, result: Followed) -> None:
    begin = result.recording.begin_s
    for gap in result.gaps:
        panel.axvspan(begin + gap.start_s, begin + gap.start_s + gap.length_s, color=GREY, alpha=0.15, linewidth=0)


def _course(result: Followed) -> str:
    figure, axes = panels(5.0, 3, sharex=True)
    _clear(figure, axes)
    path, truth = result.path, result.recording.points_W_mm[result.path.frame, 0]
    mean = np.nanmean(truth, axis=0)
    some = _thin(len(path.t_s))
    for k, (letter, panel) in enumerate(zip("xyz", axes, strict=True)):
        panel.plot(path.t_s[some], truth[some, k] - mean[k], color=GREY, linewidth=2.4, alpha=0.6)
        panel.plot(path.t_s[some], path.points_W_mm[some, 0, k] - mean[k], color=COLOURS[k], linewidth=0.9)
        panel.set_ylabel(f"{letter} / mm")
        reach = 1.3 * float(np.nanmax(np.abs(truth[:, k] - mean[k]))) + 1.0
        panel.set_ylim(-reach, reach)
        _bands(panel, result)
    axes[-1].set_xlabel("t / s")
    return svg(figure, "course")


def _errors(result: Followed) -> str:
    figure, axes = panels(2.8)
    _clear(figure, axes)
    path, panel = result.path, axes[0]
    error = np.linalg.norm(path.points_W_mm - result.recording.points_W_mm[path.frame], axis=2)
    worst = np.where(np.isfinite(error), error, -np.inf).max(axis=1)
    some = _thin(len(path.t_s))
    panel.semilogy(path.t_s[some], np.maximum(worst[some], 1e-3), color=COLOURS[0], linewidth=0.8, label="error")
    panel.semilogy(path.t_s[some], path.sd_mm[some].max(axis=1), color=LIMIT, linewidth=0.8, label="predicted sd")
    _bands(panel, result)
    panel.yaxis.set_major_formatter("{x:g}")
    panel.set_ylabel("mm")
    panel.set_xlabel("t / s")
    panel.legend(loc="upper right")
    return svg(figure, "errors")


def _clear(figure: Any, axes: list[Any]) -> None:
    figure.patch.set_alpha(0.0)
    for panel in axes:
        panel.patch.set_alpha(0.0)


def _table(result: Followed) -> str:
    head = ["start / s", "length / s", "", "end error / mm", "largest / mm", "predicted sd / mm", "hold-last / mm"]
    rows = [
        [f"{g.start_s:.2f}", f"{g.length_s:.2f}", "moving" if g.moving else "at rest", f"{g.end_error_mm:.3f}",
         f"{g.max_error_mm:.3f}", f"{g.predicted_sd_mm:.3f}", f"{g.hold_last_mm:.3f}"]
        for g in result.gaps
    ]  # fmt: skip
    return table(head, rows)
