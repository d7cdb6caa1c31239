"""The study as one self-contained page beside the paper's figures, its pictures as files, and its numbers as JSON."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

from docking.errors import FileUnwritable
from docking.journal import canonical
from docking.report.figures import style, svg
from docking.report.sheet import table, write_sheet
from docking.study.pose.claims import claims
from docking.study.pose.drawings import drawings
from docking.study.pose.table import PAPER_MM

TITLE = "A pose from points: the paper's study with many draws"


def make_folder(folder: Path) -> None:
    """Make the folder before the work is done rather than after it. Raises FileUnwritable."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileUnwritable(str(folder), error.strerror or str(error)) from error


def write_study(result: dict[str, Any], folder: Path) -> Path:
    """Write `pose.html`, `pose.json` and the pictures as SVG into a folder; the page's path. Raises FileUnwritable."""
    inline = {}
    page = folder / "pose.html"
    make_folder(folder)
    try:
        with style():
            for name, figure in drawings(result).items():
                inline[name] = svg(figure, name)
                figure.savefig(folder / f"{name}.svg", facecolor="white", metadata={"Date": None})
        (folder / "pose.json").write_text(canonical(result) + "\n", encoding="utf-8")
    except OSError as error:
        raise FileUnwritable(str(folder), error.strerror or str(error)) from error
    write_sheet(TITLE, _body(result, inline), page)
    return page


def _body(result: dict[str, Any], pictures: dict[str, str]) -> list[str]:
    rows = [[claim.paper, claim.finding, claim.verdict] for claim in claims(result)]
    return [
        f"<p>{_verdict(result)}</p>",
        "<p>Ten targets, each measured coordinate with an error uniform in +-0.5 mm where nothing else is said; "
        f"{result['draws']} draws a figure, seed {result['seed']}. The fitting error is the largest distance of a "
        "fitted target from its <em>true</em> place (Eq. 15, 16). The paper does not give its points; ours are stated "
        "below.</p>",
        "<h2>What holds and what does not</h2>",
        table(["the paper", "this study", "verdict"], rows, words=True),
        *_table_1(result, pictures["table-1"]),
        "<h2>Fig. 2: the number of points</h2>",
        _figure(
            pictures["figure-2"], "The fit uses the first n targets; the error counts at all ten, or those fitted."
        ),
        "<h2>Fig. 3: the size of the errors</h2>",
        _figure(pictures["figure-3"], "Barrel with two frames. The band is the same in both panels."),
        _convergence(result["sizes"]),
        "<h2>Where least squares starts</h2>",
        _figure(
            pictures["starts"],
            "Median iterations until no target moves any more; the time of three points includes the search for the "
            "largest triangle. 'As printed' is Eq. 12 in mm and rad about the origin with "
            "the inverse of the normal equations, the signs of Eq. 10 put right.",
        ),
        _starts(result["starts"]),
        "<h2>The physical limit</h2>",
        "<p>rms errors over the Cramer-Rao bound on the noise of a laser tracker, 1.00 being the best there is; in "
        "brackets the rotation. NEES is 6 where the stated covariance is honest.</p>",
        _bound(result["bound"]),
        "<h2>Bars</h2>",
        _bars(result["bars"]),
    ]


def _verdict(result: dict[str, Any]) -> str:
    failed = [bar["what"] for bar in result["bars"] if not bar["held"]]
    if not failed:
        return f"All {len(result['bars'])} bars hold."
    return f'<span class="bad">{len(failed)} of {len(result["bars"])} bars fail: {escape("; ".join(failed))}</span>'


def _figure(picture: str, caption: str) -> str:
    return f"<figure>{picture}<figcaption>{escape(caption)}</figcaption></figure>"


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _cell(band: dict[str, float]) -> str:
    return f"{band['mean']:.3f} [{band['p5']:.3f}, {band['p50']:.3f}, {band['p95']:.3f}]"


def _table_1(result: dict[str, Any], picture: str) -> list[str]:
    head = [
        "layout",
        "SVD = least squares",
        "three points, largest triangle",
        "three points, arbitrary",
        "ratio",
        "worse in",
    ]
    rows = [
        [
            row["layout"],
            *(_cell(row[key]) for key in ("svd", "three-point", "three-point, first")),
            f"{row['ratio_of_means']:.2f}",
            _percent(row["three_point_worse"]),
        ]
        for row in result["table"]
    ]
    svd, three, least = (f"{PAPER_MM[method]:.3f}" for method in ("svd", "three-point", "least-squares"))
    rows.append(["the paper, one draw", f"{svd} / {least}", three, "", "1.32", ""])
    keys = ("svd", "three_point", "three_point_first", "ratio")
    lies = [[row["layout"], *(_percent(row[f"paper_{key}_at"]) for key in keys)] for row in result["table"]]
    below = [f"{svd} mm, SVD", f"{three} mm, largest triangle", f"{three} mm, arbitrary triangle", "ratio 1.32"]
    layouts = "; ".join(f"{row['layout']}: {row['words']}" for row in result["table"])
    return [
        "<h2>Table 1: ten points, +-0.5 mm</h2>",
        f'<p class="soft">{escape(layouts)}. Drawn targets are drawn anew for every hundred draws of the errors.</p>',
        _figure(picture, "Dashed: the paper's values, an unlucky draw of SVD beside a lucky one of three points."),
        "<p>Fitting error, mm: mean [5 %, median, 95 %].</p>",
        table(head, rows),
        "<p>Share of our draws below the paper's one:</p>",
        table(["layout", *below], lies),
    ]


def _number(value: float | None, digits: int = 0) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _convergence(sizes: dict[str, Any]) -> str:
    rows = [
        [
            f"{row['amplitude_mm']:g} mm",
            f"{row['mean'] / row['amplitude_mm']:.3f}",
            f"{100 * row['converged']:.1f} %",
            _number(row["iterations"]),
            _number(row["most_iterations"]),
        ]
        for row in sizes["rows"]
    ]
    head = ["errors", "mean fitting error / amplitude", "Gauss-Newton finds the optimum", "iterations", "most"]
    return table(head, rows)


def _starts(rows: list[dict[str, Any]]) -> str:
    cells = [
        [
            row["start"],
            row["solver"],
            row["attitude"],
            f"{100 * row['converged']:.1f} %",
            _number(row["iterations"], 1),
            _number(row["most_iterations"]),
            _number(row["time_us"]),
        ]
        for row in sorted(rows, key=lambda row: (row["attitude"], row["solver"]))
    ]
    head = ["start", "solver", "part", "converged", "iterations", "most", "time with its start / us"]
    return table(head, cells)


def _bound(rows: list[dict[str, Any]]) -> str:
    cells = [
        [
            row["case"],
            f"{row['bound_um']:.1f} ({row['bound_urad']:.1f})",
            *(f"{row[m]['point']:.3f} ({row[m]['rotation']:.3f})" for m in ("ml", "svd", "three-point")),
            f"{row['nees']:.2f} +- {row['nees_sd']:.2f}",
        ]
        for row in rows
    ]
    return table(["case", "bound / um (urad)", "maximum likelihood", "SVD", "three points", "NEES"], cells)


def _bars(rows: list[dict[str, Any]]) -> str:
    cells = [
        [
            row["what"],
            f"{row['value']:.4g}",
            f"{row['least']:.4g}",
            f"{row['most']:.4g}",
            "pass" if row["held"] else "FAIL",
        ]
        for row in rows
    ]
    return table(["figure", "value", "from", "to", ""], cells)
