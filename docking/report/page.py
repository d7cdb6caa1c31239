"""The report as one HTML page."""

from __future__ import annotations

from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

from docking.errors import FileUnreadable, catalogue
from docking.report import charts, tables
from docking.report import words as wording
from docking.report.figures import style
from docking.report.run import Record, Run, summary
from docking.report.traces import Track, track
from docking.words import term

OUTCOMES = ("docked", "out_of_tolerance", "stopped", "fault", "refused")


def write_report(records: list[Record], path: Path, language: str = "en") -> None:
    """Write the report of the last run in `records` (a journal as `docking.journal.read` gives it) to `path`.

    One self-contained HTML file in `language` (en or zh). Raises FileUnreadable when `path` cannot be written.
    """
    page = html(records, language)
    draft = path.with_name(path.name + ".part")
    try:
        draft.write_text(page, encoding="utf-8")
        draft.replace(path)
    except OSError as error:
        raise FileUnreadable(str(path), error.strerror or str(error)) from error


def html(records: list[Record], language: str = "en") -> str:
    """The page's text."""
    import jinja2
    from markupsafe import Markup

    words = wording.words(language)
    run = Run(records)
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {
        "n": wording.number,
        "signed": wording.signed,
        "clock": wording.clock,
        "plain": wording.plain,
        "cssstring": wording.css_string,
        "term": partial(term, language),
    }
    template = resources.files("docking").joinpath("templates", "report.html.j2").read_text("utf-8")
    figures = {name: Markup(text) for name, text in drawings(run, words).items()}
    return environment.from_string(template).render(w=words, language=language, fig=figures, **view(run, language))


def view(run: Run, language: str) -> dict[str, Any]:
    """Everything the template prints, as plain values and rows."""
    words = wording.words(language)
    result = summary(run.records)
    outcome = str(result["outcome"]) if run.last("outcome") else "incomplete"
    moves = run.moves()
    last = run.last("features")
    return {
        "run": run,
        "start": run.start,
        "limits": run.start.get("limits") or {},
        "result": result,
        "outcome": outcome if outcome in (*OUTCOMES, "incomplete") else "fault",
        "e2s_mm": tables.numeric(result["max_feature_error_mm"]) + 2.0 * tables.numeric(result["feature_sigma_mm"]),
        "judged": last,
        "features": tables.feature_rows(last),
        "risk": tables.risk_row(last),
        "checks": tables.check_rows(run.last("check_points")),
        "measured_features": tables.measured_rows(run),
        "goal": tables.goal_table(run),
        "set_aside": tables.set_aside_rows(run),
        "stages": tables.stage_rows(run),
        "fits": tables.fit_rows(run),
        "rejections": tables.rejection_rows(run),
        "residuals": tables.residual_groups(run),
        "drifts": [{**record["body"], "age_s": run.age_s(record)} for record in run.of("drift")],
        "measurements": tables.measurement_rows(run),
        "plans": tables.plan_rows(run),
        "blocks": tables.displacement_blocks(moves, axes_of(run)),
        "maxima": tables.maxima_rows(moves, (run.start.get("limits") or {}).get("axis_force_n") or {}),
        "lateness": tables.lateness_rows(run),
        "late_ms": tables.LATE_MS,
        "alarms": alarm_rows(run, language),
        "events": tables.event_rows(run, words, language),
        "head": run.records[-1] if run.records else None,
        "length": tables.length,
        "nan": float("nan"),
    }


def drawings(run: Run, words: dict[str, str]) -> dict[str, str]:
    """The pictures by name; a picture that would be empty is left out."""
    features = tables.feature_rows(run.last("features"))
    residuals = tables.residual_groups(run)
    with style():
        found = {"states": charts.states(run, words)}
        # Far from the goal the picture would show only that; the table says it better.
        if features and all(row["e2s_mm"] <= 10.0 * row["tolerance_mm"] for row in features):
            found["acceptance"] = charts.acceptance(features, words)
        if features:
            found["convergence"] = charts.convergence(run, words)
        if residuals:
            found["residuals"] = charts.residuals(residuals, words)
        motion = track(run.moves())
        if motion is not None:
            found |= _motion(run, motion, words)
    return {name: text for name, text in found.items() if text}


def _motion(run: Run, motion: Track, words: dict[str, str]) -> dict[str, str]:
    limits = run.start.get("limits") or {}
    axes = axes_of(run)
    weighed = [axis for axis in axes if any(_known(move.moved["trace"], axis) for move in motion.moves)]
    position = {"label": words["ax_position"], "unit": "mm"}
    following = {"label": words["ax_following"], "unit": "mm", "all": limits.get("following_error_mm")}
    force = {"label": words["ax_force"], "unit": "N", **tables.by_letter(limits.get("axis_force_n") or {})}
    found = {
        "coupling": charts.coupling(motion, limits, words),
        "positions": charts.axis_lines(motion, axes, "position_mm", position, words),
        "following": charts.axis_lines(motion, axes, "following_error_mm", following, words),
    }
    if weighed:
        found["forces"] = charts.axis_lines(motion, weighed, "force_n", force, words)
    return found


def _known(trace: dict[str, Any], axis: str) -> bool:
    return any(value is not None for value in (trace.get("force_n") or {}).get(axis) or ())


def axes_of(run: Run) -> list[str]:
    """The cell's axes in the order of the cell file, else of the first trace."""
    named = run.start.get("axes")
    if named:
        return [str(axis) for axis in named]
    found: dict[str, None] = {}
    for move in run.moves():
        found |= dict.fromkeys((move.moved.get("trace") or {}).get("position_mm") or ())
    return list(found)


def alarm_rows(run: Run, language: str) -> list[dict[str, Any]]:
    """The alarms with their remedy in the report's language; the message stays as it was recorded."""
    rows = []
    for record in run.of("alarm"):
        body = record["body"]
        translated = catalogue(language).get(str(body.get("code")), {}).get("remedy")
        known = {key: body.get(key) for key in ("code", "message", "where", "value", "limit")}
        row = {**known, "age_s": run.age_s(record), "remedy": translated or body.get("remedy")}
        rows.append({**row, "stop": _stop_row(run, body.get("stop"))})
    return rows


def _stop_row(run: Run, stop: dict[str, Any] | None) -> dict[str, float | None] | None:
    """The stop that an alarm led to: since the run's first record in s, then ms after the finding."""
    if not stop or stop.get("found_s") is None:
        return None

    def later_ms(key: str) -> float | None:
        return None if stop.get(key) is None else 1e3 * float(stop[key])

    age_s = run.age_s({"t_mono_s": stop["found_s"]})
    return {"age_s": age_s, "commanded_ms": later_ms("commanded_after_s"), "rest_ms": later_ms("rest_after_s")}
