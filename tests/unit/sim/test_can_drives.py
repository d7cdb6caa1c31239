"""The simulated drives by raw frames: lag, interpolation, SYNC loss, heartbeats, limits, brakes, SDO rules."""

import asyncio
import struct
from collections.abc import Awaitable, Callable

import numpy as np
import pytest

from sim.canopen import DriveSettings
from sim.canopen.drives import Stage
from sim.virtual_time import run_virtual
from sim.wires.virtual_can import VirtualCan
from tests.support.can_bench import Bench, can_cell

SYNC = (0x80, b"")


def rpdo(node: int, word: int, mm: float, mode: int = 8) -> tuple[int, bytes]:
    return 0x200 + node, struct.pack("<Hib", word, round(mm * 1e4), mode)


class Raw:
    """A hand on the bus that sends frames and keeps what comes back."""

    def __init__(self, bench: Bench) -> None:
        self.bench, self.heard = bench, list[tuple[int, bytes]]()
        bench.near.is_open = True
        bench.near.on_frames = self.heard.extend

    async def ask(self, node: int, request: bytes) -> bytes:
        self.heard.clear()
        self.bench.near.send([(0x600 + node, request)])
        await asyncio.sleep(0.01)
        return next(data for cob, data in self.heard if cob == 0x580 + node)

    async def write(self, node: int, index: int, sub: int, data: bytes) -> bytes:
        command = 0x23 | (4 - len(data)) << 2
        return await self.ask(node, struct.pack("<BHB", command, index, sub) + data.ljust(4, b"\x00"))

    def sync(self, *frames: tuple[int, bytes]) -> None:
        self.heard.clear()
        self.bench.near.send([*frames, SYNC])

    def position(self, node: int) -> float:
        data = next(data for cob, data in self.heard if cob == 0x180 + node)
        return int(struct.unpack("<Hih", data)[1]) / 1e4

    def word(self, node: int) -> int:
        return int(struct.unpack("<Hih", next(d for c, d in self.heard if c == 0x180 + node))[0])


def run(scenario: Callable[[Raw], Awaitable[None]], settings: DriveSettings | None = None) -> None:
    async def main() -> None:
        await scenario(Raw(Bench(can_cell(), settings)))

    run_virtual(main)


async def enabled(raw: Raw) -> None:
    """Bring the drives up with the product's own master, then take the bus over by hand."""
    await raw.bench.master.bring_up()
    await raw.bench.master.enable()
    raw.bench.master._keeper.end()
    raw.bench.near.on_frames = raw.heard.extend
    await asyncio.sleep(0.008)


async def move(raw: Raw, rate_mm: float, cycles: int, heartbeat: bool = True) -> float:
    """All axes at `rate_mm` a cycle; returns the last target of axis 1."""
    start = raw.bench.plant.position.copy()
    loop = asyncio.get_running_loop()
    t0 = loop.time()
    for k in range(1, cycles + 1):
        frames = [rpdo(i + 1, 0x0F, start[i] + rate_mm * k) for i in range(12)]
        raw.sync(*frames)
        if heartbeat and k % 10 == 0:
            raw.bench.near.send([(0x77F, b"\x05")])
        await asyncio.sleep(t0 + 0.01 * k - loop.time())
    return float(start[0] + rate_mm * cycles)


def test_boot_up_then_silence() -> None:
    async def scenario(raw: Raw) -> None:
        await asyncio.sleep(0.5)
        assert [frame for frame in raw.heard if frame[0] > 0x700] == [(0x701 + i, b"\x00") for i in range(12)]
        raw.sync(rpdo(1, 6, 0.0))
        await asyncio.sleep(0.01)
        assert raw.heard == [], "a pre-operational node takes no part in PDOs"

    run(scenario)


def test_sdo_rules() -> None:
    async def scenario(raw: Raw) -> None:
        assert (await raw.ask(3, bytes.fromhex("4018100400000000")))[4:] == struct.pack("<I", 402_003)
        assert await raw.write(3, 0x1018, 1, b"\x01\x00\x00\x00") == bytes.fromhex("8018100102000106")
        assert await raw.write(3, 0x6060, 0, b"\x08\x00") == bytes.fromhex("8060600012000706"), "too long"
        assert await raw.write(3, 0x605A, 0, b"\x09\x00") == bytes.fromhex("805a600030000906"), "out of range"
        assert await raw.write(3, 0x1600, 0, b"\x00") == bytes.fromhex("8000160022000008"), "PDO still valid"
        assert (await raw.ask(3, bytes.fromhex("e000000000000000")))[4:] == bytes.fromhex("01000405")

    run(scenario)


def test_only_mappable_layouts_are_accepted() -> None:
    async def scenario(raw: Raw) -> None:
        await raw.write(1, 0x1400, 1, struct.pack("<I", 0x8000_0201))
        assert (await raw.write(1, 0x1600, 0, b"\x00"))[0] == 0x60
        await raw.write(1, 0x1600, 1, struct.pack("<I", 0x6041_0010))
        assert await raw.write(1, 0x1600, 0, b"\x01") == bytes.fromhex("8000160041000406")

    run(scenario)


def test_read_back_carries_the_state_before_this_sync() -> None:
    async def scenario(raw: Raw) -> None:
        await enabled(raw)
        start = raw.bench.plant.position[0]
        seen = []
        for k in range(1, 5):
            raw.sync(*(rpdo(i + 1, 0x0F, raw.bench.start_mm[i] + 0.01 * k) for i in range(12)))
            await asyncio.sleep(0.01)
            seen.append(raw.position(1) - start)
        assert seen == pytest.approx([0.0, 0.01, 0.02, 0.03], abs=1e-6)

    run(scenario)


def test_an_early_sync_finds_the_axis_half_way() -> None:
    async def scenario(raw: Raw) -> None:
        await enabled(raw)
        frames = [rpdo(i + 1, 0x0F, raw.bench.start_mm[i] + 0.1) for i in range(12)]
        raw.sync(*frames)
        await asyncio.sleep(0.005)
        raw.sync()
        await asyncio.sleep(0.004)
        assert raw.position(1) - raw.bench.start_mm[0] == pytest.approx(0.05, abs=0.02)

    run(scenario)


def test_force_comes_every_tenth_sync_in_ten_newtons() -> None:
    async def scenario(raw: Raw) -> None:
        await enabled(raw)
        found = []
        for _ in range(30):
            raw.sync()
            await asyncio.sleep(0.01)
            found.append([data for cob, data in raw.heard if cob == 0x285])
        assert sum(bool(frames) for frames in found) == 3
        values = [struct.unpack("<h", frames[0])[0] for frames in found if frames]
        assert values == [104, 104, 104], "1040 N on axis 5"

    run(scenario)


def test_soft_limits_hold_the_axis_and_are_reported() -> None:
    async def scenario(raw: Raw) -> None:
        await enabled(raw)
        high = raw.bench.cell.positioners[0].axes[1].stroke_mm[1]
        raw.sync(rpdo(2, 0x0F, high + 5.0))
        await asyncio.sleep(0.01)
        raw.sync()
        await asyncio.sleep(0.005)
        assert raw.position(2) == pytest.approx(high)
        assert raw.word(2) >> 11 & 1

    run(scenario)


@pytest.mark.parametrize(
    ("reaction", "stage", "low", "high"),
    [
        ("hold", Stage.OPERATION, 0.0, 0.0),
        ("ignore", Stage.OPERATION, 0.0, 0.0),
        ("extrapolate", Stage.OPERATION, 0.6, 0.8),
        ("quick-stop", Stage.QUICK_STOP, 0.05, 0.08),
        ("fault", Stage.FAULT, 0.05, 0.08),
    ],
)
def test_what_drives_do_when_sync_stops(reaction: str, stage: Stage, low: float, high: float) -> None:
    async def scenario(raw: Raw) -> None:
        await enabled(raw)
        end = await move(raw, 0.05, 100)
        raw.bench.near.send([(0x77F, b"\x05")])
        raw.heard.clear()
        await asyncio.sleep(0.15)
        assert low - 0.001 <= raw.bench.plant.position[0] - end <= high + 0.001
        assert raw.bench.drives.drives.stages[0] is stage
        codes = {struct.unpack_from("<H", data)[0] for cob, data in raw.heard if 0x80 < cob < 0x100}
        assert codes == ({0x8700} if reaction in ("quick-stop", "fault") else set())

    run(scenario, DriveSettings(sync_loss=reaction))  # type: ignore[arg-type]


def test_lost_heartbeat_quick_stops_at_its_deadline_and_not_before_the_first() -> None:
    async def scenario(raw: Raw) -> None:
        await enabled(raw)
        loop = asyncio.get_running_loop()
        raw.bench.near.send([(0x77F, b"\x05")])
        heard_s = loop.time()
        stages = raw.bench.drives.drives.stages
        while loop.time() < heard_s + 0.275:
            raw.sync()
            await asyncio.sleep(0.005)
            assert stages[0] is Stage.OPERATION
        raw.heard.clear()
        await asyncio.sleep(0.02)
        assert stages == [Stage.QUICK_STOP] * 12
        codes = [struct.unpack("<HB5s", data)[0] for cob, data in raw.heard if 0x80 < cob < 0x100]
        assert codes == [0x8130] * 12
        assert raw.bench.drives.nodes[0].state == 5, "1029h:01 = 1 keeps the node reporting"

    run(scenario)


def test_quick_stop_without_sync_follows_6085h() -> None:
    async def scenario(raw: Raw) -> None:
        await enabled(raw)
        end = await move(raw, 0.05, 100)
        raw.sync(*(rpdo(i + 1, 0x02, end) for i in range(12)))
        await asyncio.sleep(0.3)
        way = raw.bench.plant.position[0] - end
        assert way == pytest.approx(25.0 / 400.0, abs=1e-3), "v^2 / 2a after the last target is reached"

    run(scenario)


def test_brake_times_and_torque() -> None:
    async def scenario(raw: Raw) -> None:
        await raw.bench.master.bring_up()
        drives = raw.bench.drives.drives
        opened = []
        enter = drives._brake

        def note(index: int, close: bool, t_s: float) -> None:
            opened.append((index, close, t_s))
            enter(index, close, t_s)

        drives._brake = note  # type: ignore[method-assign]
        await raw.bench.master.enable()
        assert not drives.braked.any()
        assert drives.powered.all()
        begin = opened[0][2]
        calls = [t for t, _ in raw.bench.plant.calls]
        assert calls[-1] - begin >= 0.08
        np.testing.assert_array_equal(raw.bench.plant.position, raw.bench.start_mm)

    run(scenario)


def test_torque_off_by_force_drops_the_load_until_the_brake_holds() -> None:
    async def scenario(raw: Raw) -> None:
        await enabled(raw)
        raw.sync(rpdo(1, 0x00, 0.0))
        for _ in range(20):
            await asyncio.sleep(0.01)
            raw.sync()
        await asyncio.sleep(0.01)
        fallen = raw.bench.start_mm - raw.bench.plant.position
        assert fallen[0] == pytest.approx(50.0 * 0.06, abs=0.6), "60 ms of brake at 50 mm/s"
        assert not fallen[1:].any()

    run(scenario)


def test_frames_at_rest_are_the_same_bytes() -> None:
    async def scenario(raw: Raw) -> None:
        await enabled(raw)
        batches = []
        for _ in range(9):
            raw.sync(*(rpdo(i + 1, 0x0F, raw.bench.start_mm[i]) for i in range(12)))
            await asyncio.sleep(0.01)
            batches.append([frame for frame in raw.heard if 0x180 < frame[0] < 0x200])
        assert all(batch == batches[-1] for batch in batches[2:])

    run(scenario)


def test_bus_time_and_arbitration() -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        bus = VirtualCan(loop, 500_000)
        ends = [bus.end() for _ in range(3)]
        heard: list[tuple[float, int]] = []
        for end in ends:
            await end.open()
        ends[2].on_frames = lambda frames: heard.extend((loop.time(), cob) for cob, _ in frames)
        start = loop.time()
        ends[0].send([(0x300, bytes(8)), (0x301, bytes(7))])
        ends[1].send([(0x600, bytes(8))])
        ends[0].send([(0x080, b"")])
        await asyncio.sleep(0.01)
        assert [cob for _, cob in heard] == [0x300, 0x301, 0x080, 0x600], "the lowest identifier goes first"
        first = (135 + 125) / 500_000
        assert heard[0][0] - start == pytest.approx(first)
        assert heard[2][0] - start == pytest.approx(first + 55 / 500_000)

    run_virtual(main)


def test_a_sync_that_comes_early_and_says_nothing_takes_no_way_off() -> None:
    async def scenario(raw: Raw) -> None:
        await enabled(raw)
        drives, here = raw.bench.drives.drives, raw.bench.plant.encoder_mm
        stood = float(here()[0])
        drives.latch(np.array([0]), np.array([stood + 0.1]))
        assert drives.advance(0.0, 0.004, 0.004, here)[0] == pytest.approx(stood + 0.04)
        drives.stay()
        assert drives.advance(0.0, 0.010, 0.010, here)[0] == pytest.approx(stood + 0.1)

    run(scenario)
