"""What happens on the drives' side of a CAN cell, tick by tick, and where it stands beside its plan.

Nothing of the controller's own mathematics is used: set-points are decoded from the frames, a figure is laid on by SVD.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from docking.config.cell import CellFile
from docking.types import Array, Plan
from sim.plant import Plant
from tests.support.rigid_figure import rigid_gap_mm, sockets_mm

SET_POINT = struct.Struct("<HiB")
QUICK_STOP, ENABLED = 0x02, 0x0F
AS_SENT_MM = 0.002
"""A rigid figure of twelve axes in counts of 0.1 um."""
MOVES_MM = 2e-4
"""More than this between two cycles is motion: 0.02 mm/s."""


@dataclass
class Tick:
    """One step of the plant: set-points of the power stages and motors (m,), who has torque, whose brake is closed."""

    t_s: float
    target_mm: Array
    motor_mm: Array
    powered: NDArray[np.bool_]
    braked: NDArray[np.bool_]


class RecordedPlant:
    """`PlantAxes` around a plant: every step is kept. From `weigh_from_s` on the true internal force is kept, too."""

    def __init__(self, plant: Plant) -> None:
        self.plant, self.axes = plant, plant.axes
        self.ticks: list[Tick] = []
        self.weigh_from_s = float("inf")
        self.weigh_until_s = float("inf")
        self.force_n_at: list[tuple[float, float]] = []
        self.beyond_n_at: list[Array] = []
        self._seizes: tuple[str, float] | None = None
        self.encoder_mm = plant.encoder_mm
        self.following_error_mm = plant.following_error_mm
        self.at_rest = plant.at_rest
        self.force_n = plant.force_n
        self.press = plant.press

    def seize_within(self, axis: str, share: float) -> None:
        """Have an axis seize after this share of the next step."""
        self._seizes = (axis, share)

    def _seize_back(self, before_mm: Array) -> None:
        """The step that was just made ended for one axis where it seized; its set-point went on."""
        assert self._seizes is not None
        (axis, share), self._seizes, bank = self._seizes, None, self.plant._bank
        k = self.axes.index(axis)
        back_mm = (1.0 - share) * float(bank.motor_mm[k] - before_mm[k])
        self.plant.displace(axis, -back_mm)
        bank._set[k] += back_mm
        self.plant.jam(axis)

    def step(self, t_s: float, target_mm: Array, powered: NDArray[np.bool_], braked: NDArray[np.bool_]) -> None:
        self.plant.step(t_s, target_mm, powered, braked)
        if self._seizes is not None:
            self._seize_back(self.ticks[-1].motor_mm)
        motor = self.plant._bank.motor_mm.copy()
        self.ticks.append(Tick(t_s, target_mm.copy(), motor, powered.copy(), braked.copy()))
        if self.weigh_from_s <= t_s <= self.weigh_until_s:
            beyond_n = self.beyond_n()
            self.beyond_n_at.append(beyond_n)
            self.force_n_at.append((t_s, float(np.linalg.norm(beyond_n, axis=1).max())))

    def beyond_n(self) -> Array:
        """True ball forces (k, 3) beyond what equilibrium needs, now."""
        plant = self.plant
        elapsed_s = plant.elapsed_s(plant._t_s)
        plant._refresh(elapsed_s)
        balls, com = plant._geometry(elapsed_s)
        needed = plant._equilibrium.stress_free_n(plant._equilibrium.body, balls, com, plant._weight_n)
        forces: Array = plant._equilibrium.ball_forces_n(plant._equilibrium.force_n - needed)
        return forces


@dataclass
class Sent:
    """What left the controller, one row a SYNC: `word` (n, d) controlwords, `target_mm` (n, d) of the driven axes."""

    t_s: Array
    word: NDArray[np.int64]
    target_mm: Array


@dataclass
class Record:
    """Frames and ticks of one run with the cell that they belong to."""

    cell: CellFile
    plant: RecordedPlant
    batches: list[tuple[float, list[tuple[int, bytes]]]] = field(default_factory=list)
    beats_s: list[float] = field(default_factory=list)

    def hear(self, t_s: float, frames: list[tuple[int, bytes]]) -> None:
        """Frames of the controller on their way to the bus."""
        for cob, _ in frames:
            if cob == 0x080:
                self.batches.append((t_s, frames))
            elif cob > 0x700:
                self.beats_s.append(t_s)

    @property
    def nodes(self) -> list[int]:
        """Node numbers of the driven axes, in the cell's order."""
        return [axis.node or 0 for p in self.cell.positioners for axis in p.axes if axis.driven]

    def sent(self) -> Sent:
        """All cycles in which every driven axis got a set-point."""
        nodes, counts = self.nodes, self.cell.bus.counts_per_mm  # type: ignore[union-attr]
        times, rows = [], []
        for t_s, frames in self.batches:
            found = {cob - 0x200: data for cob, data in frames if 0x200 < cob < 0x280}
            if len(found) == len(nodes):
                times.append(t_s)
                rows.append([SET_POINT.unpack(found[node])[:2] for node in nodes])
        table = np.array(rows, dtype=np.int64).reshape(len(rows), len(nodes), 2)
        return Sent(np.array(times), table[:, :, 0], table[:, :, 1] / counts)

    def motors(self, from_s: float = 0.0) -> tuple[Array, Array]:
        """Times (n,) and motor positions (n, m) from a time on."""
        ticks = [tick for tick in self.plant.ticks if tick.t_s >= from_s - 1e-9]
        return np.array([tick.t_s for tick in ticks]), np.array([tick.motor_mm for tick in ticks])

    def set_points(self, from_s: float = 0.0) -> tuple[Array, Array]:
        """Times (n,) and set-points inside the power stages (n, m) from a time on."""
        ticks = [tick for tick in self.plant.ticks if tick.t_s >= from_s - 1e-9]
        return np.array([tick.t_s for tick in ticks]), np.array([tick.target_mm for tick in ticks])

    def figure_gap_mm(self, q_mm: Array, start_mm: Array) -> Array:
        """Distance (n,) of the sockets at `q_mm` (n, m) from the rigid figure at `start_mm` (m,), worst ball."""
        origins = np.array([p.origin_mm for p in self.cell.positioners])
        axes = np.array([np.transpose([a.direction for a in p.axes]) for p in self.cell.positioners])
        return rigid_gap_mm(sockets_mm(origins, axes, start_mm)[0], sockets_mm(origins, axes, q_mm))


def along(plan: Plan, q_mm: Array, columns: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Where on a plan rows `q_mm` (n, m) are nearest, path time (n,), and how far beside it (n,), `columns` only."""
    table = plan.q_mm[:, columns]
    start, chord = table[:-1], np.diff(table, axis=0)
    length2 = np.maximum(np.einsum("rm,rm->r", chord, chord), 1e-18)
    gap = q_mm[:, None, columns] - start
    share = np.clip(np.einsum("nrm,rm->nr", gap, chord) / length2, 0.0, 1.0)
    beside = np.linalg.norm(gap - share[:, :, None] * chord, axis=2)
    best = beside.argmin(axis=1)
    rows = np.arange(len(q_mm))
    return (best + share[rows, best]) * plan.period_s, beside[rows, best]
