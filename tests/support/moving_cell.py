"""A cell process without an instrument: starts a motion process and moves the axes until somebody ends one of the two.

`python -m tests.support.moving_cell CELL WIRES TABLE` writes the plan's table to TABLE and prints `motion PID`,
`moving DURATION`, and how the move ended.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from docking.assemble.real_time import run_real
from docking.assemble.spawned import MotionProcess
from docking.config.build import plan_period_s, plan_settings, positioners_from
from docking.config.load import load_cell, load_job
from docking.errors import DockingError
from docking.planning import PlanRequest, make_plan
from docking.types import Correction

SHIFT_MM, TURN_RAD, SPEED_MM_S = np.array([9.0, -4.0, 3.0]), np.array([0.002, 0.001, 0.003]), 4.0


def hear(kind: str, body: Any) -> None:
    if kind == "hello":
        print("motion", body["pid"], flush=True)


async def move(cell_file: Path, found: dict[str, Any], table: Path, process: MotionProcess) -> str:
    job_file = cell_file.with_suffix(".job.toml")
    cell = load_cell(cell_file)
    job = load_job(job_file, cell)
    motion = await process.join((cell_file, job_file), cell, found, hear)
    try:
        await motion.connect()
        q_mm = await motion.enable()
        request = PlanRequest(
            plan_id=1,
            stage="align",
            kind="align",
            q_now_mm=q_mm,
            correction=Correction(np.array(job.mate.pose[:3]), TURN_RAD, SHIFT_MM),
            speed_mm_s=SPEED_MM_S,
            period_s=plan_period_s(cell),
            linear_interpolation=cell.bus.kind == "modbus-tcp",
        )
        plan = make_plan(request, positioners_from(cell, job), plan_settings(cell, job))
        np.save(table, plan.q_mm)
        await motion.load(plan)
        print("moving", plan.duration_s, plan.speed_limited_by, flush=True)
        result = await motion.start(plan.plan_hash)
        return f"{result.result} {result.cause}"
    except DockingError as error:
        return f"{type(error).__name__} {error}"
    finally:
        await motion.close()
        print("process", await process.end(), flush=True)


def main() -> None:
    cell_file, wires, table = (Path(argument) for argument in sys.argv[1:4])
    found = json.loads(wires.read_text())
    with MotionProcess() as process:
        print("ended", run_real(lambda: move(cell_file, found, table, process), ticks=False), flush=True)


if __name__ == "__main__":
    main()
