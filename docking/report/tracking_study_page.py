"""The study of tracking as one self-contained HTML page: where the published 1 to 2 cm hold, and where they do not."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from docking.report.figures import COLOURS, GREY, LIMIT, panels, style, svg
from docking.report.sheet import table, write_sheet

_CLAIM_MM = (10.0, 20.0)
_COLOUR_OF = {
    "hold last": GREY,
    "published": COLOURS[1],
    "coupled": COLOURS[3],
    "repaired": COLOURS[4],
    "ins": COLOURS[0],
    "encoders": COLOURS[2],
}
HEAD = [
    "motion, sensor", "method", "gaps", "median / mm", "90 % / mm", "within 20 mm", "predicted sd / mm",
    "measured / predicted", "claim holds", "bar",
]  # fmt: skip


def write_tracking_study_page(result: dict[str, Any], path: Path) -> None:
    """Write the page of `docking study tracking`; `result` is what the study answers. Raises FileUnwritable."""
    rows = result["rows"]
    with style():
        drawing = _drawing(rows)
    body = [
        f"<p>{escape(line)}</p>"
        for line in (
            "[Zhao] claims 1 to 2 cm kept through 3 s without image. Simulated bodies, four gaps of 3 s a run; waving "
            "is a hand's motion of +-0.4 m and +-10 deg up to 0.5 Hz, docking one direction at up to 10 mm/s. A row "
            "holds the claim when nine of ten gaps end within 20 mm.",
            _verdict(rows),
            "published: the decoupled pair as printed; coupled: the 9 + 6 form; repaired: the decoupled pair with "
            "velocity state and feedback; ins: fifteen error states; hold last: the last seen position.",
        )
    ]
    body += [
        f"<figure>{drawing}<figcaption>Share of gaps that end within an error; the band is the claim, 10 to 20 mm."
        "</figcaption></figure>",
        f'<div class="wide">{table(HEAD, [_cells(row) for row in rows])}</div>',
    ]
    write_sheet("Study of tracking", body, path)


def claim_holds(row: dict[str, Any]) -> bool:
    """Whether nine of ten gaps end within 20 mm."""
    return bool(row["p90_end_error_mm"] <= _CLAIM_MM[1])


def _verdict(rows: list[dict[str, Any]]) -> str:
    real = [row for row in rows if row["method"] != "hold last"]
    holds, fails = (
        "; ".join(f"{r['motion']}, {r['grade']}, {r['method']}" for r in real if claim_holds(r) is kind) or "nowhere"
        for kind in (True, False)
    )
    return f"It holds for: {holds}. It does not for: {fails}."


def _cells(row: dict[str, Any]) -> list[str]:
    sd, ratio = row["predicted_sd_mm"], row["measured_to_predicted"]
    return [
        f"{row['motion']}, {row['grade']}",
        row["method"],
        str(row["gaps"]),
        f"{row['median_end_error_mm']:.3f}",
        f"{row['p90_end_error_mm']:.3f}",
        f"{100.0 * row['share_within_20_mm']:.0f} %",
        "" if sd is None else f"{sd:.3f}",
        "" if ratio is None else f"{ratio:.2f}",
        "yes" if claim_holds(row) else "no",
        {None: "", True: "held", False: "MISSED"}[row["held"]],
    ]


def _drawing(rows: list[dict[str, Any]]) -> str:
    """One panel a motion and grade: the distribution of the errors of every method."""
    cases = list(dict.fromkeys((row["motion"], row["grade"]) for row in rows))
    figure, axes = panels(1.5 * len(cases) + 0.5, len(cases), sharex=True)
    figure.patch.set_alpha(0.0)
    for (motion, grade), panel in zip(cases, axes, strict=True):
        panel.patch.set_alpha(0.0)
        panel.axvspan(*_CLAIM_MM, color=LIMIT, alpha=0.15, linewidth=0)
        for row in rows:
            if (row["motion"], row["grade"]) == (motion, grade):
                errors = np.sort(row["end_errors_mm"])
                share = 100.0 * np.arange(1, len(errors) + 1) / len(errors)
                panel.step(errors, share, where="post", color=_COLOUR_OF[row["method"]], label=row["method"])
        panel.set_xscale("log")
        panel.xaxis.set_major_formatter("{x:g}")
        panel.set_ylabel("%")
        panel.set_title(f"{motion}, {grade}")
        panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    axes[-1].set_xlabel("error at the end of the gap / mm")
    return svg(figure, "tracking-study")
