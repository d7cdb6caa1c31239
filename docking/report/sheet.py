"""A page for one subject: a single HTML file with inline pictures, readable by day, by night and on paper."""

from __future__ import annotations

from html import escape
from pathlib import Path

from docking.errors import ExtraMissing, FileUnwritable

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="color-scheme" content="light dark"><title>{title}</title>
<style>
:root{{--ink:#1c1c1c;--soft:#5c5c5c;--rule:#d3d3d3;--paper:#fff;--bad:#b00020}}
@media (prefers-color-scheme:dark){{:root{{--ink:#e8e8e8;--soft:#a9a9a9;--rule:#4a4a4a;--paper:#161616;--bad:#ff7b8b}}}}
body{{font:15px/1.45 sans-serif;max-width:60em;margin:2em auto;padding:0 1em;color:var(--ink);background:var(--paper)}}
svg{{width:100%;height:auto}} svg text{{fill:var(--ink)!important}} h2{{margin-top:2em}}
figcaption,.soft{{color:var(--soft)}} .bad{{color:var(--bad);font-weight:600}} .wide{{overflow-x:auto}}
table{{border-collapse:collapse;font-variant-numeric:tabular-nums;font-size:.9em}}
th,td{{padding:.15em .6em;text-align:right;border-bottom:1px solid var(--rule);vertical-align:top}}
.t{{text-align:left}}
</style></head>
<body><h1>{title}</h1>
{body}
</body></html>
"""


def check_drawing() -> None:
    """Raise ExtraMissing where nothing can be drawn: better before the work than after it."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise ExtraMissing("report", str(error), value="matplotlib", limit="pip install '.[report]'") from error


def write_sheet(title: str, parts: list[str], path: Path) -> None:
    """Write a page of HTML parts. Raises FileUnwritable."""
    try:
        path.write_text(_PAGE.format(title=escape(title), body="\n".join(parts)), encoding="utf-8")
    except OSError as error:
        raise FileUnwritable(str(path), error.strerror or str(error)) from error


def table(head: list[str], rows: list[list[str]], *, words: bool = False) -> str:
    """A table of plain text; numbers stand right, the first column, or with `words` every column, left."""

    def cells(tag: str, values: list[str]) -> str:
        marks = (' class="t"' if words or k == 0 else "" for k in range(len(values)))
        return "".join(f"<{tag}{mark}>{escape(v)}</{tag}>" for mark, v in zip(marks, values, strict=True))

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{cells("th", head)}</tr></thead><tbody>{body}</tbody></table></div>'
