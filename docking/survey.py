"""What the cell measures, in what order: station, mate, component, and the references before every fit.

All readings become points in W through the station fit. The station's own uncertainty moves component and mate alike
and cancels in their difference; what does not cancel is drift, and that is what the reference check bounds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from docking.calibration.station import ReferenceShift, locate_station, reference_shift, to_world
from docking.calibration.two_face import face_errors
from docking.errors import DeviceSilent, StationMoved, TargetLost, TwoFaceDisagrees
from docking.ports import Aside, Journal, Tracker, at_once
from docking.pose import FitSettings, fit_pose, screen
from docking.pose.passes import average_passes
from docking.records import fit_record, station_record
from docking.types import Array, Fit, Points, Pose, Reading


@dataclass(frozen=True)
class SurveySettings:
    """How often and how strictly: passes a point, reference points a check, sigmas a drift may reach."""

    passes: int
    drift_points: int
    two_face_limit_mm: float
    station_fit: FitSettings
    mate_fit: FitSettings
    component_fit: FitSettings
    drift_sigmas: float = 3.0
    attempts: int = 2


@dataclass(frozen=True)
class Nominals:
    """Nominal points: ERS in W, mate targets in M, component targets and check points in C, features in both."""

    ers: Points
    mate: Points
    targets: Points
    checks: Points
    features: Points
    mate_features: Points


@dataclass
class Survey:
    """The tracker's work in one docking. `X_WT` and `X_WM` hold the newest fits; fits are worked out `aside`."""

    tracker: Tracker
    journal: Journal
    nominals: Nominals
    settings: SurveySettings
    clock: Callable[[], float]
    aside: Aside = at_once
    X_WT: Fit | None = None
    X_WM: Fit | None = None
    checked_at_s: float = float("nan")
    located_at_s: float = float("nan")
    shift_sigma_mm: float = 0.0
    component: Points | None = None
    checks: Points | None = None
    features: tuple[Points, Points] | None = None
    features_confirmed: bool = False
    _references: dict[str, Points] = field(default_factory=dict)

    async def locate(self, X_WT_guess: Pose, X_WM_guess: Pose) -> None:
        """Measure all ERS points and fit the station, then all mate targets and fit the mate.

        Measuring moves nothing, so it is done again when the station moved meanwhile. Raises StationMoved when it
        does not come to rest, and as `docking.pose.screen`.
        """
        for left in reversed(range(self.settings.attempts + 1)):
            try:
                await self._locate_once(X_WT_guess, X_WM_guess)
                return
            except StationMoved as moved:
                self._note_moved(moved)
                if left == 0:
                    raise

    async def _locate_once(self, X_WT_guess: Pose, X_WM_guess: Pose) -> None:
        guess = self.X_WT.X_MN if self.X_WT is not None else X_WT_guess
        await self._check_faces(guess)
        ers = await self._shoot("ers", self.nominals.ers, guess, Pose.identity(), self.settings.passes)
        self.X_WT = await self.aside(lambda: locate_station(self.nominals.ers, ers, self.settings.station_fit))
        self.journal.write("station", station_record(self.X_WT))
        X_WM = self.X_WM.X_MN if self.X_WM is not None else X_WM_guess
        mate = await self._measure_W("mate", self.nominals.mate, X_WM, self.settings.passes)
        fit = self.settings.mate_fit
        self.X_WM = await self.aside(lambda: fit_pose(screen(self.nominals.mate, mate, fit), fit))
        self.journal.write("fit", fit_record(self.X_WM, "mate", "frame"))
        self._keep_references(ers, mate)
        self.checked_at_s = self.located_at_s = self.clock()
        self.shift_sigma_mm = 0.0

    async def measure_component(self, X_WC_guess: Pose, X_WM_guess: Pose, passes: int, *, more: bool = False) -> None:
        """Measure targets and check points in `passes` passes, then the references; again if the station moved.

        With `more` the passes join those measured before at the same place.
        """
        for left in reversed(range(self.settings.attempts + 1)):
            try:
                targets = await self._measure_W("component", self.nominals.targets, X_WC_guess, passes)
                checks = await self._measure_W("check", self.nominals.checks, X_WC_guess, passes)
                features = await self._measure_features(X_WC_guess, passes)
                targets = _joined(self.component, targets) if more and self.component else targets
                average_passes(targets, self.settings.component_fit)
                await self._check_references()
                self.checks = _joined(self.checks, checks) if more and self.checks else checks
                self.component = targets
                self._keep_features(features, more)
                return
            except StationMoved as moved:
                self._note_moved(moved)
                if left == 0:
                    raise
            more = False
            await self.locate(self._station(), X_WM_guess)

    async def see_references(self, X_WM_guess: Pose) -> None:
        """Look at the references alone; where station or mate have moved, locate both anew. Raises as `locate`, and
        TooFewPoints where too few references are seen."""
        try:
            await self._check_references()
        except StationMoved as moved:
            self._note_moved(moved)
            await self.locate(self._station(), X_WM_guess)

    async def _measure_features(self, X_WC_guess: Pose, passes: int) -> tuple[Points, Points]:
        """Features of the component and of the mate, twice as often as targets: once confirmed, never again."""
        X_WM = self.X_WM.X_MN if self.X_WM is not None else Pose.identity()
        often = 0 if self.features_confirmed else 2 * passes
        part = await self._measure_W("feature", self.nominals.features, X_WC_guess, often)
        return part, await self._measure_W("mate-feature", self.nominals.mate_features, X_WM, often)

    def _keep_features(self, features: tuple[Points, Points], more: bool) -> None:
        if self.features_confirmed:
            return
        if more and self.features is not None:
            features = _joined(self.features[0], features[0]), _joined(self.features[1], features[1])
        self.features = features

    def seen_features(self) -> tuple[tuple[Points, Points], tuple[Points, Points]]:
        """(nominal, measured in W) features of the component and of the mate, passes averaged."""
        nominals = self.nominals.features, self.nominals.mate_features
        fits = self.settings.component_fit, self.settings.mate_fit
        seen = self.features if self.features is not None else (_picked(nominals[0], []), _picked(nominals[1], []))
        averaged = [_averaged(points, fit) for points, fit in zip(seen, fits, strict=True)]
        part, mate = (
            (_picked(nominal, [nominal.names.index(n) for n in points.names]), points)
            for nominal, points in zip(nominals, averaged, strict=True)
        )
        return part, mate

    def _note_moved(self, moved: StationMoved) -> None:
        body = {"reference": moved.where, "shift_mm": moved.value, "limit_mm": moved.limit, "restationed": True}
        self.journal.write("drift", body)

    def _station(self) -> Pose:
        if self.X_WT is None:
            raise StationMoved("tracker", "the station is not located")
        return self.X_WT.X_MN

    async def _check_faces(self, X_WT: Pose) -> None:
        if not self.tracker.two_face:
            return None
        for name, p_W in zip(self.nominals.ers.names, self.nominals.ers.xyz_mm, strict=True):
            near = X_WT.inverse().apply(p_W)
            one, two = await self._one(name, near, 1), await self._one(name, near, 2)
            if one is not None and two is not None:
                return self._compare_faces(one, two)
        raise TargetLost(self.nominals.ers.names[0], "no reference point is seen in both faces")

    def _compare_faces(self, one: Reading, two: Reading) -> None:
        gap = float(np.linalg.norm(one.p_T_mm - two.p_T_mm))
        sigma = float(np.sqrt(np.trace(one.cov_mm2 + two.cov_mm2)))
        limit = max(self.settings.two_face_limit_mm, self.settings.drift_sigmas * sigma)
        found = face_errors(one.p_T_mm, two.p_T_mm, one.cov_mm2 + two.cov_mm2)
        words = found.words(self.settings.drift_sigmas)
        parts = {"collimation_urad": 1e6 * found.collimation_rad, "index_urad": 1e6 * found.index_rad}
        body = {"target": one.target, "difference_mm": gap, "limit_mm": limit, **parts, "range_mm": found.range_mm}
        self.journal.write("two_face", {**body, "words": words})
        if not (gap <= limit):
            raise TwoFaceDisagrees(one.target, words, value=gap, limit=limit)

    async def _measure_W(self, group: str, nominal: Points, X_WN: Pose, passes: int) -> Points:
        X_WT = self._station()
        return to_world(X_WT, await self._shoot(group, nominal, X_WT, X_WN, passes))

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

    async def _one(self, name: str, near_T_mm: Array, face: int = 1) -> Reading | None:
        """One reading; measuring moves nothing, so a silent instrument is asked a second time."""
        for attempt in range(self.settings.attempts):
            try:
                return await self.tracker.measure(name, near_T_mm, face)
            except TargetLost:
                continue
            except DeviceSilent:
                if attempt + 1 == self.settings.attempts:
                    raise
        return None

    def check_points(self) -> tuple[Points, Points]:
        """(nominal in C, measured in W) check points, passes averaged; those whose passes disagree are left out."""
        nominal = self.nominals.checks
        if self.checks is None or not len(self.checks):
            return _picked(nominal, []), Points((), np.zeros((0, 3)), np.zeros((0, 3, 3)))
        seen = _averaged(self.checks, self.settings.component_fit)
        return _picked(nominal, [nominal.names.index(n) for n in seen.names]), seen

    def drift_sigma_mm(self, rate_mm_per_s: float) -> float:
        """What may have drifted unseen: since the last check at the given rate, and before it what the check cannot
        tell from no shift, never more than the same rate allows."""
        since_check = rate_mm_per_s * max(0.0, self.clock() - self.checked_at_s)
        before = rate_mm_per_s * max(0.0, self.checked_at_s - self.located_at_s)
        return since_check + min(before, self.shift_sigma_mm)

    def leave_out(self, check_point: str) -> None:
        """Measure and judge this check point no more."""
        nominal = self.nominals.checks
        keep = [i for i, name in enumerate(nominal.names) if name != check_point]
        self.nominals = replace(self.nominals, checks=_picked(nominal, keep))
        if self.checks is not None:
            rows = [i for i, name in enumerate(self.checks.names) if name != check_point]
            passes = tuple(self.checks.passes[i] for i in rows)
            self.checks = replace(_picked(self.checks, rows), passes=passes)

    def _keep_references(self, ers: Points, mate: Points) -> None:
        """Where the references read when the station was located: their change is movement, whatever their nominal."""
        self._references = {
            "ers": _averaged(to_world(self._station(), ers), self.settings.station_fit),
            "mate": _averaged(mate, self.settings.mate_fit),
        }

    async def _check_references(self) -> None:
        """Re-measure some ERS points and mate targets; raises StationMoved for a shift that is more than noise.

        A shift has to show twice: one badly seated reflector is no reason to locate the station again.
        """
        mate = self.X_WM.X_MN if self.X_WM is not None else Pose.identity()
        for group, nominal, X_WN in (("ers", self.nominals.ers, Pose.identity()), ("mate", self.nominals.mate, mate)):
            for _ in range(2):
                shift = await self._shift(group, nominal, X_WN)
                if not shift.moved:
                    break
            if shift.moved:
                raise StationMoved(group, "seen against the references", value=shift.worst_mm, limit=shift.limit_mm)
            self.shift_sigma_mm = shift.common_sigma_mm
            body = {"shift_mm": shift.worst_mm, "limit_mm": shift.limit_mm, "restationed": False}
            self.journal.write("drift", {"reference": group, **body})
        self.checked_at_s = self.clock()

    async def _shift(self, group: str, nominal: Points, X_WN: Pose) -> ReferenceShift:
        known = self._references[group]
        rows = [i for i, name in enumerate(nominal.names) if name in known.names]
        count = min(self.settings.drift_points, len(rows))
        chosen = _picked(nominal, [rows[round(k)] for k in np.linspace(0, len(rows) - 1, count)])
        again = await self._shoot("drift", chosen, self._station(), X_WN, self.settings.passes)
        return reference_shift(self._station(), known, again, self.settings.drift_sigmas)


def _picked(points: Points, rows: list[int]) -> Points:
    return Points(tuple(points.names[i] for i in rows), points.xyz_mm[rows], points.cov_mm2[rows])


def _averaged(points: Points, settings: FitSettings) -> Points:
    averaged = average_passes(points, settings)
    xyz = np.array(averaged.xyz_mm).reshape(-1, 3)
    return Points(tuple(averaged.names), xyz, np.array(averaged.cov_mm2).reshape(-1, 3, 3))


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


def _row(reading: Reading, run: int) -> dict[str, object]:
    return {
        "target": reading.target,
        "pass": run,
        "p_T_mm": reading.p_T_mm.tolist(),
        "sigma_mm": np.sqrt(np.diag(reading.cov_mm2)).tolist(),
        "t_s": reading.t_s,
        "face": reading.face,
    }
