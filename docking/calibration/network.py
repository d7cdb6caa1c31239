"""Several stations tied together: their poses in W with one joint covariance, and every point in W.

W is defined by ERS points, or, without them, is the frame of the first station. Points in common place the stations one
after another with the same fit and screening as a single station; then all are adjusted together, and data snooping
looks for single bad observations: one that three or more views of a point single out goes, and where only two views
disagree the point goes, since nobody can say which is wrong. What goes is named as in the fit of one station: swapped,
in a wrong nest, in another unit, moved with others, or mis-aimed.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from docking.calibration.adjustment import Adjusted, Observations, adjust
from docking.calibration.station import locate_station, to_world
from docking.errors import NotCongruent, SigmaMissing, TooFewPoints
from docking.pose.clique import adjacency, bits, largest_clique
from docking.pose.layout import MIN_POINTS
from docking.pose.passes import average_passes
from docking.pose.quantiles import chi2_tail, chi2_upper
from docking.pose.reasons import explain
from docking.pose.settings import FitSettings
from docking.pose.snooping import Pairs
from docking.types import Array, Points, Pose, Rejection

ERS = "ERS"
"""Name of the reference points among the views."""
GROSS_ALARM = 0.001
"""Probability at which the whole network counts as inconsistent."""
_PLACING_ALARM = 1e-6
"""A station is placed with what is not grossly off; what is nearly right is judged by all stations together."""
_TELLING = ("swapped", "wrong-nest", "unit-mix-up")
"""Reasons of a pair of views that say more than how far apart they are."""
_NO_EVIDENCE = 1e-6
"""A direction of a residual with less than this share of the observation's variance carries no evidence."""


@dataclass(frozen=True, eq=False)
class View:
    """What one station measured: points in its own frame, in one or more passes, with covariances."""

    name: str
    readings: Points


@dataclass(frozen=True, eq=False)
class Network:
    """Adjusted stations and points.

    `poses` X_WT by station; `cov` (6k, 6k) of all their [rotation_rad, translation_mm] about `pivots_mm` (k, 3)
    together, as in `Fit`; `points` in W with covariances; `views` how many used observations each point has;
    `residuals_mm` (m, 3) in W of the used observations `observed` (station, point). `rejected` are named
    STATION: POINT. `chi2_p` is the probability of so large a chi2 when the covariances are right.
    """

    stations: tuple[str, ...]
    poses: tuple[Pose, ...]
    cov: Array
    pivots_mm: Array
    points: Points
    views: tuple[int, ...]
    observed: tuple[tuple[str, str], ...]
    residuals_mm: Array
    rejected: tuple[Rejection, ...]
    chi2: float
    dof: int

    @property
    def chi2_p(self) -> float:
        return chi2_tail(self.chi2, self.dof)

    @property
    def consistent(self) -> bool:
        """True when chi2 is what the covariances let expect; NaN is not."""
        return self.chi2_p >= GROSS_ALARM


def adjust_network(views: tuple[View, ...], ers: Points | None = None, false_alarm: float = 0.01) -> Network:
    """Adjust the stations of `views` over their common points.

    `ers` reference points in W; without them W is the frame of the first station. Raises TooFewPoints (a station shares
    fewer than three points with the rest), DegenerateTargets, NotCongruent, AmbiguousSet, SigmaMissing.
    """
    book = _Book.of(views, ers)
    start, doubtful = _placed(book)
    return _Snooping(book, start, doubtful, false_alarm).run()


@dataclass
class _Book:
    """All observations as arrays; station 0 is the held one. `reference` is true when it is the ERS points."""

    stations: tuple[str, ...]
    points: tuple[str, ...]
    observations: Observations
    reference: bool
    rejected: list[Rejection] = field(default_factory=list)

    @classmethod
    def of(cls, views: tuple[View, ...], ers: Points | None) -> _Book:
        sources = views if ers is None else (View(ERS, ers), *views)
        rejected: list[Rejection] = []
        rows: list[tuple[int, str, Array, Array]] = []
        for k, view in enumerate(sources):
            seen = average_passes(view.readings, FitSettings(where=view.name))
            rejected += [replace(r, name=f"{view.name}: {r.name}") for r in seen.rejected]
            rows += [(k, *row) for row in zip(seen.names, seen.xyz_mm, seen.cov_mm2, strict=True)]
        points = tuple(dict.fromkeys(name for _, name, _, _ in rows))
        if not rows:
            raise TooFewPoints("network", value=0, limit=MIN_POINTS)
        cov = np.array([row[3] for row in rows])
        for (k, name, _, _), finite in zip(rows, np.all(np.isfinite(cov), axis=(1, 2)), strict=True):
            if not finite:
                raise SigmaMissing(f"{sources[k].name}: {name}", value="a reading")
        place = {name: j for j, name in enumerate(points)}
        observations = Observations(
            np.array([row[0] for row in rows], dtype=np.intp),
            np.array([place[row[1]] for row in rows], dtype=np.intp),
            np.array([row[2] for row in rows]),
            cov,
        )
        return cls(tuple(view.name for view in sources), points, observations, ers is not None, rejected)

    def seen_by(self, station: int) -> Points:
        """One station's points in its frame."""
        rows = np.flatnonzero(self.observations.station == station)
        names = tuple(self.points[j] for j in self.observations.point[rows])
        return Points(names, self.observations.xyz_mm[rows], self.observations.cov_mm2[rows])


def _placed(book: _Book) -> tuple[tuple[Pose, ...], dict[int, str]]:
    """Starting poses, best-tied station first, and the points about which some pair of views disagreed, with what that
    pair tells."""
    poses: dict[int, Pose] = {0: Pose.identity()}
    first = book.seen_by(0)
    known = dict(zip(first.names, zip(first.xyz_mm, first.cov_mm2, strict=True), strict=True))
    doubtful: dict[int, str] = {}
    while len(poses) < len(book.stations):
        left = [k for k in range(len(book.stations)) if k not in poses]
        common = {k: [n for n in book.seen_by(k).names if n in known] for k in left}
        k = max(left, key=lambda i: len(common[i]))
        if not (len(common[k]) >= MIN_POINTS):
            cause = "So few of its points are known from the references and the other stations."
            raise TooFewPoints(book.stations[k], cause, value=len(common[k]), limit=MIN_POINTS)
        base = Points(
            tuple(common[k]), np.array([known[n][0] for n in common[k]]), np.array([known[n][1] for n in common[k]])
        )
        view = book.seen_by(k)
        fit = locate_station(base, view, FitSettings(where=book.stations[k], false_alarm=_PLACING_ALARM))
        for r in fit.rejected:
            if r.name in known:
                told = f" ({r.detail})" if r.reason in _TELLING else ""
                doubtful.setdefault(book.points.index(r.name), told)
        poses[k] = fit.X_MN
        world = to_world(fit.X_MN, view)
        for name, xyz, cov in zip(world.names, world.xyz_mm, world.cov_mm2, strict=True):
            known.setdefault(name, (xyz, cov))
    return tuple(poses[k] for k in range(len(book.stations))), doubtful


class _Snooping:
    """Which observations stay: adjust, test, take the clearest case out, until all agree."""

    def __init__(self, book: _Book, start: tuple[Pose, ...], doubtful: dict[int, str], false_alarm: float) -> None:
        self._book, self._poses, self._false_alarm = book, start, false_alarm
        self._used: NDArray[np.bool_] = np.ones(len(book.observations.point), dtype=np.bool_)
        self._doubtful = doubtful
        self._wrong: list[int] = []
        """Rows whose point other views place elsewhere."""
        self._undecided: list[Rejection] = []
        self._unexplained: set[int] = set()
        """Points of which an observation is out, and nothing tells why: swapped labels are no sign of small sigmas."""

    def run(self) -> Network:
        if self._doubtful:
            self._used &= ~np.isin(self._book.observations.point, sorted(self._doubtful))
            self._settle_doubtful(self._adjusted())
        allowed = max(len(self._book.stations), len(self._used) // 10)
        while len(self._unexplained) <= allowed:
            adjusted = self._adjusted()
            worst = self._worst(adjusted)
            if worst is None:
                return self._network(adjusted)
            self._put_out(worst, adjusted)
        count, gone = len(self._book.points), len(self._unexplained)
        names = ", ".join(self._book.points[j] for j in sorted(self._unexplained)[:8])
        cause = "observation after observation would have to go until the rest fits: sigmas too small, or moved targets"
        raise NotCongruent("network", f"{cause}; first {names}", value=count - gone, limit=count - allowed)

    def _adjusted(self) -> Adjusted:
        adjusted = adjust(self._book.observations.rows(self._used), self._poses, held=0)
        self._poses = adjusted.poses
        return adjusted

    def _settle_doubtful(self, clean: Adjusted) -> None:
        """Let the other points' poses judge: of each doubtful point the largest agreeing majority of views returns."""
        observations = self._book.observations
        quantile = chi2_upper(self._false_alarm / len(self._used), 3)
        for j in sorted(self._doubtful):
            rows = np.flatnonzero(observations.point == j)
            places = np.array([clean.poses[observations.station[i]].apply(observations.xyz_mm[i]) for i in rows])
            R = np.array([clean.poses[observations.station[i]].R for i in rows])
            cov = R @ observations.cov_mm2[rows] @ np.swapaxes(R, 1, 2)
            # The share of the poses, which the points in common keep small, is covered by a doubled variance.
            both = 2.0 * (cov[:, None] + cov[None, :])
            gap = places[:, None] - places[None, :]
            agree = np.einsum("ijk,ijk->ij", gap, np.linalg.solve(both, gap[..., None])[..., 0]) <= quantile
            most = bits(largest_clique(adjacency(agree)))
            keep = most if 2 * len(most) > len(rows) else []
            self._used[rows[keep]] = True
            self._put_aside(rows[[i for i in range(len(rows)) if i not in keep]], bool(keep), places)

    def _worst(self, adjusted: Adjusted) -> int | None:
        """Row (among the used) with the largest statistic over its threshold, None when all agree."""
        r, v, s = adjusted.residuals_mm, adjusted.residual_cov_mm2, adjusted.observed_cov_mm2
        values, vectors = np.linalg.eigh(v)
        least = _NO_EVIDENCE * np.trace(s, axis1=1, axis2=2)[:, None]
        part = np.einsum("mij,mi->mj", vectors, r)
        statistic = np.sum(np.where(values > least, part**2 / np.maximum(values, least), 0.0), axis=1)
        worst = int(np.argmax(statistic))
        return worst if statistic[worst] > chi2_upper(self._false_alarm / len(statistic), 3) else None

    def _put_out(self, worst: int, adjusted: Adjusted) -> None:
        used = np.flatnonzero(self._used)
        point = self._book.observations.point
        views = np.flatnonzero(point[used] == point[used[worst]])
        decided = len(views) > 2
        self._put_aside(used[[worst]] if decided else used[views], decided, adjusted.residuals_mm[views])

    def _put_aside(self, rows: NDArray[np.intp], decided: bool, places_mm: Array) -> None:
        """Rows of one point that are not used: wrong, or among views (v, 3) of which none can be called wrong."""
        self._used[rows] = False
        self._unexplained |= {j for j in self._book.observations.point[rows].tolist() if not self._doubtful.get(j)}
        if decided:
            self._wrong += rows.tolist()
            return
        apart = float(np.max(np.linalg.norm(places_mm[:, None] - places_mm[None, :], axis=2)))
        detail = f"its {len(places_mm)} views are {apart:.3f} mm apart, and nothing tells which is wrong"
        for row in rows.tolist():
            told = self._doubtful.get(int(self._book.observations.point[row]), "")
            self._undecided.append(Rejection(self._name(row), "undecided", detail + told))

    def _name(self, row: int) -> str:
        observations = self._book.observations
        return f"{self._book.stations[observations.station[row]]}: {self._book.points[observations.point[row]]}"

    def _explained(self, adjusted: Adjusted) -> list[Rejection]:
        """What each wrong observation is: its whole view is laid upon the adjusted points."""
        observations, found = self._book.observations, list[Rejection]()
        known = np.all(np.isfinite(adjusted.points_mm), axis=1)
        for k in sorted({int(observations.station[row]) for row in self._wrong}):
            rows = np.flatnonzero((observations.station == k) & known[observations.point])
            point = observations.point[rows]
            covs = adjusted.points_cov_mm2[point], observations.cov_mm2[rows]
            names = tuple(self._book.points[j] for j in point)
            pairs = Pairs(names, adjusted.points_mm[point], observations.xyz_mm[rows], *covs)
            out = [i for i, row in enumerate(rows) if row in self._wrong]
            why = explain(pairs, adjusted.poses[k].inverse(), out).rejected
            found += [replace(r, name=f"{self._book.stations[k]}: {r.name}") for r in why]
        lost = [row for row in self._wrong if not known[observations.point[row]]]
        return found + [Rejection(self._name(row), "undecided", "its other views disagree too") for row in lost]

    def _network(self, adjusted: Adjusted) -> Network:
        book = self._book
        kept = book.observations.rows(self._used)
        skip = 1 if book.reference else 0
        known = np.flatnonzero(np.all(np.isfinite(adjusted.points_mm), axis=1))
        points = Points(tuple(book.points[j] for j in known), adjusted.points_mm[known], adjusted.points_cov_mm2[known])
        unknowns = 6 * (len(book.stations) - 1) + 3 * len(known)
        return Network(
            stations=book.stations[skip:],
            poses=adjusted.poses[skip:],
            cov=adjusted.cov[6 * skip :, 6 * skip :],
            pivots_mm=adjusted.pivots_mm[skip:],
            points=points,
            views=tuple(int(np.sum(kept.point == j)) for j in known),
            observed=tuple((book.stations[k], book.points[j]) for k, j in zip(kept.station, kept.point, strict=True)),
            residuals_mm=adjusted.residuals_mm,
            rejected=(*book.rejected, *self._explained(adjusted), *self._undecided),
            chi2=adjusted.chi2(),
            dof=3 * len(kept.point) - unknowns,
        )
