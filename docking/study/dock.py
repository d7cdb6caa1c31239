"""Studies over many seeds: resumable, on all cores, the same result whatever the workers.

Every run is the whole dry-run, drivers and bytes included. Results are kept one line a seed in `OUT/NAME.KEY.jsonl`,
KEY naming the program, files and options they belong to; a study that is started again does the seeds that are
missing.
"""

from __future__ import annotations

import hashlib
import json
import os
import statistics
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from scipy import special

from docking.assemble.requests import Files, RunRequest, load_files
from docking.assemble.runs import dry_run_files
from docking.assemble.simulated import truth_of, truth_path
from docking.config import JobFile
from docking.config.load import file_sha256
from docking.errors import BadArgument, DockingError
from docking.records import alarm_record
from sim.truth import ERROR_NAMES, TruthFile

CELLS = ("fuselage-can", "fuselage-modbus", "follower-can", "wing-modbus", "lab-can", "lab-modbus")
KEPT = (
    "outcome",
    "tolerance_mm",
    "max_feature_error_mm",
    "feature_sigma_mm",
    "true_max_feature_error_mm",
    "moves",
    "max_consistency_residual_mm",
    "max_internal_force_n",
    "virtual_time_s",
    "wall_time_s",
)
Say = Callable[[str], None]
Row = dict[str, Any]


@dataclass(frozen=True)
class StudyRequest:
    """What to study: cells (default all six), seeds 1..n, where results are kept, workers, and what is changed."""

    cells: tuple[Path, ...]
    seeds: int
    out: Path
    workers: int | None = None
    stress: bool = False
    tolerance_mm: float | None = None
    errors: tuple[str, ...] = ()

    def scales(self) -> dict[str, float]:
        """The `NAME=SCALE` options as numbers."""
        result: dict[str, float] = {}
        for option in self.errors:
            name, _, text = option.partition("=")
            try:
                result[name] = float(text)
            except ValueError:
                raise BadArgument("--error", "write NAME=SCALE with a number", value=option) from None
            if name not in ERROR_NAMES:
                raise BadArgument("--error", f"the names are {', '.join(ERROR_NAMES)}", value=name)
            if not 0.0 <= result[name] < float("inf"):
                raise BadArgument("--error", "a scale is a finite number, not negative", value=option)
        return result


def study_dock(request: StudyRequest, say: Say) -> dict[str, Any]:
    """Dock every cell with every seed; returns counts and worst cases per cell. Raises BadArgument, ConfigError."""
    for option, number in (("--seeds", request.seeds), ("--workers", request.workers)):
        if number is not None and number < 1:
            raise BadArgument(option, "at least one is needed", value=number, limit=1)
    if request.tolerance_mm is not None and not 0.0 < request.tolerance_mm < float("inf"):
        raise BadArgument("--tolerance-mm", "a positive length is needed", value=request.tolerance_mm)
    cells = request.cells or tuple(_reference_cells())
    request.out.mkdir(parents=True, exist_ok=True)
    return {"cells": [_study_cell(cell, request, say) for cell in cells]}


def _reference_cells() -> Iterator[Path]:
    import sim

    folder = Path(sim.__file__).parent / "cells"
    return (folder / f"{name}.toml" for name in CELLS)


def _study_cell(cell: Path, request: StudyRequest, say: Say) -> dict[str, Any]:
    files = load_files(_run_request(cell, 1))
    store = request.out / f"{files.cell.name}.{_key(cell, files, request)}.jsonl"
    wanted = range(1, request.seeds + 1)
    rows = {row["seed"]: row for row in _stored(store) if row["seed"] in wanted}
    missing = [seed for seed in wanted if seed not in rows]
    with store.open("a", encoding="utf-8") as kept, closing(_run_all(cell, missing, request)) as results:
        for done, row in enumerate(results, 1):
            rows[row["seed"]] = row
            kept.write(json.dumps(row) + "\n")
            kept.flush()
            if done % max(1, len(missing) // 20) == 0 or done == len(missing):
                say(f"{files.cell.name}: {len(rows)} of {request.seeds} seeds")
    return summarise(files.cell.name, [rows[s] for s in wanted])


def _run_all(cell: Path, seeds: list[int], request: StudyRequest) -> Generator[Row]:
    """The rows of `seeds` as they are done, on all workers; closing it drops the seeds that are not begun."""
    pool = ProcessPoolExecutor(request.workers or os.cpu_count() or 1)
    try:
        for task in as_completed([pool.submit(_one, cell, seed, request) for seed in seeds]):
            yield task.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _run_request(cell: Path, seed: int) -> RunRequest:
    return RunRequest(cell, None, seed, None, None, "en")


def _one(cell: Path, seed: int, request: StudyRequest) -> Row:
    """One seed; runs in a worker. A seed that the simulated cell cannot represent counts as refused."""
    files = load_files(_run_request(cell, seed))
    if request.tolerance_mm is not None:
        files = replace(files, job=_with_tolerance(files.job, request.tolerance_mm))
    summary: dict[str, Any]
    try:
        summary = dry_run_files(files, _truth(cell, request), _run_request(cell, seed), lambda text: None)
    except DockingError as error:
        summary = {
            "outcome": "refused",
            "tolerance_mm": files.job.tolerance_mm,
            "alarms": [alarm_record(error.alarm())],
        }
    alarms = [{"code": a["code"], "where": a["where"]} for a in summary["alarms"]]
    return {"seed": seed, **{key: summary.get(key) for key in KEPT}, "alarms": alarms}


def _truth(cell: Path, request: StudyRequest) -> TruthFile:
    truth = truth_of(cell)
    truth = truth.stress() if request.stress else truth
    return truth.scaled(request.scales())


def _with_tolerance(job: JobFile, tolerance_mm: float) -> JobFile:
    features = tuple(f.model_copy(update={"tolerance_mm": tolerance_mm}) for f in job.component.features)
    return job.model_copy(update={"component": job.component.model_copy(update={"features": features})})


def _key(cell: Path, files: Files, request: StudyRequest) -> str:
    """Names everything that decides a result, so that a changed program, file or option starts afresh."""
    parts = [
        _program_sha256(),
        str(request.stress),
        str(request.tolerance_mm),
        json.dumps(request.scales(), sort_keys=True),
    ]
    parts += [file_sha256(path) for path in (cell, files.job_path, truth_path(cell))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]


def _program_sha256() -> str:
    """One hash of the sources that run: results of different programs are not one study."""
    import docking
    import drivers
    import sim

    digest = hashlib.sha256()
    for package in (docking, drivers, sim):
        folder = Path(str(package.__file__)).parent
        for path in sorted((*folder.rglob("*.py"), *folder.glob("maps/*.toml"))):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _stored(path: Path) -> list[Row]:
    """The whole lines of an earlier start; what a crash cut short is dropped from the file, its seed is done again."""
    if not path.exists():
        return []
    content = path.read_bytes()
    whole = content[: content.rfind(b"\n") + 1]
    if len(whole) < len(content):
        os.truncate(path, len(whole))
    return [json.loads(line) for line in whole.splitlines()]


def summarise(name: str, rows: list[Row]) -> dict[str, Any]:
    """Counts, worst cases, and the rates of false acceptance and refusal with 95 % intervals (Clopper-Pearson)."""
    docked = [r for r in rows if r["outcome"] == "docked"]
    false_accepted = [r for r in docked if not (r["true_max_feature_error_mm"] <= r["tolerance_mm"])]
    not_docked = [r for r in rows if r["outcome"] != "docked"]
    false_refused = [
        r
        for r in not_docked
        if r["outcome"] == "out_of_tolerance" and r["true_max_feature_error_mm"] <= r["tolerance_mm"]
    ]
    return {
        "cell": name,
        "seeds": len(rows),
        "outcomes": dict(Counter(r["outcome"] for r in rows)),
        "docked": _share(len(docked), len(rows)),
        "false_accepted": _share(len(false_accepted), len(docked)),
        "false_refused": _share(len(false_refused), len(rows)),
        "worst_true_error_docked_mm": max((r["true_max_feature_error_mm"] for r in docked), default=None),
        "median_true_error_docked_mm": _median([r["true_max_feature_error_mm"] for r in docked]),
        "median_sigma_mm": _median([r["feature_sigma_mm"] for r in docked]),
        "median_speed": _median([r["virtual_time_s"] / r["wall_time_s"] for r in rows if r["wall_time_s"]]),
        "median_virtual_time_s": _median([r["virtual_time_s"] for r in rows]),
        "alarm_codes": dict(Counter(str(a["code"]) for r in rows for a in r["alarms"])),
        "not_docked_seeds": [r["seed"] for r in not_docked],
        "false_accepted_seeds": [r["seed"] for r in false_accepted],
    }


def _share(count: int, of: int) -> dict[str, Any]:
    """A share with its exact two-sided 95 % interval: quantiles of the beta distribution (Clopper-Pearson)."""
    if of == 0:
        return {"count": 0, "of": 0, "share": None, "low": None, "high": None}
    low = float(special.betaincinv(count, of - count + 1, 0.025)) if count > 0 else 0.0
    high = float(special.betaincinv(count + 1, of - count, 0.975)) if count < of else 1.0
    return {"count": count, "of": of, "share": count / of, "low": low, "high": high}


def _median(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def study_text(result: dict[str, Any]) -> str:
    """The study as a table for people."""
    lines = []
    for c in result["cells"]:
        docked, accepted, refused = c["docked"], c["false_accepted"], c["false_refused"]
        lines.append(f"{c['cell']}: docked {docked['count']} of {docked['of']}")
        lines.append(f"  outcomes {c['outcomes']}; alarms {c['alarm_codes']}")
        lines.append(f"  docked runs: worst true error {_mm(c['worst_true_error_docked_mm'])}")
        lines.append(f"  falsely accepted, of the accepted: {_percent(accepted)}; falsely refused: {_percent(refused)}")
        if c["median_speed"] is not None:
            lines.append(
                f"  median {c['median_virtual_time_s']:.0f} s of cell time, {c['median_speed']:.0f} x real time"
            )
        if c["not_docked_seeds"]:
            lines.append(f"  not docked: seeds {c['not_docked_seeds']}")
    return "\n".join(lines)


def _mm(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f} mm"


def _percent(share: dict[str, Any]) -> str:
    if share["share"] is None:
        return "none to judge"
    share_percent, low, high = (100 * share[key] for key in ("share", "low", "high"))
    return f"{share_percent:.2f} % ({share['count']} of {share['of']}; 95 %: {low:.2f} to {high:.2f} %)"
