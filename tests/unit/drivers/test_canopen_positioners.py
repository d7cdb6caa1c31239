"""The whole CANopen driver against the simulated drives over a virtual bus, in virtual time."""

import asyncio
import struct
from collections.abc import Awaitable, Callable, Sequence

import numpy as np
import pytest

from docking.errors import (
    AxisLimitExceeded,
    DeviceRefused,
    DeviceSilent,
    EnableFailed,
    LinkLost,
    ReadBackMismatch,
    WrongIdentity,
)
from docking.types import Array, AxisState, Feedback
from drivers.canopen.cia402 import DriveState, decode
from sim.canopen import DriveSettings
from sim.canopen.drives import Stage
from sim.virtual_time import run_virtual
from tests.support.can_bench import Bench, can_cell, exchange

CYCLE_S = 0.01


async def tick(bench: Bench, q: Callable[[int], Array], count: int) -> list[Feedback]:
    """Exchange `count` set-points q(k) on absolute deadlines."""
    loop = asyncio.get_running_loop()
    start = loop.time()
    feedback = []
    for k in range(count):
        feedback.append(exchange(bench.master, q(k)))
        await asyncio.sleep(start + (k + 1) * CYCLE_S - loop.time())
    return feedback


def run(scenario: Callable[[Bench], Awaitable[None]], settings: DriveSettings | None = None, **bus: object) -> None:
    async def main() -> None:
        await scenario(Bench(can_cell(**bus), settings))

    run_virtual(main)


# bring-up --------------------------------------------------------------------------------------------------------
def test_bring_up_proves_writes_and_leaves_the_axes_disabled() -> None:
    async def scenario(bench: Bench) -> None:
        identities = await bench.master.bring_up()
        assert [i.where for i in identities] == list(bench.cell.axis_names)
        assert identities[4].serial == "402005"
        assert "Simulated positioner drive" in identities[0].product
        assert identities[0].firmware.startswith("1.3.0")
        drives, axis = bench.drives.drives, bench.cell.positioners[0].axes[0]
        assert all(stage is Stage.SWITCH_ON_DISABLED for stage in drives.stages)
        assert drives.parameters.low_mm[0] == axis.stroke_mm[0]
        assert drives.parameters.high_mm[0] == axis.stroke_mm[1]
        assert drives.parameters.decel_mm_s2[0] == axis.a_quick_mm_s2
        assert drives.parameters.window_mm[0] == 2.0 * bench.cell.limits.following_error_vmax_mm
        assert drives.parameters.quick_stop_option == [6] * 12
        node = bench.drives.nodes[0]
        assert node.number_of(0x1016, 1) == 127 << 16 | 280
        assert node.number_of(0x1017) == 100
        assert (node.number_of(0x60C2, 1), node.number_of(0x60C2, 2)) == (1, -2)
        assert node.number_of(0x1402, 1) >> 31, "a set-point PDO that the factory left valid is switched off"
        feedback = exchange(bench.master, np.full(12, np.nan))
        assert feedback.states == (AxisState.DISABLED,) * 12
        np.testing.assert_allclose(feedback.position_mm, bench.start_mm, atol=1e-9)

    run(scenario)


def test_passive_axes_have_no_set_point_frame_and_stay_free() -> None:
    async def main() -> None:
        bench = Bench(can_cell("follower-can"))
        bench.watch()
        await bench.ready()
        passive = [n.number for n, driven in zip(bench.drives.nodes, bench.cell.driven, strict=True) if not driven]
        assert passive
        await tick(bench, lambda k: bench.start_mm, 5)
        assert not {0x200 + number for number in passive} & {cob for cob, _ in bench.trace}
        for node, driven in zip(bench.drives.nodes, bench.cell.driven, strict=True):
            enabled = bench.drives.drives.stages[node.index] is Stage.OPERATION
            assert enabled == driven
        feedback = exchange(bench.master, np.where(bench.cell.driven, bench.start_mm, np.nan))
        np.testing.assert_allclose(feedback.position_mm, bench.start_mm, atol=1e-9)

    run_virtual(main)


def test_silent_node_is_named() -> None:
    async def scenario(bench: Bench) -> None:
        bench.drives.mute("B.Y")
        with pytest.raises(DeviceSilent) as caught:
            await bench.master.bring_up()
        assert caught.value.where == "B.Y"

    run(scenario)


def test_two_devices_with_one_number_are_found() -> None:
    async def scenario(bench: Bench) -> None:
        twin = bench.bus.end()
        twin.is_open = True
        server = bench.drives.nodes[2].server

        def answer(frames: list[tuple[int, bytes]]) -> None:
            for cob, data in frames:
                if cob == 0x603:
                    reply = type(server)(bench.drives.nodes[2].dictionary).answer(data)
                    if reply is not None:
                        twin.send([(0x583, reply)])

        twin.on_frames = answer
        with pytest.raises(WrongIdentity, match="two devices") as caught:
            await bench.master.bring_up()
        assert caught.value.where == "A.Z"

    run(scenario)


def test_swapped_drive_is_found_by_its_serial_number() -> None:
    async def main() -> None:
        cell = can_cell()
        first = cell.positioners[0]
        axes = (first.axes[0].model_copy(update={"serial_number": 402_002}), *first.axes[1:])
        positioners = (first.model_copy(update={"axes": axes}), *cell.positioners[1:])
        bench = Bench(cell.model_copy(update={"positioners": positioners}))
        with pytest.raises(WrongIdentity) as caught:
            await bench.master.bring_up()
        assert caught.value.where == "A.X"
        assert "402001" in str(caught.value.value)
        assert "402002" in str(caught.value.limit)

    run_virtual(main)


def test_a_drive_that_does_not_keep_what_is_written_is_named() -> None:
    async def scenario(bench: Bench) -> None:
        dictionary = bench.drives.nodes[7].dictionary
        read = dictionary.read

        def forgetful(index: int, sub: int) -> bytes:
            return struct.pack("<I", 1) if (index, sub) == (0x6085, 0) else read(index, sub)

        dictionary.read = forgetful  # type: ignore[method-assign]
        with pytest.raises(ReadBackMismatch) as caught:
            await bench.master.bring_up()
        assert caught.value.where == "C.Y"
        assert "6085h" in caught.value.cause
        assert (caught.value.value, caught.value.limit) == (1, 2_000_000)

    run(scenario)


def test_a_drive_without_the_mode_is_refused() -> None:
    async def scenario(bench: Bench) -> None:
        live = bench.drives.live
        bench.drives.live = lambda i, o, s: 1 if (i, o) == (0, 0x6502) else live(i, o, s)  # type: ignore[method-assign]
        with pytest.raises(WrongIdentity, match="cyclic synchronous position"):
            await bench.master.bring_up()

    run(scenario)


def test_a_mode_that_is_never_displayed_is_refused() -> None:
    async def scenario(bench: Bench) -> None:
        live = bench.drives.live
        bench.drives.live = lambda i, o, s: 0 if (i, o) == (3, 0x6061) else live(i, o, s)  # type: ignore[method-assign]
        with pytest.raises(ReadBackMismatch) as caught:
            await bench.master.bring_up()
        assert caught.value.where == "B.X"
        assert "6061h" in caught.value.cause

    run(scenario)


def test_a_drive_that_refuses_a_write_says_why() -> None:
    async def scenario(bench: Bench) -> None:
        bench.drives.nodes[0].state = 5
        bench.bus.keep = lambda cob, data: cob != 0
        with pytest.raises(DeviceRefused) as caught:
            await bench.master.bring_up()
        assert caught.value.where == "A.X"
        assert caught.value.value == "08000022h"

    run(scenario)


# enabling --------------------------------------------------------------------------------------------------------
def test_enabling_commands_every_axis_to_where_it_stands() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.master.bring_up()
        bench.plant.position = bench.start_mm + 0.7
        bench.watch()
        feedback = await bench.master.enable()
        assert feedback.states == (AxisState.ENABLED,) * 12
        np.testing.assert_allclose(feedback.position_mm, bench.start_mm + 0.7, atol=1e-9)
        np.testing.assert_allclose(bench.plant.position, bench.start_mm + 0.7, atol=1e-9)
        for cob, data in bench.trace:
            if 0x200 < cob < 0x280:
                word, target, mode = struct.unpack("<Hib", data)
                assert mode == 8
                if word & 8:
                    index = cob - 0x201
                    assert abs(target / 1e4 - bench.start_mm[index] - 0.7) <= 0.01, "first set-point is the read-back"

    run(scenario)


def test_no_axis_is_enabled_before_all_are_switched_on() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.master.bring_up()
        bench.watch()
        await bench.master.enable()
        states = [DriveState.SWITCH_ON_DISABLED] * 12
        for cob, data in bench.trace:
            if 0x180 < cob < 0x200:
                states[cob - 0x181] = decode(int.from_bytes(data[:2], "little"))
            if 0x200 < cob < 0x280 and data[0] == 0x0F:
                assert all(s in (DriveState.SWITCHED_ON, DriveState.OPERATION_ENABLED) for s in states)

    run(scenario)


def test_one_axis_that_fails_disables_all() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.master.bring_up()
        asyncio.get_running_loop().call_later(0.05, bench.drives.trip, "C.X", 0x2310)
        with pytest.raises(EnableFailed) as caught:
            await bench.master.enable()
        assert caught.value.where == "C.X"
        assert "overcurrent" in caught.value.cause
        stages = bench.drives.drives.stages
        assert stages[6] is Stage.FAULT
        assert all(stage is Stage.SWITCH_ON_DISABLED for i, stage in enumerate(stages) if i != 6)
        assert bench.drives.drives.braked.all()
        np.testing.assert_array_equal(bench.plant.position, bench.start_mm)

    run(scenario)


def test_a_fault_is_not_reset_by_enabling_but_on_order() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.master.bring_up()
        bench.drives.trip("A.Y", 0x4210)
        with pytest.raises(EnableFailed, match="drive too hot"):
            await bench.master.enable()
        await bench.master.reset_faults()
        feedback = await bench.master.enable()
        assert feedback.states == (AxisState.ENABLED,) * 12
        assert feedback.fault is None

    run(scenario)


def test_first_set_point_far_from_the_axis_is_refused_and_not_sent() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        far = q.copy()
        far[3] = 0.0
        with pytest.raises(ReadBackMismatch) as caught:
            exchange(bench.master, far)
        assert caught.value.where == "B.X"
        assert caught.value.value == pytest.approx(abs(q[3]))
        await asyncio.sleep(0.05)
        np.testing.assert_array_equal(bench.plant.position, bench.start_mm)

    run(scenario)


# cycle -----------------------------------------------------------------------------------------------------------
def test_set_points_are_followed_one_cycle_late_and_exactly() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        path = [q + 0.05 * k * np.linspace(-1.0, 1.0, 12) for k in range(100)]
        feedback = await tick(bench, lambda k: path[k], 100)
        for k in range(2, 100):
            np.testing.assert_allclose(feedback[k].position_mm, path[k - 2], atol=0.51e-4)
            assert feedback[k].fault is None
            assert not feedback[k].age_cycles.any()
        assert feedback[50].t_s - feedback[49].t_s == pytest.approx(CYCLE_S)
        np.testing.assert_allclose(feedback[60].force_n, 1000.0 + 10.0 * np.arange(12), atol=5.0)

    run(scenario)


def test_set_points_on_the_bus_are_counts_of_a_tenth_of_a_micrometre() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        bench.watch()
        await tick(bench, lambda k: q - 0.01234, 1)
        sent = {cob: data for cob, data in bench.trace if 0x200 < cob < 0x280}
        assert struct.unpack("<Hib", sent[0x201])[1] == round((bench.start_mm[0] - 0.01234) * 1e4)
        assert [cob for cob, _ in bench.trace][:13] == [*range(0x201, 0x20D), 0x80], "SYNC closes the batch"

    run(scenario)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 3e5])
def test_impossible_set_point_is_refused_by_name(bad: float) -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, lambda k: q, 2)
        bench.watch()
        wrong = q.copy()
        wrong[5] = bad
        with pytest.raises(AxisLimitExceeded) as caught:
            exchange(bench.master, wrong)
        assert caught.value.where == "B.Z"
        assert not bench.trace

    run(scenario)


def test_lost_read_backs_age() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        bench.bus.keep = lambda cob, data: cob != 0x184
        feedback = await tick(bench, lambda k: q, 6)
        assert feedback[-1].age_cycles[3] >= 5
        # A set that stays incomplete is over when the next begins.
        assert (np.delete(feedback[-1].age_cycles, 3) == 1.0).all()
        bench.bus.keep = None
        feedback = await tick(bench, lambda k: q, 3)
        assert not feedback[-1].age_cycles.any()

    run(scenario)


def steady(q: Array, speed_mm_s: float = 5.0) -> Callable[[int], Array]:
    """Set-points of axes that all move differently."""
    return lambda k: q + speed_mm_s * CYCLE_S * k * np.linspace(-1.0, 1.0, 12)


@pytest.mark.parametrize("late_s", [0.0, 0.003, 0.009])
def test_read_backs_that_come_in_pieces_are_never_mixed(late_s: float) -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        loop, deliver = asyncio.get_running_loop(), bench.near.on_frames

        def in_pieces(frames: list[tuple[int, bytes]]) -> None:
            for piece in (frames[:5], frames[5:6]):
                deliver(piece)
            loop.call_later(late_s, deliver, frames[6:])

        await tick(bench, lambda k: q, 5)
        bench.near.on_frames = in_pieces
        path = steady(q)
        feedback = await tick(bench, path, 100)
        assert feedback[-1].fault is None
        for k, one in enumerate(feedback[3:], 3):
            assert len(set(one.age_cycles)) == 1
            assert one.age_cycles[0] == (0.0 if late_s < 0.007 else 1.0)
            same = [i for i in range(k) if np.abs(one.position_mm - path(i)).max() <= 0.51e-4]
            assert same == [k - 2 - int(one.age_cycles[0])], "all of one SYNC"

    run(scenario)


@pytest.mark.parametrize("lost", [range(0x181, 0x186), range(0x186, 0x18D), (0x181,), (0x18C,)])
def test_read_backs_in_pieces_stay_together_after_a_loss(lost: Sequence[int]) -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        deliver, turn = bench.near.on_frames, iter(range(10**6))

        def in_pieces(frames: list[tuple[int, bytes]]) -> None:
            if next(turn) == 10:
                frames = [frame for frame in frames if frame[0] not in lost]
            for frame in frames:
                deliver([frame])

        await tick(bench, lambda k: q, 5)
        bench.near.on_frames = in_pieces
        path = steady(q)
        feedback = await tick(bench, path, 60)
        for k, one in enumerate(feedback[3:], 3):
            for axis, lag in enumerate(one.age_cycles.astype(int)):
                assert one.position_mm[axis] == pytest.approx(path(k - 2 - lag)[axis], abs=0.51e-4)
        late = [one for one in feedback if one.age_cycles.any()]
        assert len(late) == 1
        assert not feedback[-1].age_cycles.any()

    run(scenario)


def test_one_lost_read_back_leaves_the_others_whole() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        path, turn = steady(q), iter(range(10**6))
        bench.bus.keep = lambda cob, data: cob != 0x184 or next(turn) % 7 != 3
        feedback = await tick(bench, path, 100)
        for k, one in enumerate(feedback[3:], 3):
            lag = one.age_cycles.astype(int)
            for axis in range(12):
                assert one.position_mm[axis] == pytest.approx(path(k - 2 - lag[axis])[axis], abs=0.51e-4)
            assert lag.max() <= 1
            assert (lag == 0).all() or (lag >= 1).all()
        assert {int(one.age_cycles.max()) for one in feedback[3:]} == {0, 1}

    run(scenario)


def test_a_link_may_use_one_list_for_all_its_batches() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        deliver, shared = bench.near.on_frames, list[tuple[int, bytes]]()

        def reuse(frames: list[tuple[int, bytes]]) -> None:
            shared[:] = frames
            deliver(shared)

        bench.near.on_frames = reuse
        path = steady(q)
        await tick(bench, lambda k: q, 5)
        feedback = await tick(bench, path, 50)
        for k in range(2, 50):
            np.testing.assert_allclose(feedback[k].position_mm, path(k - 2), atol=0.51e-4)

    run(scenario)


def test_a_force_that_is_not_repeated_for_three_periods_is_forgotten() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, lambda k: q, 12)
        bench.bus.keep = lambda cob, data: cob != 0x284
        feedback = await tick(bench, lambda k: q, 45)
        gone = [bool(np.isnan(one.force_n[3])) for one in feedback]
        assert gone == sorted(gone)
        # Three periods of ten cycles after the last one, which came up to ten cycles before.
        assert 20 <= gone.index(True) <= 32
        assert not np.isnan(np.delete(feedback[-1].force_n, 3)).any()
        bench.bus.keep = None
        feedback = await tick(bench, lambda k: q, 13)
        assert feedback[-1].force_n[3] == pytest.approx(1030.0, abs=5.0)

    run(scenario)


def test_a_load_cell_that_shows_its_most_negative_count_shows_nothing() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        broken = 1000.0 + 10.0 * np.arange(12)
        broken[[3, 5]] = -327680.0, -327670.0
        bench.plant.force_n = lambda: broken  # type: ignore[method-assign]
        feedback = await tick(bench, lambda k: q, 13)
        assert np.isnan(feedback[-1].force_n[3])
        assert feedback[-1].force_n[5] == -327670.0
        assert not np.isnan(np.delete(feedback[-1].force_n, 3)).any()

    run(scenario)


def test_a_load_cell_that_never_reports_is_named_before_anything_is_enabled() -> None:
    async def scenario(bench: Bench) -> None:
        bench.bus.keep = lambda cob, data: cob != 0x284
        with pytest.raises(DeviceSilent, match="no force") as caught:
            await bench.master.bring_up()
        assert caught.value.where == "B.X"

    run(scenario)


def test_the_keeper_hands_over_and_does_not_take_over_again() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await asyncio.sleep(0.5)
        assert bench.drives.drives.stages[0] is Stage.OPERATION, "SYNC and heartbeat go on until the first exchange"
        await tick(bench, lambda k: q, 3)
        bench.watch()
        await asyncio.sleep(0.2)
        assert 0x80 not in {cob for cob, _ in bench.trace}
        await asyncio.sleep(0.3)
        assert bench.drives.drives.stages[0] is Stage.QUICK_STOP, "the drives noticed that the controller is gone"

    run(scenario)


# stops and faults ------------------------------------------------------------------------------------------------
def test_quick_stop_lasts_and_stops_on_the_ramp() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        speed = 5.0
        await tick(bench, lambda k: q + speed * CYCLE_S * k, 100)
        before = bench.plant.position.copy()
        bench.master.quick_stop()
        feedback = await tick(bench, lambda k: q + 100.0, 100)
        assert feedback[-1].states == (AxisState.STOPPING,) * 12
        way = feedback[-1].position_mm - before
        a_quick = bench.cell.positioners[0].axes[0].a_quick_mm_s2
        assert way == pytest.approx(speed**2 / 2 / a_quick + speed * CYCLE_S, abs=speed * CYCLE_S + 0.01)
        assert bench.drives.drives.powered.all()
        again = await bench.master.enable()
        assert again.states == (AxisState.ENABLED,) * 12
        np.testing.assert_allclose(bench.plant.position, feedback[-1].position_mm, atol=1e-4)

    run(scenario)


def test_drive_fault_arrives_in_words_and_the_first_cause_is_kept() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, lambda k: q, 5)
        bench.drives.trip("D.Z", 0x7305)
        bench.drives.trip("A.X", 0x8611)
        feedback = await tick(bench, lambda k: q, 30)
        assert feedback[-1].fault == ("D.Z", 0x7305, "encoder fault")
        assert feedback[-1].states[0] is AxisState.FAULT
        assert feedback[-1].states[1] is AxisState.ENABLED

    run(scenario)


def test_jammed_axis_trips_its_own_drive() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        bench.plant.jammed[4] = True
        feedback = await tick(bench, lambda k: q + 0.05 * k, 60)
        fault = next(f.fault for f in feedback if f.fault is not None)
        assert fault == ("B.Y", 0x8611, "following error outside its window")
        errors = [f.following_error_mm[4] for f in feedback]
        # 1 mm window, 20 ms at 5 mm/s, one cycle, then the ramp: 25 / 400 mm.
        assert max(errors) == pytest.approx(1.0 + 0.1 + 0.05 + 0.0625, abs=0.06)
        assert not any(np.delete(f.following_error_mm, 4).any() for f in feedback)

    run(scenario)


@pytest.mark.parametrize(
    ("action", "text"),
    [("restart", "restarted"), ("mute", "no heartbeat")],
)
def test_node_events(action: str, text: str) -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, lambda k: q, 5)
        getattr(bench.drives, action)("C.Z")
        feedback = await tick(bench, lambda k: q, 60)
        assert feedback[-1].fault is not None
        assert feedback[-1].fault[0] == "C.Z"
        assert text in feedback[-1].fault[2]

    run(scenario)


def test_foreign_set_points_are_noticed() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, lambda k: q, 3)
        intruder = bench.bus.end()
        intruder.is_open = True
        intruder.send([(0x202, struct.pack("<Hib", 0x0F, 0, 8))])
        feedback = await tick(bench, lambda k: q, 5)
        assert feedback[-1].fault is not None
        assert feedback[-1].fault[0] == "A.Y"

    run(scenario)


def test_lost_link() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, lambda k: q, 3)
        bench.bus.cut("cable pulled")
        with pytest.raises(LinkLost, match="cable pulled"):
            exchange(bench.master, q)
        bench.master.quick_stop()
        await bench.master.close()

    run(scenario)


# closing ---------------------------------------------------------------------------------------------------------
def test_closing_brakes_before_it_takes_the_torque() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, lambda k: q, 3)
        await bench.master.close()
        drives = bench.drives.drives
        assert all(stage is Stage.SWITCH_ON_DISABLED for stage in drives.stages)
        assert drives.braked.all()
        assert not drives.powered.any()
        np.testing.assert_array_equal(bench.plant.position, bench.start_mm, "an axis fell")

    run(scenario)


def test_closing_out_of_quick_stop_does_not_drop_the_load() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, lambda k: q, 3)
        bench.master.quick_stop()
        await tick(bench, lambda k: q, 3)
        await bench.master.close()
        np.testing.assert_array_equal(bench.plant.position, bench.start_mm)
        assert bench.drives.drives.braked.all()

    run(scenario)


def test_a_brake_that_does_not_close_keeps_the_torque() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, lambda k: q, 3)
        with pytest.raises(EnableFailed, match="brake") as caught:
            await bench.master.close()
        assert caught.value.where == "A.X"
        await asyncio.sleep(1.0)
        np.testing.assert_array_equal(bench.plant.position, bench.start_mm)

    run(scenario, DriveSettings(brake_close_s=10.0))


def test_bring_up_takes_over_axes_that_a_dead_controller_left_enabled() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, lambda k: q, 3)
        successor = type(bench.master)(bench.cell, bench.bus.end())
        bench.near.close()
        await successor.bring_up()
        np.testing.assert_array_equal(bench.plant.position, bench.start_mm)
        assert bench.drives.drives.braked.all()
        feedback = await successor.enable()
        assert feedback.states == (AxisState.ENABLED,) * 12

    run(scenario)
