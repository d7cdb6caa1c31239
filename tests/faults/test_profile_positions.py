"""Drives that know neither cyclic nor interpolated position: one SYNC starts all, and they stay on one line."""

from __future__ import annotations

import asyncio
import shutil
from pathlib import Path

import numpy as np
import pytest

from docking.assemble.motion_side import local_motion
from docking.assemble.requests import RunRequest
from docking.assemble.runs import dry_run
from docking.assemble.simulated import make_far_end, truth_of
from docking.assemble.wires import NearBus
from docking.config.build import plan_settings
from docking.config.load import load_cell, load_job
from docking.errors import DriveFault, OutcomeUnknown, ReadBackMismatch, WrongIdentity
from sim.virtual_time import run_virtual
from sim.wires.virtual_can import VirtualCan
from tests.support.motion_record import SET_POINT
from tests.support.planned_moves import CELLS, a_plan, lab_site

START, HALT = 1 << 4, 1 << 8


def profile_files(folder: Path, wanted: bool = True) -> Path:
    """The laboratory cell with drives that have profile position and homing, and nothing else."""
    text = (CELLS / "lab-can.toml").read_text("utf-8")
    text = text.replace('channel = "can0"\n', f'channel = "can0"\nprofile_position = {str(wanted).lower()}\n')
    truth = (CELLS / "lab-can.sim.toml").read_text("utf-8")
    truth = truth.replace('sync_loss = "quick-stop"', 'sync_loss = "quick-stop"\nmodes = [1, 6]')
    assert "modes" in truth
    (folder / "lab-pp.toml").write_text(text, "utf-8")
    (folder / "lab-pp.sim.toml").write_text(truth, "utf-8")
    shutil.copy(CELLS / "lab-can.job.toml", folder / "lab-pp.job.toml")
    return folder / "lab-pp.toml"


class Bench:
    """Motion side and drives on one virtual bus, enabled, with a plan that shifts and turns loaded."""

    def __init__(self, path: Path) -> None:
        self.loop = asyncio.get_running_loop()
        self.cell = load_cell(path).model_copy(update={"inputs": None})
        job = load_job(path.with_name("lab-pp.job.toml"), load_cell(path))
        self.far = make_far_end(self.cell, job, truth_of(path), 1)
        self.bus = VirtualCan(self.loop, 1_000_000, "can0")
        near, far = self.bus.end(), self.bus.end()
        far.is_open = True
        self.far.drives(self.cell, far)
        self.drives = self.far.devices[-1]
        self.words: list[tuple[float, dict[int, int]]] = []
        send = near.send

        def tapped(frames) -> None:
            words = {cob - 0x200: SET_POINT.unpack(data)[0] for cob, data in frames if 0x200 < cob < 0x280}
            if words:
                self.words.append((self.loop.time(), words))
            send(frames)

        near.send = tapped  # type: ignore[method-assign]
        self.motion = local_motion(self.cell, job, NearBus(near))
        self.settings = plan_settings(self.cell, job)

    async def ready(self) -> None:
        await self.motion.connect()
        start_mm = await self.motion.enable()
        base = lab_site()
        site = type(base)(base.positioners, self.settings, start_mm, base.pivot_mm, 4.0, 4.0, 2.0)
        self.plan = a_plan(site, 5, queued=True, start_mm=start_mm)
        await self.motion.load(self.plan)

    async def end(self) -> None:
        await self.motion.close()
        await asyncio.sleep(0.2)
        await self.far.close()

    def gap_mm(self) -> float:
        """Largest distance of any axis from the plan's nearest row."""
        return float(np.abs(self.plan.q_mm - self.far.plant.encoder_mm()).max(axis=1).min())


def play(tmp_path: Path, story, wanted: bool = True) -> None:
    async def main() -> None:
        bench = Bench(profile_files(tmp_path, wanted))
        await story(bench)
        await bench.end()

    run_virtual(main)


@pytest.mark.full
def test_a_cell_of_such_drives_docks(tmp_path):
    summary = dry_run(RunRequest(profile_files(tmp_path), None, 1, None, None, "en"), lambda text: None)
    assert summary["outcome"] == "docked"
    assert summary["max_consistency_residual_mm"] < 0.02


def test_a_move_runs_in_pieces_each_begun_by_one_sync(tmp_path):
    async def story(bench: Bench) -> None:
        await bench.ready()
        pieces = len(bench.motion._bus._pieces)
        gaps: list[float] = []

        async def watch() -> None:
            while True:
                gaps.append(bench.gap_mm())
                await asyncio.sleep(0.01)

        watcher = asyncio.ensure_future(watch())
        result = await bench.motion.start(bench.plan.plan_hash)
        watcher.cancel()
        assert result.cause is None
        assert result.result == "done"
        begun = [
            words
            for (_, before), (_, words) in zip(bench.words, bench.words[1:], strict=False)
            if any(w & START for w in words.values()) and not any(w & START for w in before.values())
        ]
        assert len(begun) == pieces > 1
        assert all(all(word & START for word in words.values()) and len(words) == 12 for words in begun)
        assert np.abs(bench.far.plant.encoder_mm() - bench.plan.q_mm[-1]).max() < 0.006
        # Servo lag and bend: a figure that is nowhere off its path. Trapezoids at full speed each would be off by mm.
        assert max(gaps) < 0.03
        assert result.max_residual_mm < 0.03

    play(tmp_path, story)


@pytest.mark.parametrize("share", [0.3, *(pytest.param(s, marks=pytest.mark.full) for s in (0.02, 0.6))])
def test_a_hold_stops_on_the_path_and_a_resume_goes_on_to_the_end(share, tmp_path):
    async def story(bench: Bench) -> None:
        await bench.ready()
        move = asyncio.ensure_future(bench.motion.start(bench.plan.plan_hash))
        await asyncio.sleep(0.2 + share * bench.plan.duration_s)
        bench.motion.request("hold")
        await asyncio.sleep(1.5)
        stood = bench.far.plant.encoder_mm().copy()
        assert bench.gap_mm() < 0.02
        await asyncio.sleep(1.0)
        assert np.abs(bench.far.plant.encoder_mm() - stood).max() < 1e-3
        assert np.abs(stood - bench.plan.q_mm[-1]).max() > 0.1
        bench.motion.request("resume")
        result = await move
        assert result.cause is None
        assert np.abs(bench.far.plant.encoder_mm() - bench.plan.q_mm[-1]).max() < 0.006

    play(tmp_path, story)


def test_a_stop_by_the_operator_ends_on_the_path(tmp_path):
    async def story(bench: Bench) -> None:
        await bench.ready()
        bench.loop.call_later(0.4 * bench.plan.duration_s, bench.motion.request, "stop")
        result = await bench.motion.start(bench.plan.plan_hash)
        assert result.result == "stopped"
        assert bench.gap_mm() < 0.02
        halted = [words for _, words in bench.words if any(word & HALT for word in words.values())]
        assert all(word & HALT for word in halted[0].values())

    play(tmp_path, story)


def test_a_drive_that_faults_stops_all_and_is_named(tmp_path):
    async def story(bench: Bench) -> None:
        await bench.ready()
        bench.loop.call_later(0.4 * bench.plan.duration_s, bench.drives.trip, "B.X", 0x7121)
        result = await bench.motion.start(bench.plan.plan_hash)
        assert isinstance(result.cause, DriveFault)
        assert result.cause.where == "B.X"
        await asyncio.sleep(1.0)
        stood = bench.far.plant.encoder_mm().copy()
        await asyncio.sleep(0.5)
        assert np.abs(bench.far.plant.encoder_mm() - stood).max() < 1e-3
        assert bench.gap_mm() < 0.1

    play(tmp_path, story)


def test_a_drive_that_does_not_acknowledge_its_target_halts_all(tmp_path):
    async def story(bench: Bench) -> None:
        await bench.ready()
        control = bench.drives.drives.profile.control
        bench.drives.drives.profile.control = lambda i, *rest: control(i, *rest) if i != 7 else None
        result = await bench.motion.start(bench.plan.plan_hash)
        assert isinstance(result.cause, OutcomeUnknown)
        assert result.cause.where == "C.Y"

    play(tmp_path, story)


@pytest.mark.parametrize(
    "entry", [(0x6081, 0), *(pytest.param((i, 0), marks=pytest.mark.full) for i in (0x6083, 0x6084))]
)
def test_a_profile_that_a_drive_does_not_take_is_not_started(entry, tmp_path):
    async def story(bench: Bench) -> None:
        await bench.ready()
        bench.drives.nodes[4].dictionary.lies[entry] = 123_456_789
        result = await bench.motion.start(bench.plan.plan_hash)
        assert isinstance(result.cause, ReadBackMismatch)
        assert result.cause.where == "B.Y"
        assert not any(word & START for _, words in bench.words for word in words.values())

    play(tmp_path, story)


def test_such_drives_are_refused_where_the_cell_does_not_say_so(tmp_path):
    async def story(bench: Bench) -> None:
        with pytest.raises(WrongIdentity) as caught:
            await bench.motion.connect()
        assert "profile_position" in caught.value.text()

    play(tmp_path, story, wanted=False)
