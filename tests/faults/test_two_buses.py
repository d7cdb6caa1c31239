"""One cell on two CAN buses: both buses begin a cycle together, and neither goes on without the other."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from docking.assemble.motion_side import local_motion
from docking.assemble.requests import RunRequest
from docking.assemble.runs import dry_run
from docking.assemble.simulated import make_far_end, truth_of
from docking.assemble.wires import NearBus, can_of
from docking.config.build import plan_settings
from docking.config.check import check_cell
from docking.config.load import load_cell, load_job
from docking.errors import ConfigInvalid, DeviceSilent, LinkLost
from docking.transcript import Transcript, read_transcript
from drivers.canopen.channels import ChannelledCan
from sim.canopen.shares import PlantShares
from sim.virtual_time import run_virtual
from sim.wires.virtual_can import VirtualCan
from tests.support.motion_record import QUICK_STOP, SET_POINT, RecordedPlant
from tests.support.planned_moves import a_plan, lab_site
from tests.support.two_buses import FIRST, SECOND, two_bus_files

CYCLE_S = 0.01
SYNC = 0x80
NODES = {FIRST: set(range(1, 7)), SECOND: set(range(7, 13))}
Frame = tuple[int, bytes]


@dataclass
class Seen:
    """Everything that left the controller, by bus, and what the drives did."""

    sent: dict[str, list[tuple[float, list[Frame]]]]
    plant: RecordedPlant
    buses: dict[str, VirtualCan]
    near: dict[str, Any]
    motion: Any
    can: ChannelledCan

    def syncs(self, name: str) -> list[float]:
        return [t for t, frames in self.sent[name] if (SYNC, b"") in frames]

    def words(self, name: str, since_s: float) -> list[dict[int, int]]:
        """Controlwords by node of every batch from `since_s` on."""
        later = [frames for t, frames in self.sent[name] if t >= since_s]
        return [{c - 0x200: SET_POINT.unpack(d)[0] for c, d in frames if 0x200 < c < 0x280} for frames in later]


async def two_buses(tmp_path, change=lambda cell: cell, transcript=None) -> Seen:
    """The cell, not brought up."""
    loop = asyncio.get_running_loop()
    path = two_bus_files(tmp_path)
    cell = load_cell(path)
    job = load_job(path.with_name("lab-can2.job.toml"), cell)
    truth = truth_of(path)
    truth = truth.model_copy(update={"drives": truth.drives.model_copy(update={"sync_loss_cycles": 3.0})})
    far = make_far_end(cell, job, truth, 1)
    plant = RecordedPlant(far.plant)
    far.shares = PlantShares(plant, CYCLE_S)
    cell = cell.model_copy(update={"inputs": None})
    sent: dict[str, list[tuple[float, list[Frame]]]] = {FIRST: [], SECOND: []}
    buses, near = {}, {}
    for name in cell.bus.channels:
        buses[name] = VirtualCan(loop, cell.bus.bitrate, name)
        end = buses[name].end()
        await end.open()
        far.drives(cell, end, channel=name)
        near[name] = buses[name].end()
        put = near[name].send

        def tapped(frames, name=name, put=put):
            sent[name].append((loop.time(), frames))
            put(frames)

        near[name].send = tapped
    can = can_of(change(cell), near)
    assert isinstance(can, ChannelledCan)
    motion = local_motion(change(cell), job, NearBus(can), transcript)
    return Seen(sent, plant, buses, near, motion, can)


async def moving(seen: Seen) -> asyncio.Task:
    await seen.motion.connect()
    start_mm = await seen.motion.enable()
    plan = a_plan(lab_site(), 3, start_mm=start_mm)
    await seen.motion.load(plan)
    task = asyncio.ensure_future(seen.motion.start(plan.plan_hash))
    await asyncio.sleep(0.5 * plan.duration_s)
    return task


def test_a_cell_on_two_buses_docks(tmp_path):
    said: list[str] = []
    summary = dry_run(RunRequest(two_bus_files(tmp_path), None, 1, None, None, "en"), said.append)
    assert summary["outcome"] == "docked"
    assert summary["true_max_feature_error_mm"] <= summary["tolerance_mm"]
    # Axes of two buses that began a cycle apart would squeeze the figure by v x T = 50 um.
    assert summary["max_consistency_residual_mm"] < 0.005


def test_every_cycle_of_a_move_begins_on_both_buses_at_once(tmp_path):
    async def main():
        seen = await two_buses(tmp_path)
        task = await moving(seen)
        begun_s = asyncio.get_running_loop().time() - 0.5
        result = await task
        await seen.motion.close()
        return seen, begun_s, result

    seen, begun_s, result = run_virtual(main)
    assert result.cause is None
    ticks = [t for t in seen.syncs(FIRST) if begun_s <= t <= begun_s + 0.9]
    assert len(ticks) > 80
    assert ticks == [t for t in seen.syncs(SECOND) if begun_s <= t <= begun_s + 0.9]
    for name, nodes in NODES.items():
        assert {c & 0x7F for _, frames in seen.sent[name] for c, _ in frames if 0x200 < c < 0x680} == nodes
        beats = [frame for _, frames in seen.sent[name] for frame in frames if frame[0] == 0x77F]
        assert len(beats) > 5


@pytest.mark.parametrize("lost", [FIRST, SECOND])
@pytest.mark.parametrize("how", ["bus-off", "send refused"])
def test_when_one_bus_dies_the_axes_on_the_other_stop_within_two_cycles(lost, how, tmp_path):
    other = SECOND if lost == FIRST else FIRST

    async def main():
        loop = asyncio.get_running_loop()
        seen = await two_buses(tmp_path)
        task = await moving(seen)
        died_s = loop.time()
        if how == "bus-off":
            seen.buses[lost].cut("the controller went bus-off")
        else:
            # The adapter refuses the next batch: the other bus may have its set-points of this cycle already.
            seen.near[lost].send = lambda frames: seen.near[lost].drop("cannot send: no buffer space available")
        result = await task
        await asyncio.sleep(0.5)
        rest = seen.plant.encoder_mm().copy()
        await asyncio.sleep(0.5)
        drift = float(np.abs(seen.plant.encoder_mm() - rest).max())
        await seen.motion.close()
        await asyncio.sleep(0.1)
        return seen, died_s, result, drift

    seen, died_s, result, drift = run_virtual(main)
    assert isinstance(result.cause, LinkLost)
    assert lost in result.cause.text()
    words = seen.words(other, died_s)
    told = next(i for i, by_node in enumerate(words) if QUICK_STOP in by_node.values())
    told_s = [t for t, _ in seen.sent[other] if t >= died_s][told]
    assert told_s - died_s <= 2.0 * CYCLE_S
    assert words[told] == dict.fromkeys(NODES[other], QUICK_STOP)
    assert not any(by_node for by_node in words[told + 1 :]), "the stop was overwritten"
    ours = [k for k, axis in enumerate(seen.plant.axes) if (axis[0] in "AB") == (other == FIRST)]
    ticks = [tick for tick in seen.plant.ticks if tick.t_s >= died_s]
    fastest = max(abs(tick.motor_mm[k] - before.motor_mm[k]) for before, tick in pairwise(ticks) for k in ours)
    assert fastest > 1e-3, "they were moving"
    # Quick-stop ramps armed for the move take 25 ms or less; two cycles to hear of it.
    after = [tick for tick in ticks if tick.t_s >= died_s + 2.0 * CYCLE_S + 0.06]
    assert max(float(np.ptp([tick.motor_mm[k] for tick in after])) for k in ours) < 2e-3
    assert drift < 1e-3
    assert not seen.can.is_open


def test_a_drive_at_the_wrong_cable_is_silent_and_named(tmp_path):
    def swapped(cell):
        stations = [p.model_copy(update={"can_channel": SECOND}) if p.name == "B" else p for p in cell.positioners]
        return cell.model_copy(update={"positioners": tuple(stations)})

    async def main():
        seen = await two_buses(tmp_path, swapped)
        with pytest.raises(DeviceSilent) as caught:
            await seen.motion.connect()
        await seen.motion.close()
        return caught.value

    assert run_virtual(main).where == "B.X"


def test_each_bus_has_its_own_name_in_the_transcript(tmp_path):
    path = tmp_path / "bytes.txt"

    async def main():
        transcript = Transcript(path, asyncio.get_running_loop().time)
        seen = await two_buses(tmp_path, transcript=transcript)
        await seen.motion.connect()
        await seen.motion.close()
        transcript.close()

    run_virtual(main)
    found: dict[str, set[int]] = {}
    for line in read_transcript(path):
        if line.cob is not None and 0x180 < line.cob < 0x200:
            found.setdefault(line.wire, set()).add(line.cob - 0x180)
    assert found == {f"can:{name}": nodes for name, nodes in NODES.items()}


def test_the_skew_of_the_buses_bounds_the_speed_of_a_plan(tmp_path):
    path = two_bus_files(tmp_path, skew_s=0.02)
    cell = load_cell(path)
    settings = plan_settings(cell, load_job(path.with_name("lab-can2.job.toml"), cell))
    assert settings.start_skew_s == 0.02
    base = lab_site()
    assert base.settings.start_skew_s == 0.0
    apart = a_plan(type(base)(base.positioners, settings, *[getattr(base, f) for f in SITE_REST]), 3)
    together = a_plan(base, 3)
    # sync_error_mm / skew = 0.05 / 0.02 = 2.5 mm/s; the stage would allow 4.
    assert apart.speed_limited_by == "start skew of the bus"
    assert together.speed_limited_by != "start skew of the bus"
    assert apart.duration_s > together.duration_s


SITE_REST = ("start_mm", "pivot_mm", "speed_mm_s", "reach_mm", "turn_deg")


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('can_channel = "can1"', 'can_channel = "can7"', "positioners[2].can_channel: 'can7' is none of the buses"),
        ('further_channels = ["can1"]', 'further_channels = ["can1", "can2"]', "no positioner is on 'can2'"),
        ('further_channels = ["can1"]', 'further_channels = ["can1", "can0"]', "CAN channel"),
    ],
)
def test_channels_are_checked(old, new, told, tmp_path):
    path = two_bus_files(tmp_path)
    path.write_text(path.read_text("utf-8").replace(old, new, 1), "utf-8")
    with pytest.raises(ConfigInvalid) as caught:
        load_cell(path)
    assert told in caught.value.text()


def test_two_buses_halve_the_load_of_each(tmp_path):
    path = two_bus_files(tmp_path)
    fast = path.read_text("utf-8").replace("cycle_s = 0.01", "cycle_s = 0.005")
    path.write_text(fast, "utf-8")
    assert not [f for f in check_cell(load_cell(path)) if f.key == "bus.cycle_s"]
    one = path.parent / "one.toml"
    one.write_text(fast.replace('further_channels = ["can1"]\n', "").replace('can_channel = "can1"\n', ""), "utf-8")
    assert [f for f in check_cell(load_cell(one)) if f.key == "bus.cycle_s"]
