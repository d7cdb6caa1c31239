"""The table that `make bench` prints."""

from __future__ import annotations

import os
from collections.abc import Sequence

from tests.bench.metric import Metric

HEAD = ("", "metric", "product", "peer", "ratio", "target", "met")


def table(metrics: Sequence[Metric]) -> str:
    """One line a metric, columns aligned."""
    rows = [HEAD, *(_cells(metric) for metric in metrics)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(HEAD))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join([lines[0], "-" * max(map(len, lines)), *lines[1:]])


def _cells(metric: Metric) -> tuple[str, ...]:
    side = ">=" if metric.at_least else "<="
    return (
        metric.key,
        metric.what,
        metric.product,
        metric.peer,
        f"{metric.ratio:.3g}",
        f"{side} {metric.target:g}",
        "yes" if metric.met else "NO",
    )


def machine() -> str:
    """Cores and load: ratios taken on a busy machine say little."""
    return f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the start"
