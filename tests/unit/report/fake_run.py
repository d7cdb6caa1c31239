"""A made-up run of a fuselage cell: (loop time, kind, body) in the shapes that the cell writes.

No physics, plausible sizes.
"""

from __future__ import annotations

import hashlib
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from docking.journal import JournalFile, read

POSITIONERS = ("A", "B", "C", "D")
AXES = tuple(f"{p}.{a}" for p in POSITIONERS for a in "XYZ")
FEATURES = ("F1", "F2", "F3", "F4")
TARGETS = tuple(f"T{i}" for i in range(1, 11))
STAGES = (("standoff-300", 26.0), ("standoff-100", 0.9), ("standoff-30", 0.35), ("standoff-10", 0.24), ("dock", 0.2))
SPEED_MM_S = 5.0
TOLERANCE_MM = 0.2


class FakeRun:
    """Collects the events of one run on a clock of its own."""

    def __init__(self, seed: int = 7, part_number: str = "FUS-15-2200", simulated: bool = True) -> None:
        self.rng = np.random.default_rng(seed)
        self.t_s = 0.0
        self.events: list[tuple[float, str, dict[str, Any]]] = []
        self.state = "offline"
        self.part_number, self.simulated = part_number, simulated
        self.q_mm = np.tile([400.0, 0.0, 250.0], 4)
        self.plans = 0

    def add(self, kind: str, wait_s: float = 0.1, /, **body: Any) -> None:
        self.t_s += wait_s
        self.events.append((self.t_s, kind, body))

    def go(self, event: str, to: str) -> None:
        self.add("state", **{"from": self.state, "event": event, "to": to})
        self.state = to

    def start(self) -> None:
        self.add(
            "run_started",
            cell="fuselage-can",
            job="fuselage-can",
            cell_sha256=hashlib.sha256(b"cell").hexdigest(),
            job_sha256=hashlib.sha256(b"job").hexdigest(),
            part_number=self.part_number,
            serial_number="SN-0042",
            seed=7 if self.simulated else None,
            simulated=self.simulated,
            version="0.1.0",
            tolerance_mm=TOLERANCE_MM,
            decision_rule="ISO 14253-1, k = 2",
            axes=list(AXES),
            limits={
                "following_error_mm": 0.5,
                "ball_residual_mm": 0.1,
                "internal_force_n": 1500.0,
                "axis_force_n": dict(zip(AXES, [5000.0, 5000.0, 30000.0] * 4, strict=True)),
            },
        )
        self.go("load", "standby")
        self.add("identity", where="tracker", vendor="line", product="LT-40", serial="77120", firmware="3.2")
        for axis in AXES:
            self.add(
                "identity",
                where=axis,
                vendor="0x2f3",
                product="SD-12",
                serial=f"50{AXES.index(axis):02d}",
                firmware="1.8",
            )
        self.go("connected", "disabled")
        self.go("enabled", "idle")

    def station(self) -> None:
        self.go("start-seated", "measure-frame")
        self.measure("ers", tuple(f"E{i}" for i in range(1, 9)))
        self.add(
            "station",
            X_WT=[[0.0, -1.0, 0.0, 9000.0], [1.0, 0.0, 0.0, -200.0], [0.0, 0.0, 1.0, 1500.0], [0.0, 0.0, 0.0, 1.0]],
            rms_mm=0.021,
            max_mm=0.044,
            residuals_mm=self.residuals(tuple(f"E{i}" for i in range(1, 9)), 0.02),
            rejected=[],
        )
        self.measure("mate", tuple(f"M{i}" for i in range(1, 9)))
        self.fit("mate", "locate", tuple(f"M{i}" for i in range(1, 9)), 0.025)

    def measure(self, group: str, names: tuple[str, ...]) -> None:
        readings = []
        for i, name in enumerate(names):
            p_mm = self.rng.normal((9000.0, 0.0, 0.0), 3000.0)
            readings.append(
                {
                    "target": name,
                    "pass": 0,
                    "p_T_mm": p_mm,
                    "sigma_mm": [0.005, 0.03, 0.03],
                    "t_s": self.t_s + 2 * i,
                    "face": 1,
                }
            )
        self.add("measurement", 2.0 * len(names), group=group, readings=readings)

    def residuals(self, names: tuple[str, ...], sigma_mm: float) -> dict[str, Any]:
        return {name: self.rng.normal(0.0, sigma_mm, 3) for name in names}

    def fit(
        self, what: str, stage: str, names: tuple[str, ...], sigma_mm: float, rejected: tuple[str, ...] = ()
    ) -> None:
        used = tuple(name for name in names if name not in rejected)
        self.add(
            "fit",
            what=what,
            stage=stage,
            X=np.eye(4),
            pose={"x_mm": 11.52, "y_mm": -3.21, "z_mm": 4.4, "alpha_deg": 0.11, "beta_deg": -0.32, "gamma_deg": 0.2},
            rms_mm=sigma_mm * 1.7,
            max_mm=sigma_mm * 2.9,
            method="least-squares",
            iterations=4,
            used=list(used),
            rejected=[{"name": n, "reason": "not-congruent", "detail": "1.874 mm against 8 others"} for n in rejected],
            residuals_mm=self.residuals(used, sigma_mm),
        )

    def features(self, stage: str, when: str, size_mm: float, sigma_mm: float = 0.021) -> None:
        direction = self.rng.normal(size=(len(FEATURES), 3))
        error = (
            direction
            / np.linalg.norm(direction, axis=1)[:, None]
            * size_mm
            * self.rng.uniform(0.6, 1.0, (len(FEATURES), 1))
        )
        norm = np.linalg.norm(error, axis=1)
        risk = 0.0042 if size_mm < 0.12 else 0.98
        self.add(
            "features",
            stage=stage,
            when=when,
            names=list(FEATURES),
            error_mm=error,
            norm_mm=norm,
            sigma_mm=[sigma_mm] * len(FEATURES),
            tolerance_mm=[TOLERANCE_MM] * len(FEATURES),
            risk=risk,
            accepted=bool(np.all(norm + 2 * sigma_mm <= TOLERANCE_MM) and risk <= 0.025),
        )

    def move(self, stage: str, size_mm: float, result: str = "done", share: float = 1.0) -> str:
        """Plan, confirm and run one move; `share` is the part of the path that is run."""
        self.plans += 1
        delta = self.rng.normal(0.0, 0.2 * size_mm, 12) + np.tile([size_mm, 0.3 * size_mm, -0.2 * size_mm], 4)
        duration_s = max(6.0, 1.875 * float(np.max(np.abs(delta))) / SPEED_MM_S)
        plan_hash = hashlib.sha256(f"{stage}{self.plans}".encode()).hexdigest()
        self.go("move-needed", "plan")
        self.add(
            "plan",
            plan_id=self.plans,
            plan_hash=plan_hash,
            stage=stage,
            kind="align" if self.plans == 1 else "insert",
            duration_s=duration_s,
            displacement_mm=dict(zip(AXES, delta, strict=True)),
            speed_limited_by="stage speed",
            chord_error_mm=0.0012,
            margins=[[axis, 120.0 + i, 2.5 + 0.1 * i] for i, axis in enumerate(AXES)],
            correction={
                "rotvec_deg": [0.02, -0.31, 0.12],
                "shift_mm": [size_mm, 1.0, -0.4],
                "pivot_mm": [0.0, 0.0, 0.0],
            },
        )
        self.go("planned", "confirm")
        self.add("permissives", stage=stage, declared=["area_clear", "reflectors_off"], missing=[])
        self.add("confirm", 4.0, plan_hash=plan_hash, go=True)
        goal = self.q_mm + delta
        self.add(
            "intent",
            plan_hash=plan_hash,
            start_mm=dict(zip(AXES, self.q_mm, strict=True)),
            target_mm=dict(zip(AXES, goal, strict=True)),
        )
        self.go("confirmed", "move")
        self.add("command", verb="run", plan_hash=plan_hash)
        self.add("moved", share * duration_s, plan_hash=plan_hash, **self.trace(delta, duration_s, share, result))
        self.q_mm = self.q_mm + delta * share
        return plan_hash

    def trace(self, delta: np.ndarray, duration_s: float, share: float, result: str) -> dict[str, Any]:
        t = np.arange(0.0, share * duration_s + 0.05, 0.1)
        t[-1] = share * duration_s
        u = t / duration_s
        s, rate = 10 * u**3 - 15 * u**4 + 6 * u**5, 30 * u**2 * (1 - u) ** 2 / duration_s
        n = len(t)
        position = self.q_mm + s[:, None] * delta + self.rng.normal(0.0, 1e-4, (n, 12))
        following = 0.004 * rate[:, None] * delta + self.rng.normal(0.0, 5e-4, (n, 12))
        residual = np.abs(0.008 + 0.02 * rate * np.abs(delta).max() / SPEED_MM_S + self.rng.normal(0.0, 1e-3, n))
        internal = 9000.0 * residual
        weight = np.tile([0.0, 0.0, 14700.0], 4) + self.rng.normal(0.0, 600.0, 12)
        force = weight + self.rng.normal(0.0, 25.0, (n, 12)) + 300.0 * s[:, None]
        return {
            "result": result,
            "trace": {
                "t_s": t + self.t_s,
                "path_time_s": t,
                "position_mm": dict(zip(AXES, position.T, strict=True)),
                "following_error_mm": dict(zip(AXES, following.T, strict=True)),
                "residual_mm": residual,
                "internal_force_n": internal,
                "force_n": dict(zip(AXES, force.T, strict=True)),
            },
            "max_following_error_mm": dict(zip(AXES, np.abs(following).max(axis=0), strict=True)),
            "max_consistency_residual_mm": residual.max(),
            "max_internal_force_n": internal.max(),
        }

    def look(self, stage: str, when: str, size_mm: float, rejected: tuple[str, ...] = ()) -> None:
        """References, targets, fit and features once."""
        self.measure("drift", ("E1", "E4", "E7"))
        self.add("drift", reference="ers", shift_mm=0.011, limit_mm=0.062, restationed=False)
        self.measure("component", TARGETS)
        self.go("measured", "fit")
        self.fit("component", stage, TARGETS, 0.02, rejected)
        self.go("fitted", "verify")
        self.features(stage, when, size_mm)

    def finish(self, outcome: str, **known: Any) -> None:
        moved = [body for _, kind, body in self.events if kind == "moved"]
        alarms = [body for _, kind, body in self.events if kind == "alarm"]
        self.add(
            "outcome",
            **{
                "outcome": outcome,
                "tolerance_mm": TOLERANCE_MM,
                "max_feature_error_mm": None,
                "feature_sigma_mm": None,
                "true_max_feature_error_mm": None,
                "moves": len(moved),
                "rejected_points": 1,
                "max_consistency_residual_mm": max((m["max_consistency_residual_mm"] for m in moved), default=None),
                "max_internal_force_n": max((m["max_internal_force_n"] for m in moved), default=None),
                "virtual_time_s": self.t_s,
                "wall_time_s": 9.25,
                "alarms": alarms,
                "report": "run.html",
                **known,
            },
        )


def docked_run(part_number: str = "FUS-15-2200", simulated: bool = True) -> FakeRun:
    """Five stages, one thrown-out point, docked."""
    run = FakeRun(part_number=part_number, simulated=simulated)
    run.start()
    run.station()
    run.go("frame-measured", "measure")
    run.add("set_aside", name="K3", error_mm=2.716, limit_mm=0.118)
    for side, off_mm in (("C", 0.0213), ("M", 0.0457)):
        names = [f"{name}.{side}" for name in FEATURES]
        run.add("features_measured", names=names, error_mm=[off_mm] * 4, limit_mm=[0.081] * 4)
    for i, (stage, size_mm) in enumerate(STAGES):
        run.look(stage, "before", size_mm, rejected=("T7",) if i == 0 else ())
        run.move(stage, max(size_mm, (300.0, 200.0, 70.0, 20.0, 10.0)[i] * 0.3))
        run.go("moved", "settle")
        run.add("settled", 1.4, t_s=1.4)
        run.go("settled", "measure")
        run.look(stage, "after", (0.8, 0.3, 0.22, 0.18, 0.09)[i])
    run.add(
        "check_points", names=["K1", "K2"], error_mm=[[0.02, -0.01, 0.03], [0.0, 0.04, -0.02]], limit_mm=[0.12, 0.12]
    )
    run.features("dock", "final", 0.09)
    run.go("accepted", "docked")
    last = run.events[-2][2]
    worst = int(np.argmax(last["norm_mm"]))
    run.finish(
        "docked",
        max_feature_error_mm=last["norm_mm"][worst],
        feature_sigma_mm=last["sigma_mm"][worst],
        true_max_feature_error_mm=0.0713,
    )
    return run


def faulted_run() -> FakeRun:
    """An axis jams in the first move."""
    run = FakeRun()
    run.start()
    run.station()
    run.go("frame-measured", "measure")
    run.look("standoff-300", "before", 26.0)
    run.move("standoff-300", 90.0, result="stopped", share=0.4)
    run.add(
        "alarm",
        0.0,
        code=2101,
        message="C.Z: following error 0.62 mm is over the limit 0.5 mm.",
        where="C.Z",
        value=0.62,
        limit=0.5,
        remedy="Look for a jam, a closed brake or an overload on this axis. Measure again before moving.",
        stop={"found_s": 75.0, "commanded_after_s": 0.011, "rest_after_s": 0.214},
    )
    run.go("faulted", "fault")
    run.finish("fault")
    return run


def records_of(run: FakeRun, path: Path) -> list[dict[str, Any]]:
    """Write the run through a real journal and read it back."""
    now = [0.0]
    begin = datetime(2026, 5, 4, 8, 30, tzinfo=UTC)
    journal = JournalFile(path, clock=lambda: now[0], wall=lambda: begin + timedelta(seconds=now[0]))
    for t_s, kind, body in run.events:
        now[0] = t_s
        journal.write(kind, body)
    journal.close()
    return read(path)
