"""One fit as a self-contained HTML page: residual vectors in space, histogram, tables; readable by day and by night."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from docking.fit_report import FitResult, fit_json, judgement_lines
from docking.pose.uncertainty import total_cov_mm2
from docking.report.figures import COLOURS, GREY, LIMIT, WIDTH_IN, panels, style, svg
from docking.report.sheet import table, write_sheet
from docking.types import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_NAMED = 60
"""More points than this are drawn without names: nobody could read them."""
_SHARE = 0.15
"""Length of the longest drawn residual, as a share of the part's extent."""


def write_fit_page(result: FitResult, title: str, path: Path) -> None:
    """Write the page of one `docking fit`, a refused one too. Raises FileUnwritable."""
    answer = fit_json(result)
    parts = _refused(answer) if answer["refused"] else _fitted(result, answer)
    parts += _rejected("Rejected points", answer["rejected"]) + _rejected(
        "Readings left out", answer["dropped_readings"]
    )
    write_sheet(title, parts, path)


def _refused(answer: dict[str, Any]) -> list[str]:
    why = escape(f"No pose: {answer['refused_code']}: {answer['refused']}")
    return [f'<p class="bad">{why}</p>', f"<p>{escape(answer['remedy'])}</p>"]


def _fitted(result: FitResult, answer: dict[str, Any]) -> list[str]:
    pose, sigma = answer["pose"], answer["sigma"]
    rows = [
        [name, f"{pose[name]:.6f}", "-" if sigma[name] is None else f"{sigma[name]:.6f}"]
        for name in ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")
    ]
    with style():
        vectors, factor = _vectors(result)
        spread = _histogram(result)
    used = f"{len(answer['used'])} points, method {answer['method']}, rms {answer['rms_mm']:.4f} mm, "
    lines = [used + f"largest {answer['max_mm']:.4f} mm", *judgement_lines(answer)[1:]]
    return [
        *(f"<p>{escape(line)}</p>" for line in lines),
        "<h2>Pose of the nominal in the measured frame</h2>",
        '<p class="soft">R = Rz(gamma) Ry(beta) Rx(alpha)</p>',
        table(["", "value", "1 sigma"], rows),
        "<h2>Residuals</h2>",
        f"<figure>{vectors}<figcaption>Measured minus fitted at every used point, {factor:,.10g} times its true "
        "length, in the nominal frame; crosses are rejected points at their nominal place, thin lines lead to the "
        "floor.</figcaption></figure>",
        f"<figure>{spread}<figcaption>Residuals along the axes of the measured frame.</figcaption></figure>",
        _residual_table(result),
    ]


def _vectors(result: FitResult) -> tuple[str, float]:
    """Residuals as arrows in space, and how much longer than true they are drawn."""
    from matplotlib.figure import Figure

    assert result.fit is not None
    assert result.screened is not None
    figure = Figure(figsize=(WIDTH_IN, 0.62 * WIDTH_IN), facecolor="none")
    panel: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="3d", facecolor="none")
    at, arrows = result.screened.nominal_mm, result.fit.residuals_mm @ result.fit.X_MN.R
    factor = _two_digits(_SHARE * float(np.max(np.ptp(at, axis=0))) / max(result.fit.max_mm, 1e-9))
    out = {r.name for r in result.fit.rejected}
    crosses = result.nominal.xyz_mm[[name in out for name in result.nominal.names]]
    everything = np.vstack([at, crosses, at + factor * arrows])
    floor = float(np.min(everything[:, 2]))
    named = len(at) + len(crosses) <= _MOST_NAMED
    for x, y, z in np.vstack([at, crosses]) if named else ():
        panel.plot((x, x), (y, y), (z, floor), color=GREY, linewidth=0.6, alpha=0.6)
    panel.scatter(*at.T, s=12, color=COLOURS[0], depthshade=False)
    panel.quiver(*at.T, *(factor * arrows).T, color=COLOURS[1], linewidth=1.4, arrow_length_ratio=0.2)
    panel.scatter(*crosses.T, s=30, color=LIMIT, marker="x", depthshade=False)
    for name, place in zip(result.nominal.names, result.nominal.xyz_mm, strict=True) if named else ():
        panel.text(*place, f"  {name}", fontsize=7.0, va="bottom")
    _quiet(panel, everything)
    return svg(figure, "vectors"), factor


def _two_digits(value: float) -> float:
    """A magnification that can be said: 15000, not 15300.7."""
    return float(f"{value:.1e}")


def _quiet(panel: Any, points: Array) -> None:
    """Equal scales; walls and grid that suit a light and a dark page; few ticks."""
    from matplotlib.ticker import MaxNLocator

    extent = np.ptp(points, axis=0)
    shares = np.maximum(extent / float(np.max(extent)), 0.05)
    # A long part fills the width; a part as high as it is long has to leave room for its corners and scales.
    tallness = float(shares[2] / np.linalg.norm(shares))
    panel.set_box_aspect(shares, zoom=1.15 - 0.6 * tallness)
    panel.set_proj_type("ortho")
    for letter, axis, share in zip("XYZ", (panel.xaxis, panel.yaxis, panel.zaxis), shares, strict=True):
        axis.set_pane_color((0.5, 0.5, 0.5, 0.06))
        axis.set_label_text(f"{letter} / mm")
        axis.line.set_color(GREY)
        axis.set_tick_params(color=GREY)
        axis.set_major_locator(MaxNLocator(max(2, round(6 * float(share)))))


def _histogram(result: FitResult) -> str:
    from matplotlib.ticker import MaxNLocator

    assert result.fit is not None
    figure, (panel,) = panels(2.4)
    _clear(figure)
    reach = 1.05 * max(float(np.max(np.abs(result.fit.residuals_mm))), 1e-9)
    bins = np.linspace(-reach, reach, 2 * min(4 + len(result.fit.names) // 8, 20) + 1)
    look: dict[str, Any] = {"color": COLOURS[:3], "label": ("dx", "dy", "dz"), "stacked": True}
    panel.hist(list(result.fit.residuals_mm.T), bins=bins.tolist(), alpha=0.75, linewidth=0.0, **look)
    panel.axvline(0.0, color=GREY, linewidth=0.8)
    panel.set_xlabel("residual / mm")
    panel.set_ylabel("coordinates")
    panel.yaxis.set_major_locator(MaxNLocator(integer=True))
    panel.legend(loc="upper right")
    return svg(figure, "histogram")


def _clear(figure: Figure) -> None:
    figure.set_facecolor("none")
    for panel in figure.axes:
        panel.set_facecolor("none")
        panel.grid(color=GREY, alpha=0.35)
        panel.tick_params(color=GREY)


def _residual_table(result: FitResult) -> str:
    assert result.fit is not None
    assert result.screened is not None
    s = total_cov_mm2(result.screened.nominal_cov_mm2, result.screened.measured_cov_mm2, result.fit.X_MN.R)
    sigma = np.sqrt(s[:, range(3), range(3)])
    rows = [
        [name, *(f"{v:+.4f}" for v in r), f"{float(np.linalg.norm(r)):.4f}", *(f"{v:.4f}" for v in own)]
        for name, r, own in zip(result.fit.names, result.fit.residuals_mm, sigma, strict=True)
    ]
    return table(
        ["point", "dx / mm", "dy / mm", "dz / mm", "length / mm", "sigma x / mm", "sigma y / mm", "sigma z / mm"], rows
    )


def _rejected(title: str, rows: list[dict[str, str]]) -> list[str]:
    if not rows:
        return []
    cells = [[row["name"], row["reason"], row["detail"]] for row in rows]
    return [f"<h2>{title}</h2>", table(["point", "reason", "what was seen"], cells, words=True)]
