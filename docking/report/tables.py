"""Tables of the report: plain rows computed from the journal's records."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Any, Final

from docking.motion.lateness import LATENESS
from docking.report.run import Body, Move, Record, Run
from docking.report.words import number, plain
from docking.types import RISK_LIMIT
from docking.words import term

Row = dict[str, Any]

LATE_MS: Final = (0.1, 1.0, 10.0, 100.0)
PLAN_KEYS: Final = ("plan_hash", "stage", "kind", "duration_s", "speed_limited_by", "chord_error_mm")


def at(values: Any, index: int) -> Any:
    """Item `index` of a list, the value itself where one value serves all, None where there is none."""
    if isinstance(values, list):
        return values[index] if index < len(values) else None
    return values


def numeric(value: Any) -> float:
    """A number of a record as a float; NaN for everything that is none."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan


def largest(values: Any) -> float:
    """The largest magnitude in a list; NaN when it holds no number."""
    found = [abs(numeric(value)) for value in values or () if not math.isnan(numeric(value))]
    return max(found, default=math.nan)


def length(vector: Any) -> float:
    """Euclidean length of a list of numbers; NaN when one is missing."""
    return math.sqrt(math.fsum(numeric(value) ** 2 for value in vector)) if vector else math.nan


def natural(name: str) -> list[tuple[int, str]]:
    """Sort key that puts T2 before T10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]+)", name) if part]


def by_letter(limits: dict[str, Any]) -> Row:
    """The smallest limit of the axes with the same letter (the part of the name after the last dot)."""
    found: Row = {}
    for axis, limit in limits.items():
        letter = axis.rpartition(".")[2]
        found[letter] = min(numeric(limit), found.get(letter, math.inf))
    return found


def feature_rows(body: Body) -> list[Row]:
    """One row a feature of a `features` record.

    `within` is e + 2 sigma <= tolerance; `inside` asks for the risk of all features together too. Both fail on unknown
    numbers.
    """
    rows, risk_holds = [], risk_row(body)["holds"]
    for i, name in enumerate(body.get("names") or ()):
        vector = at(body.get("error_mm"), i) or [None] * 3
        e, sigma = length(vector), numeric(at(body.get("sigma_mm"), i))
        tolerance = numeric(at(body.get("tolerance_mm"), i))
        rows.append(
            {
                "name": name,
                "d_mm": vector,
                "e_mm": e,
                "sigma_mm": sigma,
                "e2s_mm": e + 2.0 * sigma,
                "tolerance_mm": tolerance,
                "margin_mm": tolerance - e - 2.0 * sigma,
                "within": e + 2.0 * sigma <= tolerance,
                "inside": risk_holds and e + 2.0 * sigma <= tolerance,
            }
        )
    return rows


def risk_row(body: Body) -> Row:
    """The other half of the acceptance rule: the risk of a `features` record and its limit, in percent."""
    risk = numeric(body.get("risk"))
    return {"percent": 100.0 * risk, "limit_percent": 100.0 * RISK_LIMIT, "holds": risk <= RISK_LIMIT}


def stage_rows(run: Run) -> list[Row]:
    """For each stage in order: every feature before its first and after its last move, with the risk of all and
    whether the last judgement meets the acceptance rule (None where there was none).

    A stage that was entered from the one before was last judged there, against a goal that differs by the stand-off
    only: that judgement is its "before".
    """
    stages: dict[str, dict[str, Body]] = {}
    newest: Body = {}
    for body in run.bodies("features"):
        stage = stages.setdefault(str(body.get("stage")), {"earlier": newest})
        newest = body
        if body.get("when") == "before":
            stage.setdefault("before", body)
        else:
            stage["after"] = body
    return [
        _stage_row(name, stage.get("before", stage["earlier"]), stage.get("after", {}))
        for name, stage in stages.items()
    ]


def _stage_row(name: str, before: Body, after: Body) -> Row:
    sides = [{row["name"]: row for row in feature_rows(body)} for body in (before, after)]
    names = dict.fromkeys([*sides[0], *sides[1]])
    judged = list(sides[1].values())
    return {
        "stage": name,
        "rows": [{"name": n, "before": sides[0].get(n), "after": sides[1].get(n)} for n in names],
        "risks": [risk_row(before), risk_row(after)],
        "meets": all(row["inside"] for row in judged) if judged else None,
    }


def check_rows(body: Body) -> list[Row]:
    """One row a check point: its error, limit and whether it agrees (None when no limit was recorded)."""
    rows = []
    for i, name in enumerate(body.get("names") or ()):
        vector = at(body.get("error_mm"), i)
        e = length(vector) if isinstance(vector, list) else abs(numeric(vector))
        limit = numeric(at(body.get("limit_mm"), i))
        agrees = None if math.isnan(limit) and not math.isnan(e) else e <= limit
        rows.append({"name": name, "e_mm": e, "limit_mm": limit, "agrees": agrees})
    return rows


def measured_rows(run: Run) -> list[Row]:
    """One row a docking feature that was measured: NAME.C of the component, NAME.M of the mate, against the job."""
    return [row for body in run.bodies("features_measured") for row in check_rows(body)]


def goal_table(run: Run) -> Row | None:
    """The goal of the last planned move: the rule, what is locked, and what it leaves at each feature."""
    body = run.last("goal")
    if not body:
        return None
    keys = zip(body.get("names") or (), body.get("misfit_mm") or (), body.get("share") or (), strict=False)
    rows = [{"name": name, "misfit_mm": misfit, "percent": 100.0 * numeric(share)} for name, misfit, share in keys]
    return {"rule": body.get("rule"), "locks": ", ".join(body.get("locks") or ()), "rows": rows}


def set_aside_rows(run: Run) -> list[Row]:
    """Every check point that was set aside because it alone was grossly off."""
    keys = "name", "error_mm", "limit_mm"
    return [
        {"age_s": run.age_s(record), **{key: record["body"].get(key) for key in keys}} for record in run.of("set_aside")
    ]


def fit_rows(run: Run) -> list[Row]:
    """Every station check and fit in the order they were made."""
    rows = []
    for record in run.records:
        if record["kind"] not in ("station", "fit"):
            continue
        body = record["body"]
        used = body.get("used")
        rows.append(
            {
                "age_s": run.age_s(record),
                "what": body.get("what", "station"),
                "stage": body.get("stage") or "",
                "method": body.get("method") or "",
                "iterations": body.get("iterations"),
                "used": len(used) if isinstance(used, list) else used or len(body.get("residuals_mm") or ()),
                "rejected": len(body.get("rejected") or ()),
                "rms_mm": body.get("rms_mm"),
                "max_mm": body.get("max_mm"),
                "pose": body.get("pose") or pose_of(body.get("X_WT")),
            }
        )
    return rows


def pose_of(matrix: Any) -> Row:
    """Translation (mm) and angles (deg) of a 4x4 matrix, R = Rz(gamma) Ry(beta) Rx(alpha); {} when there is none."""
    if not matrix:
        return {}
    r = [[numeric(value) for value in row] for row in matrix]
    return {
        "x_mm": r[0][3],
        "y_mm": r[1][3],
        "z_mm": r[2][3],
        "alpha_deg": math.degrees(math.atan2(r[2][1], r[2][2])),
        "beta_deg": math.degrees(math.atan2(-r[2][0], math.hypot(r[0][0], r[1][0]))),
        "gamma_deg": math.degrees(math.atan2(r[1][0], r[0][0])),
    }


def rejection_rows(run: Run) -> list[Row]:
    """Every point thrown out: when, in which fit, which, why."""
    rows = []
    for record in run.records:
        if record["kind"] not in ("station", "fit"):
            continue
        body = record["body"]
        where = f"{body.get('what', 'station')} {body.get('stage') or ''}".strip()
        for item in body.get("rejected") or ():
            point = item if isinstance(item, dict) else {"name": item}
            rows.append({"age_s": run.age_s(record), "where": where, **point})
    return rows


def residual_groups(run: Run) -> list[tuple[str, dict[str, list[float]]]]:
    """Residuals (name: [dx, dy, dz] mm) of the last station check, mate fit and component fit that exist."""
    found = {"station": run.last("station").get("residuals_mm")}
    for body in run.bodies("fit"):
        found[str(body.get("what"))] = body.get("residuals_mm")
    groups = []
    for what, residuals in found.items():
        if residuals:
            names = sorted(residuals, key=natural)
            groups.append((what, {name: [numeric(v) for v in residuals[name]] for name in names}))
    return groups


def measurement_rows(run: Run) -> list[Row]:
    """One row a group of measurements: how many, of how many points, and the largest sigma of a coordinate."""
    groups: dict[str, list[Body]] = {}
    for body in run.bodies("measurement"):
        groups.setdefault(str(body.get("group")), []).extend(body.get("readings") or ())
    return [
        {
            "group": group,
            "readings": len(readings),
            "points": len({reading.get("target") for reading in readings}),
            "sigma_mm": largest([s for reading in readings for s in reading.get("sigma_mm") or ()]),
        }
        for group, readings in groups.items()
    ]


def lateness_rows(run: Run) -> list[Row]:
    """How late the motion process was before the run and in all cycles of it: quantiles in ms, and in how many cycles
    by less than each of `LATE_MS`, the last by that and more."""
    rows = []
    for kind in LATENESS:
        for body in run.bodies(kind):
            counts = [0] * (len(LATE_MS) + 1)
            for upper_s, count in body.get("histogram") or ():
                # Upper ends of classes: what ends at a bound is under it.
                counts[sum(1e3 * upper_s > bound * (1.0 + 1e-9) for bound in LATE_MS)] += count
            quantiles = {f"{key}_ms": 1e3 * numeric(body.get(f"{key}_s")) for key in ("p50", "p99", "p999", "max")}
            rows.append({"kind": kind, "samples": body.get("samples"), **quantiles, "counts": counts})
    return rows


def plan_rows(run: Run) -> list[Row]:
    """One row a plan: what limits it, its smallest margins, whether it was confirmed and how it ended."""
    confirmed = {body.get("plan_hash"): body.get("go") for body in run.bodies("confirm")}
    ended = {body.get("plan_hash"): body.get("result") for body in run.bodies("moved")}
    rows = []
    for count, body in enumerate(run.bodies("plan"), start=1):
        correction = body.get("correction") or {}
        margins = body.get("margins") or []
        rows.append(
            {
                **{key: body.get(key) for key in PLAN_KEYS},
                "number": body.get("plan_id", count),
                "shift_mm": length(correction.get("shift_mm")),
                "rotation_deg": length(correction.get("rotvec_deg")),
                "stroke_margin": _smallest(margins, 1, "mm"),
                "speed_margin": _smallest(margins, 2, "mm/s"),
                "confirmed": confirmed.get(body.get("plan_hash")),
                "result": ended.get(body.get("plan_hash")),
            }
        )
    return rows


def _smallest(margins: Iterable[list[Any]], column: int, unit: str) -> str:
    known = [(numeric(row[column]), row[0]) for row in margins if not math.isnan(numeric(at(row, column)))]
    if not known:
        return number(None)
    value, axis = min(known)
    return f"{number(value, 2)} {unit} ({axis})"


def displacement_blocks(moves: list[Move], axes: list[str], width: int = 9) -> list[Row]:
    """Axis displacements of the executed moves in blocks of at most `width` moves."""
    blocks = []
    for first in range(0, len(moves), width):
        block = moves[first : first + width]
        rows = []
        for axis in axes:
            values = [(move.plan.get("displacement_mm") or {}).get(axis) for move in block]
            rows.append({"axis": axis, "values": values})
        blocks.append({"moves": block, "rows": rows, "ends": [end_difference(move) for move in block]})
    return blocks


def end_difference(move: Move) -> float:
    """Largest |read-back displacement - planned displacement| in mm; NaN when the trace does not reach the end."""
    trace = move.moved.get("trace") or {}
    positions, planned = trace.get("position_mm") or {}, move.plan.get("displacement_mm") or {}
    if not numeric(at((trace.get("path_time_s") or [])[-1:], 0)) >= 0.999 * numeric(move.plan.get("duration_s")):
        return math.nan
    return largest(
        [
            numeric(track[-1]) - numeric(track[0]) - numeric(planned.get(axis))
            for axis, track in positions.items()
            if track
        ]
    )


def maxima_rows(moves: list[Move], run_limits: dict[str, Any]) -> list[Row]:
    """One row an executed move: its largest following error (and axis), residual, predicted internal force, and the
    measured axis force nearest to its limit in `run_limits` (N by axis)."""
    rows = []
    for move in moves:
        errors = move.moved.get("max_following_error_mm") or {}
        worst = max(errors, key=lambda axis: abs(numeric(errors[axis])), default=None)
        rows.append(
            {
                "number": move.number,
                "stage": move.plan.get("stage") or "",
                "kind": move.plan.get("kind") or "",
                "result": move.moved.get("result"),
                "following_error_mm": errors.get(worst),
                "axis": worst or "",
                "residual_mm": move.moved.get("max_consistency_residual_mm"),
                "force_n": move.moved.get("max_internal_force_n"),
                **_nearest_force(move, run_limits),
            }
        )
    return rows


def _nearest_force(move: Move, limits: dict[str, Any]) -> Row:
    """The measured force along an axis that came nearest to that axis's limit, with both; NaN where none is known."""
    tracks = (move.moved.get("trace") or {}).get("force_n") or {}
    found = [(largest(track), numeric(limits.get(axis)), axis) for axis, track in tracks.items()]
    known = [item for item in found if not math.isnan(item[0] / item[1])]
    force, limit, axis = max(known, key=lambda item: item[0] / item[1], default=(math.nan, math.nan, ""))
    return {"axis_force_n": force, "axis_limit_n": limit, "force_axis": axis}


def event_rows(run: Run, words: dict[str, str], language: str) -> list[Row]:
    """The time line: everything but state changes and single measurements, in one short sentence each."""
    rows = []
    for record in run.records:
        template = words.get(_event_key(record))
        if template is None:
            continue
        body = {key: plain(value) for key, value in record["body"].items() if not isinstance(value, dict | list)}
        lists = {key: value for key, value in record["body"].items() if isinstance(value, list)}
        body |= {key: ", ".join(value) or words["none"] for key, value in lists.items() if _are_words(value)}
        body["plan"] = plain(record["body"].get("plan_hash"))[:8]
        body["result"] = term(language, body.get("result", ""))
        rows.append({"age_s": run.age_s(record), "seq": record["seq"], "text": _filled(template, body, words)})
    return rows


def _are_words(values: list[Any]) -> bool:
    return all(isinstance(value, str) for value in values)


def _event_key(record: Record) -> str:
    if record["kind"] == "confirm":
        return "event_confirm_go" if record["body"].get("go") is True else "event_confirm_abort"
    return f"event_{record['kind']}"


def _filled(template: str, values: dict[str, str], words: dict[str, str]) -> str:
    class Known(dict[str, str]):
        def __missing__(self, key: str) -> str:
            return plain(None)

    prefix = {"when": "", "what": "fit_", "outcome": "outcome_"}
    translated = {key: words.get(f"{prefix[key]}{values[key]}", values[key]) for key in prefix if key in values}
    return template.format_map(Known(values | translated))
