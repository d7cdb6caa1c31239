"""A small CAN cell for tests: cell file, a plant of ideal axes, and master and drives joined by a virtual bus."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from docking.config.cell import CellFile, DriveIdentity
from docking.config.load import load_cell
from docking.types import Array, AxisState, Feedback
from drivers.canopen.positioners import CanopenPositioners
from drivers.links.can_bus import CanBusLink
from sim.canopen import DriveGroup, DriveSettings
from sim.wires.virtual_can import VirtualCan

CELLS = Path(__file__).parents[2] / "sim" / "cells"
FALL_MM_S = 50.0


class FakePlant:
    """Motors that follow their set-points exactly, loads that fall when neither torque nor brake holds them.

    `jammed` axes stand still and build up following error. Every call of `step` is kept in `calls`.
    """

    def __init__(self, axes: tuple[str, ...], start_mm: Array, driven: NDArray[np.bool_]) -> None:
        self.axes, self.driven = axes, driven
        self.position = start_mm.copy()
        self.error = np.zeros(len(axes))
        self.jammed = np.zeros(len(axes), np.bool_)
        self.calls: list[tuple[float, Array]] = []
        self._t_s: float | None = None
        self._rest = True

    def step(self, t_s: float, target_mm: Array, powered: NDArray[np.bool_], braked: NDArray[np.bool_]) -> None:
        dt = 0.0 if self._t_s is None else t_s - self._t_s
        assert dt >= 0.0
        self._t_s = t_s
        before, before_error = self.position, self.error
        active = powered & ~braked & self.driven
        moving = active & ~self.jammed
        falling = ~powered & ~braked & self.driven
        self.position = np.where(moving, target_mm, before) - np.where(falling, FALL_MM_S * dt, 0.0)
        self.error = np.where(active, target_mm - self.position, 0.0)
        self._rest = bool((self.position == before).all() and (self.error == before_error).all())
        self.calls.append((t_s, self.position))

    def encoder_mm(self) -> Array:
        return self.position

    def following_error_mm(self) -> Array:
        return self.error

    def at_rest(self) -> bool:
        return self._rest

    def force_n(self) -> Array:
        return 1000.0 + 10.0 * np.arange(len(self.axes), dtype=np.float64)


def can_cell(name: str = "fuselage-can", **changes: object) -> CellFile:
    """A reference cell, with values of its bus changed."""
    cell = load_cell(CELLS / f"{name}.toml")
    return cell.model_copy(update={"bus": cell.bus.model_copy(update=changes)})


def foreign_drives(cell: CellFile) -> CellFile:
    """The cell with drives of any maker: no identity, no scale and no serial numbers are stated."""
    bus = cell.bus.model_copy(update={"identity": DriveIdentity(), "scale": None})
    stations = []
    for station in cell.positioners:
        axes = tuple(axis.model_copy(update={"serial_number": None}) for axis in station.axes)
        stations.append(station.model_copy(update={"axes": axes}))
    return cell.model_copy(update={"bus": bus, "positioners": tuple(stations)})


def exchange(master: CanopenPositioners, setpoint_mm: Array) -> Feedback:
    """One tick: the newest read-back, then the set-points and SYNC."""
    feedback = master.latest()
    master.send(setpoint_mm)
    return feedback


async def follow(link: CanBusLink, cycles: int) -> tuple[list[Feedback], list[Array], list[str]]:
    """Bring foreign drives up, enable them and lead them along a straight line: read-backs, set-points, identities."""
    loop = asyncio.get_running_loop()
    master = CanopenPositioners(foreign_drives(can_cell("lab-can")), link)
    identities = await master.bring_up()
    q = (await master.enable()).position_mm
    path = [q + 0.02 * k * np.linspace(-1.0, 1.0, len(q)) for k in range(cycles)]
    feedback = []
    start = loop.time()
    for k, target in enumerate(path):
        feedback.append(exchange(master, target))
        await asyncio.sleep(start + (k + 1) * master.cycle_s - loop.time())
    feedback.append(exchange(master, path[-1]))
    await asyncio.sleep(master.cycle_s)
    feedback.append(exchange(master, path[-1]))
    await master.close()
    return feedback, path, [f"{i.product} {i.serial}" for i in identities]


def lags(feedback: list[Feedback], path: list[Array]) -> list[int]:
    """By how many cycles each read-back is behind the set-point of its own cycle, from the tenth cycle on."""
    moving = [f.position_mm for f in feedback[: len(path)]]
    nearest = [min(range(len(path)), key=lambda k: float(np.abs(path[k] - p).max())) for p in moving]
    return [k - found for k, found in enumerate(nearest)][10:]


class Bench:
    """Master and drives on one virtual bus."""

    def __init__(self, cell: CellFile, settings: DriveSettings | None = None) -> None:
        loop = asyncio.get_running_loop()
        self.cell = cell
        count = len(cell.axis_names)
        self.start_mm = 1.5 * np.arange(count, dtype=np.float64) - 3.0
        self.plant = FakePlant(cell.axis_names, self.start_mm, np.array(cell.driven))
        self.bus = VirtualCan(loop, 1_000_000, "can0")
        self.near, self.far = self.bus.end(), self.bus.end()
        self.far.is_open = True
        self.drives = DriveGroup(self.plant, cell, settings or DriveSettings(), self.far, loop)
        self.drives.start()
        self.master = CanopenPositioners(cell, self.near)
        self.trace: list[tuple[int, bytes]] = []

    def watch(self) -> None:
        """Record every frame on the bus."""

        def keep(cob: int, data: bytes) -> bool:
            self.trace.append((cob, data))
            return True

        self.bus.keep = keep

    async def ready(self) -> Array:
        """Bring up and enable; returns the read-back."""
        await self.master.bring_up()
        return (await self.master.enable()).position_mm


def assert_followed(feedback: list[Feedback], path: list[Array]) -> None:
    """Enabled where the drives stood (0.1 mm times their number), on the path, never ahead of what was sent."""
    assert feedback[0].states == (AxisState.ENABLED,) * 12
    np.testing.assert_allclose(path[0], 0.1 * np.arange(1, 13), atol=1e-9)
    np.testing.assert_allclose(feedback[-1].position_mm, path[-1], atol=0.51e-4)
    assert feedback[-1].fault is None
    assert all(1 <= behind <= 5 for behind in lags(feedback, path)), "never ahead of what was sent"
