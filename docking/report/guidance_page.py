"""The study of the guidance as one self-contained HTML page: every trajectory by every method, the paper's lines."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from docking.errors import FileUnwritable
from docking.report.figures import COLOURS, DASHES, WIDTH_IN, style, svg

PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>Study of the guidance</title>
<style>body{{font:15px/1.45 sans-serif;max-width:60em;margin:2em auto;padding:0 1em;color:#222}}
svg{{width:100%;height:auto}}pre{{white-space:pre-wrap;font-size:12px}}</style></head>
<body><h1>Study of the guidance</h1>
{drawing}
<p>Absolute trajectory error, not aligned, of an independent walk through {scenes} rendered scenes. Dashed: the means
that the paper prints, from one camera in one hall.</p>
<pre>{text}</pre>
</body></html>
"""


def write_guidance_page(result: dict[str, Any], text: str, path: Path) -> None:
    """Write the page of a study. Raises FileUnwritable."""
    with style():
        drawing = _drawing(result)
    try:
        path.write_text(PAGE.format(drawing=drawing, scenes=result["scenes"], text=escape(text)), encoding="utf-8")
    except OSError as error:
        raise FileUnwritable(str(path), error.strerror or str(error)) from error


def _drawing(result: dict[str, Any]) -> str:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_IN, 3.4), layout="constrained")
    axes = figure.subplots()
    seeds = [row["seed"] for row in result["rows"]]
    for k, (method, mean) in enumerate(result["methods"].items()):
        errors = [row["methods"][method].get("ate_rmse_mm", np.nan) for row in result["rows"]]
        axes.bar(np.array(seeds) + 0.27 * (k - 1), errors, 0.25, color=COLOURS[k], label=method)
        if mean["paper_mm"] is not None:
            axes.axhline(mean["paper_mm"], color=COLOURS[k], linestyle=DASHES[1], linewidth=1.0)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xticks(seeds)
    axes.set_xlabel("trajectory")
    axes.set_ylabel("ATE, mm")
    axes.legend(ncols=3)
    return svg(figure, "guidance")
