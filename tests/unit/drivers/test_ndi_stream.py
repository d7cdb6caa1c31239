"""NdiStream against the simulated camera over a paced virtual line with speeds of its own, in virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from docking.config.instruments import NdiConfig
from docking.errors import BadReply, DeviceRefused, DeviceSilent, LinkError, LinkLost, PortMissing, ReadBackMismatch
from docking.sightings import PointFrame, Sight
from docking.types import Identity
from drivers.ndi_stream import NdiStream
from sim.tracker.ndi import NdiCamera
from sim.virtual_time import run_virtual
from sim.wires.virtual_serial import VirtualSerial
from tests.fakes.camera_scene import ROM_A, ROM_B, FakeScene


class Bench:
    """One camera, one driver, one line that begins at 9600 baud."""

    def __init__(self, *, roms: dict[str, bytes] | None = None, plugged: tuple[str, ...] = (), **config: Any) -> None:
        self.loop = asyncio.get_running_loop()
        self.wire = VirtualSerial(self.loop, 9600)
        self.scene = FakeScene()
        self.camera = NdiCamera(self.scene, self.wire.far, self.loop, {ROM_A: "nose", ROM_B: "ring"}, plugged)
        self.camera.noise_mm = 0.0
        asked = {"nose tool": ROM_A, "ring tool": ROM_B} if roms is None else roms
        self.stream = NdiStream(self.wire.near, NdiConfig(port="x", **config), asked)
        self.frames: list[PointFrame] = []
        self.lost: list[LinkError] = []
        self.stream.on_frame, self.stream.on_lost = self.frames.append, self.lost.append


def on_bench(scenario: Callable[[Bench], Awaitable[None]], **changes: Any) -> None:
    async def main() -> None:
        bench = Bench(**changes)
        await bench.stream.connect()
        await bench.stream.start()
        await scenario(bench)
        await bench.stream.close()

    run_virtual(main)


def test_bring_up_changes_the_speed_and_proves_the_tools() -> None:
    async def main() -> tuple[Identity, Bench]:
        bench = Bench()
        return await bench.stream.connect(), bench

    who, bench = run_virtual(main)
    assert who == Identity("camera", "NDI", "Simulated camera control", "SIM-0001", "1.002.003")
    assert bench.wire._host_baud == bench.wire._device_baud == 115200
    assert [(h.tool, h.status) for h in bench.camera._handles.values()] == [("nose", 0x31), ("ring", 0x31)]
    assert bytes(bench.camera._handles["01"].rom).rstrip(b"\0") == ROM_A


def test_tools_and_markers_come_with_place_turn_and_number() -> None:
    async def scenario(bench: Bench) -> None:
        await asyncio.sleep(1.0)
        frame = bench.frames[-1]
        for tool, name in zip(frame.tools, ("nose", "ring"), strict=True):
            rotation, p_mm = bench.scene.tools[name]
            assert (tool.name, tool.sight) == (f"{name} tool", Sight.SEEN)
            np.testing.assert_allclose(tool.p_T_mm, p_mm, atol=0.0051)
            w, x, y, z = tool.turn
            np.testing.assert_allclose(Rotation.from_quat((x, y, z, w)).as_matrix(), rotation, atol=2e-4)
        np.testing.assert_allclose(frame.strays_T_mm, bench.scene.strays, atol=0.0051)
        numbers = [f.number for f in bench.frames]
        assert numbers == sorted(set(numbers))
        # A question of 12 and an answer of 194 characters: at 115200 baud the wire carries no more.
        assert len(numbers) == pytest.approx(115200 / 10 / (12 + 194), abs=1)
        await bench.stream.stop()
        count = len(bench.frames)
        await asyncio.sleep(0.5)
        assert len(bench.frames) == count
        assert not bench.lost

    on_bench(scenario)


def test_the_time_of_a_frame_is_that_of_its_exposure() -> None:
    async def scenario(bench: Bench) -> None:
        bench.scene.speed_mm_s = 100.0
        await asyncio.sleep(2.0)
        x_mm = np.array([f.tools[0].p_T_mm[0] for f in bench.frames[30:]])
        t_s = np.array([f.t_s for f in bench.frames[30:]])
        speed, at_zero = np.polyfit(t_s, x_mm, 1)
        assert speed == pytest.approx(100.0, rel=2e-3)
        # Behind the true place by the transfer of one reply (about 20 ms) and by no more than one exposure.
        assert 0.0 < (bench.scene.tools["nose"][1][0] - at_zero) / 100.0 < 0.045
        assert np.ptp(x_mm - (speed * t_s + at_zero)) < 2.0

    on_bench(scenario)


def test_a_plugged_tool_is_named_by_its_part_number() -> None:
    async def scenario(bench: Bench) -> None:
        await asyncio.sleep(0.2)
        assert [t.name for t in bench.frames[-1].tools] == ["ring"]
        assert not len(bench.frames[-1].strays_T_mm)

    on_bench(scenario, roms={}, plugged=("ring",), strays=False)


@pytest.mark.parametrize(("fault", "sight"), [("missing", Sight.MISSING), ("outside", Sight.OUTSIDE)])
def test_a_tool_that_is_not_well_seen_says_so(fault: str, sight: Sight) -> None:
    async def scenario(bench: Bench) -> None:
        getattr(bench.camera.faults, fault).add("nose")
        bench.camera.faults.system_status = 0x0202
        await asyncio.sleep(0.2)
        frame = bench.frames[-1]
        assert [t.sight for t in frame.tools] == [sight, Sight.SEEN]
        assert bool(np.isnan(frame.tools[0].p_T_mm).all()) == (sight is Sight.MISSING)
        assert frame.warnings == ("too much infrared light", "temperature out of range")

    on_bench(scenario)


@pytest.mark.parametrize(
    ("errors", "ignores", "error", "words"),
    [
        ({"PINIT": 0x13}, set(), DeviceRefused, "could not be initialised"),
        ({"PVWR": 0x08}, set(), DeviceRefused, "no such tool handle"),
        ({"VER": 0x01}, set(), DeviceRefused, "unknown command"),
        ({"COMM": 0x06}, set(), DeviceRefused, "line settings"),
        ({}, {"PENA"}, DeviceRefused, "no tool is enabled"),
        ({}, {"COMM"}, DeviceSilent, "no reply to INIT"),
    ],
)
def test_a_bring_up_that_fails_says_at_what(
    errors: dict[str, int], ignores: set[str], error: type[LinkError], words: str
) -> None:
    async def main() -> None:
        bench = Bench()
        bench.camera.faults.errors, bench.camera.faults.ignores = errors, ignores
        with pytest.raises(error, match=words):
            await bench.stream.connect()

    run_virtual(main)


def test_a_tool_that_is_said_to_be_enabled_and_is_not_is_named() -> None:
    async def main() -> None:
        bench = Bench()
        enable = bench.camera._commands["PENA"]
        bench.camera._commands["PENA"] = lambda params: "OKAY" if params[:2] == "02" else enable(params)
        with pytest.raises(ReadBackMismatch, match="ring tool"):
            await bench.stream.connect()

    run_virtual(main)


def test_an_unknown_definition_is_refused() -> None:
    async def main() -> None:
        with pytest.raises(DeviceRefused, match="PINIT"):
            await Bench(roms={"other": b"another tool"}).stream.connect()

    run_virtual(main)


def test_where_no_break_passes_the_device_is_sought_at_both_speeds() -> None:
    async def main() -> None:
        bench = Bench()
        bench.wire.far.on_break = lambda: None
        await bench.stream.connect()
        await bench.stream.close()
        # A second session finds it at the speed of the first.
        bench.wire.far.on_break = lambda: None
        await bench.stream.connect()
        bench.camera.faults.silent = True
        with pytest.raises(DeviceSilent, match="neither at 115200"):
            await bench.stream.connect()

    run_virtual(main)


def test_lost_and_broken_replies_cost_frames_not_the_stream() -> None:
    async def scenario(bench: Bench) -> None:
        bench.camera.faults.drop_share = 0.05
        await asyncio.sleep(10.0)
        bench.camera.faults.drop_share, bench.camera.faults.garbage_bytes = 0.0, 12
        await asyncio.sleep(0.05)
        bench.camera.faults.garbage_bytes = 0
        await asyncio.sleep(5.0)
        assert not bench.lost
        np.testing.assert_allclose(bench.frames[-1].tools[1].p_T_mm, bench.scene.tools["ring"][1], atol=0.0051)

    on_bench(scenario)


@pytest.mark.parametrize(
    ("fault", "value", "error", "words"),
    [
        ("silent", True, DeviceSilent, "TX"),
        ("bad_crc", True, DeviceSilent, "TX"),
        ("cut_to", 30, DeviceSilent, "TX"),
        ("frozen", True, BadReply, "frozen"),
        ("errors", {"TX": 0x0C}, DeviceRefused, "present mode"),
    ],
)
def test_a_stream_that_ends_says_why_once(fault: str, value: object, error: type[LinkError], words: str) -> None:
    async def scenario(bench: Bench) -> None:
        await asyncio.sleep(0.5)
        setattr(bench.camera.faults, fault, value)
        at_s = bench.loop.time()
        bench.stream.on_lost = lambda e: (bench.lost.append(e), bench.lost.append(bench.loop.time() - at_s))  # type: ignore[arg-type,func-returns-value]
        await asyncio.sleep(10.0)
        assert len(bench.lost) == 2
        assert isinstance(bench.lost[0], error)
        assert words in str(bench.lost[0])
        assert bench.lost[1] < 3.5  # type: ignore[operator]

    on_bench(scenario)


def test_a_restarted_camera_is_noticed() -> None:
    async def scenario(bench: Bench) -> None:
        await asyncio.sleep(2.0)
        bench.camera._on_since_s = bench.loop.time()
        await asyncio.sleep(0.5)
        assert "restarted" in str(bench.lost[0])

    on_bench(scenario)


def test_a_vanished_port_ends_the_stream_at_once_and_it_can_be_joined_again() -> None:
    async def scenario(bench: Bench) -> None:
        await asyncio.sleep(0.5)
        bench.wire.unplug("pulled")
        await asyncio.sleep(0.001)
        assert isinstance(bench.lost[0], LinkLost)
        with pytest.raises(PortMissing):
            await bench.stream.connect()
        bench.wire.replug()
        await bench.stream.connect()
        await bench.stream.start()
        count = len(bench.frames)
        await asyncio.sleep(0.5)
        assert len(bench.frames) > count + 20

    on_bench(scenario)


def test_a_reply_given_up_never_answers_another_command() -> None:
    async def scenario(bench: Bench) -> None:
        await asyncio.sleep(0.3)
        await bench.stream.stop()
        bench.camera.faults.late_s = 2.2
        with pytest.raises(DeviceSilent):
            await bench.stream.line.ask("ECHO", "first")
        bench.camera.faults.late_s = 0.0
        assert await bench.stream.line.ask("ECHO", "second") == "second"
        assert bench.stream.line.stale_replies == 1

    on_bench(scenario)
