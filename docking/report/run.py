"""The records of one run, found by kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

Record = dict[str, Any]
Body = dict[str, Any]

OUTCOME_KEYS: Final = (
    "outcome",
    "tolerance_mm",
    "max_feature_error_mm",
    "feature_sigma_mm",
    "true_max_feature_error_mm",
    "moves",
    "rejected_points",
    "max_consistency_residual_mm",
    "max_internal_force_n",
    "virtual_time_s",
    "wall_time_s",
    "alarms",
    "report",
)


@dataclass(frozen=True)
class Move:
    """One executed plan: its record of the plan ({} if unknown) and of how it ended."""

    number: int
    plan: Body
    moved: Body


class Run:
    """The records of the last run in a journal: everything from its `run_started` on."""

    def __init__(self, records: list[Record]) -> None:
        starts = [i for i, record in enumerate(records) if record["kind"] == "run_started"]
        self.records = records[starts[-1] :] if starts else list(records)

    def of(self, kind: str) -> list[Record]:
        """The records of one kind, oldest first."""
        return [record for record in self.records if record["kind"] == kind]

    def bodies(self, kind: str) -> list[Body]:
        return [record["body"] for record in self.of(kind)]

    def last(self, kind: str) -> Body:
        """The newest body of a kind; {} when there is none."""
        return next(iter(reversed(self.bodies(kind))), {})

    @property
    def start(self) -> Body:
        return self.last("run_started")

    def age_s(self, record: Record) -> float:
        """Loop time of a record since the run's first record."""
        return float(record["t_mono_s"] or 0.0) - float(self.records[0]["t_mono_s"] or 0.0)

    def moves(self) -> list[Move]:
        """The executed moves in order, each with the newest plan of its hash."""
        plans = {body.get("plan_hash"): body for body in self.bodies("plan")}
        return [
            Move(number, plans.get(moved.get("plan_hash"), {}), moved)
            for number, moved in enumerate(self.bodies("moved"), start=1)
        ]


def summary(records: list[Record]) -> dict[str, Any]:
    """The object that dry-run and run print with `--json`; unknown values are None.

    A run whose program ended before it wrote an outcome counts as a fault.
    """
    run = Run(records)
    known = run.last("outcome")
    if not known:
        known = {
            "outcome": "fault",
            "tolerance_mm": run.start.get("tolerance_mm"),
            "moves": len(run.bodies("moved")),
            "alarms": run.bodies("alarm"),
        }
    return {key: known.get(key) for key in OUTCOME_KEYS}
