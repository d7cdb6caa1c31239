"""The ONE plant that all simulated devices share: axes, elastic component on ball joints, mate, surroundings.

Mathematics of its own (NumPy and SciPy): nothing of `docking.geometry`, `pose` or `kinematics` is used, so that an
error there cannot cancel itself here.

Start of a run: the component hangs at the first stage's stand-off with the misalignment of the truth file (turned about
its own origin), lower by what the job lifts it first, balls locked, load taken. Each socket stands exactly under its
ball, sunk by the reaction that equilibrium needs and no more: the component starts free of internal force.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from docking.config import CellFile, JobFile
from docking.errors import ConfigInvalid
from docking.types import Array, Pose, readonly
from sim.axes import AxisBank
from sim.elastic import Body, Equilibrium
from sim.followers import Followers
from sim.load_cells import LoadCells
from sim.shapes import ComponentShape, MateShape, docked_pose, pose_of
from sim.supports import gravity_unit, true_axes, true_supports
from sim.surroundings import DriftingPose, Floor, Temperatures, offset_pose
from sim.truth import Draws, TruthFile

GRAVITY_M_S2 = 9.80665
_SLOW_S = 0.5
"""Temperatures and floor move so slowly that a solution stays good for this long."""
_PASSIVE_STEPS = 20
"""Moving steps after which the linear prediction of passive axes is renewed."""


class Plant:
    """Axes order is that of the cell file. Times are loop times; the run starts at the first time the plant sees."""

    def __init__(self, cell: CellFile, job: JobFile, truth: TruthFile, seed: int) -> None:
        """Raises ConfigInvalid when a socket would have to stand outside its stroke, or names repeat."""
        draws = Draws(truth, seed)
        self._loaded = truth.part_on_balls
        self.axes: tuple[str, ...] = cell.axis_names
        self.drives = truth.drives
        self._component = ComponentShape(cell, job, truth, draws)
        self._mate = MateShape(cell, job, truth, draws)
        self._temperatures = Temperatures(truth, draws)
        self._stated_c = (job.component.temperature_c, job.mate.temperature_c, cell.temperature_c)
        mate_pose = offset_pose(pose_of(job.mate.pose), draws, "mate_pose", truth.mate_pose)
        self._mate_pose = DriftingPose(mate_pose, draws, "mate_creep", truth.mate_creep)
        self._down: Array = gravity_unit(cell)
        self._weight_n: Array = self._component.mass_kg * GRAVITY_M_S2 * self._down
        self._supports, down_signs = true_supports(cell, truth, draws)
        axis_truth = true_axes(cell, truth, draws, down_signs)
        self._equilibrium = Equilibrium(self._supports, _start_body(job, mate_pose, truth, draws, self._down))
        sockets, self._start_fore = self._seat(truth, draws)
        self._bank = AxisBank(axis_truth, sockets, self._carries)
        _check_strokes(self.axes, self._bank.motor_mm, axis_truth.stroke_mm)
        self._followers = Followers(self._supports.held_n > 0.0, self._equilibrium, self._bank)
        self._has_followers = bool(self._followers.mask.any())
        self._high_mm: Array = axis_truth.stroke_mm[:, 1]
        self._load_cells = LoadCells(cell, truth, draws)
        self._place_ers(cell, job, draws)
        ppm = truth.clock_ppm.ppm * draws.uniform("clock_ppm", (len(cell.positioners),))
        self.clock_ppm: dict[str, float] = {p.name: float(v) for p, v in zip(cell.positioners, ppm, strict=True)}
        self._resolution_mm = truth.drives.encoder_um * 1e-3
        self._has_passive = not all(cell.driven)
        self._passive = ~self._supports.driven
        self._epoch_s: float | None = None
        self._t_s = 0.0
        self._encoder: Array | None = None
        self._moved = self._pressed = False
        self._stale_steps = 0
        self._solved_at = 0.0
        self._solved_load: Array = sockets
        self._solve(0.0)

    def step(self, t_s: float, target_mm: Array, powered: NDArray[np.bool_], braked: NDArray[np.bool_]) -> None:
        """Ramp the motor set-points to `target_mm` (m,), reached at `t_s`; `powered` and `braked` (m,) apply from now.

        Unpowered axes ignore their target; passive axes ignore everything and float with the component. So do axes that
        press (see `press`), until they hold their position again.
        """
        if self._epoch_s is None:
            self._epoch_s = self._t_s = t_s
            return
        dt_s = t_s - self._t_s
        if self._has_followers:
            target_mm = self._followers.motor_mm(target_mm)
        self._moved = self._bank.step(dt_s, target_mm, powered, braked) or self._pressed
        if self._has_followers and dt_s > 0.0:
            self._moved = self._followers.run_away(dt_s, self._high_mm) or self._moved
            self._pressed = False
        if t_s > self._t_s:
            self._t_s = t_s
        if self._moved:
            self._encoder = None
            self._stale_steps += 1
        if self._has_followers and dt_s > 0.0:
            self._followers.note(self.encoder_mm(), dt_s)

    def press(self, force_n: Array, v_max_mm_s: Array) -> None:
        """Let axes exert these forces (m,) from now on instead of holding a position; NaN for axes that hold one.

        `v_max_mm_s` (m,) bounds the speed of an axis that meets no resistance.
        """
        # The slips up to now decide where an axis stands that holds its position from now on.
        self._solve(self.elapsed_s(self._t_s))
        self._followers.press(force_n, v_max_mm_s)
        self._stale_steps, self._pressed, self._encoder = self._stale_steps + 1, True, None

    def encoder_mm(self) -> Array:
        """Encoder positions (m,), motor side, quantised. Read-only; the same array until something moves."""
        if self._encoder is None:
            position = self._bank.motor_mm
            if self._has_passive:
                position = np.where(self._passive, self._passive_position(), position)
            self._encoder = np.rint(position / self._resolution_mm) * self._resolution_mm
            self._encoder.setflags(write=False)
        return self._encoder

    def following_error_mm(self) -> Array:
        """Set-point minus motor position (m,)."""
        return self._bank.following_error_mm

    def at_rest(self) -> bool:
        """True when the last step changed nothing."""
        return not self._moved

    def force_n(self) -> Array:
        """Load-cell readings (m,): force on the component along each axis, so a Z axis that carries weight reads > 0.

        NaN where no load cell is fitted. Every call draws fresh noise.
        """
        return self._load_cells.read_n(self.true_axis_forces_n(), self.elapsed_s(self._t_s))

    def target_names(self) -> tuple[str, ...]:
        """All reflectors: ERS points, mate and component targets, check points, measured features (NAME.C, NAME.M)."""
        return self._names

    def target_W_mm(self, name: str, t_s: float) -> Array:
        """True centre (3,) of one reflector in W. Raises KeyError for an unknown name."""
        row: Array = self.targets_W_mm(t_s)[self._row[name]]
        return row

    def targets_W_mm(self, t_s: float) -> Array:
        """True reflector centres (n, 3) in W, in the order of `target_names`."""
        elapsed = self.elapsed_s(t_s)
        self._refresh(elapsed)
        component_k, mate_k = self._temperatures.excess_k(elapsed)
        body = self._equilibrium.body
        down, change = body.rotation.T @ self._down, self._support_change()
        part = self._component.targets_mm(component_k, down, change)
        features = self._component.features_mm(component_k, down, change)[self._seen_features]
        X_WM = self._mate_pose.at(elapsed)
        mate, mate_features = self._mate.targets_mm(mate_k), self._mate.features_mm(mate_k)[self._seen_features]
        on_mate = X_WM.apply(np.vstack((mate, mate_features)))
        return np.vstack(
            (self._ers, on_mate[: len(mate)], body.place(np.vstack((part, features))), on_mate[len(mate) :])
        )

    def true_feature_errors_mm(self) -> Array:
        """True distances (f,) between the component's features and the mate's, now."""
        elapsed = self.elapsed_s(self._t_s)
        self._refresh(elapsed)
        component_k, mate_k = self._temperatures.excess_k(elapsed)
        body = self._equilibrium.body
        part = self._component.features_mm(component_k, body.rotation.T @ self._down, self._support_change())
        mate = self._mate_pose.at(elapsed).apply(self._mate.features_mm(mate_k))
        distances: Array = np.linalg.norm(body.place(part) - mate, axis=1)
        return distances

    def true_internal_force_n(self) -> float:
        """Largest ball force (N, norm) beyond what equilibrium needs."""
        elapsed = self.elapsed_s(self._t_s)
        self._refresh(elapsed)
        balls, com = self._geometry(elapsed)
        needed = self._equilibrium.stress_free_n(self._equilibrium.body, balls, com, self._weight_n)
        return float(np.linalg.norm(self._equilibrium.ball_forces_n(self._equilibrium.force_n - needed), axis=1).max())

    def true_axis_forces_n(self) -> Array:
        """True forces (m,) on the component along each axis, without load-cell errors."""
        if not self._loaded:
            return readonly(np.zeros(len(self.axes)))
        self._refresh(self.elapsed_s(self._t_s))
        return readonly(self._equilibrium.force_n)

    def component_pose_W(self) -> Pose:
        """True pose X_WC now."""
        self._refresh(self.elapsed_s(self._t_s))
        body = self._equilibrium.body
        return Pose(body.rotation, body.origin_mm)

    def elapsed_s(self, t_s: float) -> float:
        """Time since the run began."""
        if self._epoch_s is None:
            self._epoch_s = self._t_s = t_s
        return max(0.0, t_s - self._epoch_s)

    def temperatures_c(self, t_s: float) -> dict[str, float]:
        """True temperatures, deg C: component and mate; the floor has the cell's reference temperature."""
        component_k, mate_k = self._temperatures.excess_k(self.elapsed_s(t_s))
        stated = self._stated_c
        return {"component": stated[0] + component_k, "mate": stated[1] + mate_k, "floor": stated[2]}

    def heat(self, part: str, by_k: float) -> None:
        """Make component or mate warmer at once. Raises ValueError for anything else."""
        if part not in ("component", "mate"):
            raise ValueError(f"{part} is neither component nor mate")
        self._temperatures.heat(by_k * (part == "component"), by_k * (part == "mate"))
        self._stale_steps += 1

    def jam(self, axis: str) -> None:
        """Seize an axis mechanically. Raises ValueError for an unknown axis."""
        self._seize(axis, True)

    def release(self, axis: str) -> None:
        """Free a jammed or creeping axis."""
        self._seize(axis, False)

    def lose_ball(self, axis: str) -> None:
        """Lift the ball out of the socket of a force-controlled axis: it presses against nothing.

        Raises ValueError for any other axis.
        """
        index = self.axes.index(axis)
        if not self._followers.mask[index]:
            raise ValueError(f"{axis} holds no force")
        self._solve(self.elapsed_s(self._t_s))
        self._followers.lose(index, float(self.encoder_mm()[index]))
        self._stale_steps, self._pressed, self._encoder = self._stale_steps + 1, True, None

    def displace(self, axis: str, by_mm: float) -> None:
        """Have a driven axis stand `by_mm` from where it stood: the part is left strained."""
        self._bank.displace(self._driven(axis), by_mm)
        self._encoder = None
        self._stale_steps += 1

    def slip(self, axis: str, by_mm: float) -> None:
        """Let the socket of a driven axis give way by so much against its encoder, which does not see it."""
        self._bank.slip_mm[self._driven(axis)] = by_mm
        self._stale_steps += 1

    def creep(self, axis: str, speed_mm_s: float) -> None:
        """Let a driven axis move whatever its servo and brake want: drift, slipping brake, runaway."""
        self._bank.seize(self._driven(axis), True, speed_mm_s)

    def weaken(self, axis: str, v_mm_s: float, a_mm_s2: float) -> None:
        """Let a driven axis reach no more than this speed and acceleration."""
        self._bank.weaken(self._driven(axis), v_mm_s, a_mm_s2)

    def misread_force(self, axis: str, offset_n: float) -> None:
        """Add this to what the load cell reads along `axis`; NaN and infinity break it. The true force stays."""
        self._load_cells.offset_n[self.axes.index(axis)] = offset_n

    # What follows works out the component's equilibrium, only when somebody asks.

    def _driven(self, axis: str) -> int:
        index = self.axes.index(axis)
        if self._passive[index]:
            raise ValueError(f"{axis} is passive: it has no servo and no brake")
        return index

    def _seize(self, axis: str, jammed: bool) -> None:
        index = self.axes.index(axis)
        if self._followers.mask[index]:
            self._solve(self.elapsed_s(self._t_s))
            self._followers.jam(index, jammed)
            self._stale_steps += 1
        elif self._passive[index]:
            self._equilibrium.lock(index, jammed)
            self._stale_steps += 1
        else:
            self._bank.seize(index, jammed)

    def _geometry(self, elapsed_s: float) -> tuple[Array, Array]:
        """Balls (k, 3) and centre of mass (3,) in C at the present temperature."""
        excess, _ = self._temperatures.excess_k(elapsed_s)
        return self._component.balls_mm(excess), self._component.com_mm * self._component.growth(excess)

    def _seat(self, truth: TruthFile, draws: Draws) -> tuple[Array, float]:
        """Socket positions (m,) under the balls, free of internal force, and the fore share; sets up the floor."""
        balls, com = self._geometry(0.0)
        body = self._equilibrium.body
        needed = self._equilibrium.stress_free_n(body, balls, com, self._weight_n)
        loads = self._equilibrium.ball_forces_n(needed) @ -self._down
        self._floor = Floor(truth, draws, loads * len(loads) / float(loads.sum()))
        sockets: Array = self._equilibrium.axis_coordinates(body, balls) + needed / self._supports.stiffness
        return sockets, self._component.fore_share(loads)

    def _support_change(self) -> float:
        loads = self._equilibrium.ball_forces_n(self._equilibrium.force_n) @ -self._down
        return self._component.fore_share(loads) - self._start_fore

    def _refresh(self, elapsed_s: float) -> None:
        if self._stale_steps or not abs(elapsed_s - self._solved_at) <= _SLOW_S:
            self._solve(elapsed_s)

    def _solve(self, elapsed_s: float) -> None:
        balls, com = self._geometry(elapsed_s)
        load = self._bank.load_mm()
        sunk = np.repeat(self._floor.sunk_mm(elapsed_s), 3) * (self._supports.rows @ self._down)
        self._equilibrium.advance(load - self._solved_load)
        self._equilibrium.solve(load + sunk, balls, com, self._weight_n)
        self._solved_load, self._solved_at, self._stale_steps = load, elapsed_s, 0
        if self._has_passive:
            self._encoder = None

    def _passive_position(self) -> Array:
        if self._stale_steps > _PASSIVE_STEPS:
            self._solve(self.elapsed_s(self._t_s))
        slide = self._equilibrium.passive_shift_mm(self._bank.load_mm() - self._solved_load)
        position: Array = self._bank.motor_mm + self._equilibrium.slip_mm + slide
        return self._followers.shown_mm(position) if self._has_followers else position

    def _carries(self, index: int) -> bool:
        """True while the vertical axis `index` bears load."""
        if not self._loaded:
            return False
        self._solve(self.elapsed_s(self._t_s))
        upward = -self._supports.rows[index] @ self._down * self._equilibrium.force_n[index]
        return bool(upward > 0.0)

    def _place_ers(self, cell: CellFile, job: JobFile, draws: Draws) -> None:
        """True ERS points: the file's, each off by a draw of its own stated sigma; then the table of all reflectors."""
        nominal = np.array([e.xyz_mm for e in cell.tracker.ers])
        sigma = np.array([e.sigma_mm for e in cell.tracker.ers])
        self._seen_features = [i for i, f in enumerate(job.component.features) if f.measured]
        self._ers: Array = nominal + sigma[:, None] * draws.normal("ers_points", nominal.shape)
        features = [job.component.features[i].name for i in self._seen_features]
        names = tuple(e.name for e in cell.tracker.ers) + self._mate.target_names + self._component.target_names
        names += tuple(f"{name}.C" for name in features) + tuple(f"{name}.M" for name in features)
        of_part = (*self._component.target_names, *(f"{name}.C" for name in features))
        self.absent: frozenset[str] = frozenset() if self._loaded else frozenset(of_part)
        self._row = {name: i for i, name in enumerate(names)}
        if len(self._row) != len(names):
            repeated = sorted({n for n in names if names.count(n) > 1})
            raise ConfigInvalid("simulated cell", (f"reflector names must differ: {', '.join(repeated)} repeat",))
        self._names = names


def _start_body(job: JobFile, mate: Pose, truth: TruthFile, draws: Draws, down: Array) -> Body:
    """The component at the first stage's stand-off, misaligned about its own origin, before any lift."""
    goal = docked_pose(job, mate)
    axis = mate.R @ np.array(job.docking_axis)
    shift = draws.uniform("misalignment", (3,)) * truth.misalignment.mm
    angles = draws.uniform("misalignment", (3,)) * truth.misalignment.deg
    turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    standoff = job.stages[0].standoff_mm * axis / np.linalg.norm(axis)
    return Body(turn @ goal.R, goal.t_mm - standoff + shift + job.lift_mm * down)


def _check_strokes(axes: tuple[str, ...], motor_mm: Array, stroke_mm: Array) -> None:
    problems = tuple(
        f"axis {name} would start at {position:.1f} mm, outside its stroke {low:g} to {high:g} mm"
        for name, position, (low, high) in zip(axes, motor_mm, stroke_mm, strict=True)
        if not low <= position <= high
    )
    if problems:
        raise ConfigInvalid("simulated cell: start pose", problems)
