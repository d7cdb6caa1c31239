"""What the cell measures, in what order: station, mate, component, and the references before every fit.

All readings become points in W through the station fit. The station's own uncertainty moves component and mate alike
and cancels in their difference; what does not cancel is drift, and that is what the reference check bounds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from docking.calibration.station import locate_station, reference_shift
from docking.errors import DeviceSilent, StationMoved, TargetLost, TwoFaceDisagrees
from docking.ports import Journal, Tracker
from docking.pose import FitSettings, NoiseModel, fit_pose, screen
from docking.records import fit_record, station_record
from docking.types import Array, Fit, Points, Pose, Reading


@dataclass(frozen=True)
class SurveySettings:
    """How often and how strictly: passes a point, reference points a check, sigmas a drift may reach."""

    passes: int
    drift_points: int
    two_face_limit_mm: float
    noise: NoiseModel
    station_fit: FitSettings
    mate_fit: FitSettings
    component_fit: FitSettings
    drift_sigmas: float = 3.0
    attempts: int = 2


@dataclass(frozen=True)
class Nominals:
    """Nominal points: ERS in W, mate targets in M, component targets and check points in C."""

    ers: Points
    mate: Points
    targets: Points
    checks: Points


@dataclass
class Survey:
    """The tracker's work in one docking. `X_WT` and `X_WM` hold the newest fits."""

    tracker: Tracker
    journal: Journal
    nominals: Nominals
    settings: SurveySettings
    clock: Callable[[], float]
    X_WT: Fit | None = None
    X_WM: Fit | None = None
    checked_at_s: float = float("nan")
    component: Points | None = None
    checks: Points | None = None
    _reference_W_mm: dict[str, Array] = field(default_factory=dict)

    async def locate(self, X_WT_guess: Pose, X_WM_guess: Pose) -> None:
        """Measure all ERS points and fit the station, then all mate targets and fit the mate."""
        guess = self.X_WT.X_MN if self.X_WT is not None else X_WT_guess
        await self._check_faces(guess)
        ers = await self._shoot("ers", self.nominals.ers, guess, Pose.identity(), self.settings.passes)
        self.X_WT = locate_station(self.nominals.ers, ers, self.settings.station_fit)
        self.journal.write("station", station_record(self.X_WT))
        X_WM = self.X_WM.X_MN if self.X_WM is not None else X_WM_guess
        mate = await self._measure_W("mate", self.nominals.mate, X_WM, self.settings.passes)
        self.X_WM = fit_pose(screen(self.nominals.mate, mate, self.settings.mate_fit), self.settings.mate_fit)
        self.journal.write("fit", fit_record(self.X_WM, "mate", "frame"))
        self._keep_references(ers, mate)
        self.checked_at_s = self.clock()

    async def measure_component(self, X_WC_guess: Pose, X_WM_guess: Pose, passes: int, *, more: bool = False) -> None:
        """Measure targets and check points in `passes` passes, then the references; again if the station moved."""
        for _ in range(self.settings.attempts + 1):
            targets = await self._measure_W("component", self.nominals.targets, X_WC_guess, passes)
            checks = await self._measure_W("check", self.nominals.checks, X_WC_guess, passes)
            moved = await self._check_references()
            if moved is None:
                self.component = _joined(self.component, targets) if more and self.component else targets
                self.checks = _joined(self.checks, checks) if more and self.checks else checks
                return
            more = False
            await self.locate(self._station(), X_WM_guess)
        raise moved

    def _station(self) -> Pose:
        if self.X_WT is None:
            raise StationMoved("tracker", "the station is not located")
        return self.X_WT.X_MN

    async def _check_faces(self, X_WT: Pose) -> None:
        if not self.tracker.two_face:
            return
        name, p_W = self.nominals.ers.names[0], self.nominals.ers.xyz_mm[0]
        near = X_WT.inverse().apply(p_W)
        one = await self.tracker.measure(name, near, 1)
        two = await self.tracker.measure(name, near, 2)
        gap = float(np.linalg.norm(one.p_T_mm - two.p_T_mm))
        sigma = float(np.sqrt(np.trace(one.cov_mm2 + two.cov_mm2)))
        limit = max(self.settings.two_face_limit_mm, self.settings.drift_sigmas * sigma)
        self.journal.write("two_face", {"target": name, "difference_mm": gap, "limit_mm": limit})
        if not (gap <= limit):
            raise TwoFaceDisagrees(name, value=gap, limit=limit)

    async def _measure_W(self, group: str, nominal: Points, X_WN: Pose, passes: int) -> Points:
        X_WT = self._station()
        return _placed(await self._shoot(group, nominal, X_WT, X_WN, passes), X_WT)

    async def _shoot(self, group: str, nominal: Points, X_WT: Pose, X_WN: Pose, passes: int) -> Points:
        """All points of a group in T, pass after pass; a lost target is left out and the record says so."""
        near = X_WT.inverse().apply(X_WN.apply(nominal.xyz_mm)) if len(nominal) else nominal.xyz_mm
        rows: list[tuple[Reading, int]] = []
        lost: list[str] = []
        for run in range(1, passes + 1):
            for name, near_T_mm in zip(nominal.names, near, strict=True):
                reading = await self._one(name, near_T_mm)
                if reading is None:
                    lost.append(name)
                else:
                    rows.append((reading, run))
        self.journal.write("measurement", {"group": group, "readings": [_row(*r) for r in rows], "lost": lost})
        return _points(rows)

    async def _one(self, name: str, near_T_mm: Array) -> Reading | None:
        """One reading; measuring moves nothing, so a silent instrument is asked a second time."""
        for attempt in range(self.settings.attempts):
            try:
                return await self.tracker.measure(name, near_T_mm)
            except TargetLost:
                continue
            except DeviceSilent:
                if attempt + 1 == self.settings.attempts:
                    raise
        return None

    def _keep_references(self, ers: Points, mate: Points) -> None:
        X_WT = self._station()
        placed = _placed(ers, X_WT)
        self._reference_W_mm = {**_means(placed), **_means(mate)}

    async def _check_references(self) -> StationMoved | None:
        """Re-measure some ERS points and mate targets; the shift that is more than noise, if there is one."""
        X_WT, X_WM = self._station(), self.X_WM
        for reference, nominal, X in (
            ("ers", self.nominals.ers, Pose.identity()),
            ("mate", self.nominals.mate, X_WM.X_MN if X_WM else Pose.identity()),
        ):
            chosen = _spread(nominal, self._reference_W_mm, self.settings.drift_points)
            again = await self._shoot("drift", chosen, X_WT, X, self.settings.passes)
            shift, limit = reference_shift(
                self._reference_W_mm, _placed(again, X_WT), self.settings.passes, self.settings.drift_sigmas
            )
            moved = not (shift <= limit)
            body = {"reference": reference, "shift_mm": shift, "limit_mm": limit, "restationed": moved}
            self.journal.write("drift", body)
            if moved:
                return StationMoved(reference, "measured again against the references", value=shift, limit=limit)
        self.checked_at_s = self.clock()
        return None


def _spread(nominal: Points, known: dict[str, Array], count: int) -> Points:
    """`count` of the points that were measured before, evenly through their list."""
    index = [i for i, name in enumerate(nominal.names) if name in known]
    picked = [index[round(k)] for k in np.linspace(0, len(index) - 1, min(count, len(index)))]
    names = tuple(nominal.names[i] for i in picked)
    return Points(names, nominal.xyz_mm[picked], nominal.cov_mm2[picked])


def _placed(points: Points, X_WT: Pose) -> Points:
    """Points of the station in W; the covariance is the instrument's alone."""
    cov = X_WT.R @ points.cov_mm2 @ X_WT.R.T if len(points) else points.cov_mm2
    return Points(points.names, X_WT.apply(points.xyz_mm), cov, points.passes)


def _points(rows: list[tuple[Reading, int]]) -> Points:
    return Points(
        tuple(r.target for r, _ in rows),
        np.array([r.p_T_mm for r, _ in rows]).reshape(-1, 3),
        np.array([r.cov_mm2 for r, _ in rows]).reshape(-1, 3, 3),
        tuple(run for _, run in rows),
    )


def _joined(first: Points, more: Points) -> Points:
    last = max(first.passes, default=0)
    return Points(
        first.names + more.names,
        np.vstack([first.xyz_mm, more.xyz_mm]),
        np.concatenate([first.cov_mm2, more.cov_mm2]),
        first.passes + tuple(p + last for p in more.passes),
    )


def _means(points: Points) -> dict[str, Array]:
    """Median of the passes of each point: one gross reading among three or more does not move it."""
    names = dict.fromkeys(points.names)
    rows = {n: [x for m, x in zip(points.names, points.xyz_mm, strict=True) if m == n] for n in names}
    return {n: np.median(np.array(x), axis=0) for n, x in rows.items()}


def _row(reading: Reading, run: int) -> dict[str, object]:
    return {
        "target": reading.target,
        "pass": run,
        "p_T_mm": reading.p_T_mm.tolist(),
        "sigma_mm": np.sqrt(np.diag(reading.cov_mm2)).tolist(),
        "t_s": reading.t_s,
        "face": reading.face,
    }
