"""Screening of points before the fit ([Luo], made sharp): which points are what they claim to be?

Passes are compared and averaged; every pair's measured distance is compared with the nominal one, and the pairs inside
their tolerance are the edges of a graph; its largest set of mutually consistent points is kept; then data snooping on
the fit settles the borderline. The tolerance comes from the covariances; where none are given, from the data.
"""

from __future__ import annotations

from math import exp, lgamma, log
from typing import NamedTuple

import numpy as np

from docking.errors import AmbiguousSet, ComponentDeformed, NoRedundancy, NotCongruent, PoseError, TooFewPoints
from docking.pose.clique import adjacency, bits, largest_clique, maximal_cliques, rival_clique
from docking.pose.deformation import deformation
from docking.pose.layout import MIN_POINTS, check_layout, spread
from docking.pose.pairs import check_units, distances, estimated_sigma_mm, estimated_tolerance_mm, pair_tolerance_mm
from docking.pose.passes import Averaged, average_passes
from docking.pose.quantiles import chi2_tail
from docking.pose.reasons import Reasons, events, explain
from docking.pose.relabel import relabelled
from docking.pose.settings import FitSettings
from docking.pose.snooping import SMALLEST_SIGMA_MM, Pairs, Tested, all_agree, residuals_mm, snoop
from docking.pose.svd import fit_svd, mirrored_rms_mm
from docking.types import Array, Points, Rejection, Screened

_SHRINKS = 6
_RIVALS, _RIVALS_UP_TO = 40, 64
"""Sets that compete for the explanation, and the largest graph in which they are looked for."""
_PLAUSIBLE = 0.002
"""A rival whose chi-square is less probable than this is an accident of its few distances."""
_ACCIDENTS = 0.3
"""A minority is believed when fewer sets of its size than this are to be expected by chance."""


class _Graph(NamedTuple):
    """Consistency of pairs: bit masks, the largest clique's rows, tolerance (n, n), estimated sigma (None: given)."""

    adj: list[int]
    clique: list[int]
    tolerance_mm: Array
    sigma_mm: float | None


def screen(nominal: Points, measured: Points, settings: FitSettings | None = None) -> Screened:
    """Keep the points of `measured` (frame M, any number of passes) that are congruent with `nominal` (frame N).

    A covariance that is not known is NaN. Raises TooFewPoints, DegenerateTargets, UnitMixUp, NotCongruent,
    AmbiguousSet, StationMoved; the error's `rejected` holds what had been found out about single points by then.
    """
    settings = FitSettings() if settings is None else settings
    averaged = Averaged()
    excluded = [Rejection(name, "excluded", "left out as asked") for name in settings.excluded]
    try:
        nominal, measured = (_without(points, settings.excluded) for points in (nominal, measured))
        averaged = average_passes(measured, settings)
        averaged.rejected += [*_unmatched(nominal, measured), *excluded]
        pairs = _matched(nominal, averaged)
        return _screen_pairs(pairs, averaged, settings)
    except PoseError as error:
        error.rejected = (*error.rejected, *averaged.rejected)
        raise


def _without(points: Points, names: tuple[str, ...]) -> Points:
    """The rows of other names."""
    if not names:
        return points
    keep = [i for i, name in enumerate(points.names) if name not in names]
    passes = tuple(points.passes[i] for i in keep) if points.passes else ()
    return Points(tuple(points.names[i] for i in keep), points.xyz_mm[keep], points.cov_mm2[keep], passes)


def _unmatched(nominal: Points, measured: Points) -> list[Rejection]:
    """Names that only one of the two sides knows."""
    known, seen = set(nominal.names), dict.fromkeys(measured.names)
    missing = [Rejection(n, "unmatched", "not measured") for n in nominal.names if n not in seen]
    return missing + [Rejection(n, "unmatched", "no nominal point of this name") for n in seen if n not in known]


def _matched(nominal: Points, averaged: Averaged) -> Pairs:
    """Points with a nominal and a usable measured position, in the order of the nominal."""
    row = {name: i for i, name in enumerate(averaged.names)}
    names = tuple(name for name in dict.fromkeys(nominal.names) if name in row)
    j = [nominal.names.index(name) for name in names]
    i = [row[name] for name in names]
    known = set(nominal.names)
    averaged.rejected[:] = [r for r in averaged.rejected if r.name in known or r.reason in ("unmatched", "excluded")]
    xyz = np.array([averaged.xyz_mm[k] for k in i]).reshape(-1, 3)
    cov = np.array([averaged.cov_mm2[k] for k in i]).reshape(-1, 3, 3)
    return Pairs(names, nominal.xyz_mm[j].reshape(-1, 3), xyz, nominal.cov_mm2[j].reshape(-1, 3, 3), cov)


def _screen_pairs(pairs: Pairs, averaged: Averaged, settings: FitSettings) -> Screened:
    """Screen matched points; see `screen`."""
    if not (len(pairs.names) >= MIN_POINTS):
        cause = _named(averaged.rejected) or "no other point has a name that both sides know"
        raise TooFewPoints(settings.where, cause, value=len(pairs.names), limit=MIN_POINTS)
    check_layout(pairs.nominal_mm, settings)
    check_units(pairs.nominal_mm, pairs.measured_mm, settings)
    graph = _consistency(pairs, settings)
    try:
        return _screen_graph(pairs, graph, averaged, settings)
    except (NotCongruent, AmbiguousSet) as error:
        mixed_up = _mixed_up(pairs, graph, settings)
        if mixed_up is None:
            raise
        raise mixed_up from error


def _screen_graph(pairs: Pairs, graph: _Graph, averaged: Averaged, settings: FitSettings) -> Screened:
    """Screen points whose consistent pairs are known; see `screen`."""
    if not (len(graph.clique) >= min(settings.min_agreeing, MIN_POINTS)):
        raise _not_congruent(pairs, graph, settings)
    if len(graph.clique) < len(pairs.names):
        check_layout(pairs.nominal_mm[graph.clique], settings)
    _check_mirror(pairs.rows(graph.clique), graph, settings)
    scaled, given = graph.sigma_mm is not None, pairs
    pairs = given if graph.sigma_mm is None else _with_sigma(given, graph.sigma_mm)
    tested, rival = _best(pairs, graph, settings)
    if scaled:
        pairs = _with_sigma(given, _posterior_sigma_mm(pairs, tested))
    inside = set(tested.kept)
    out = [i for i in range(len(pairs.names)) if i not in inside]
    why = explain(pairs, tested.solution.X_MN, out, tested.solution)
    if not scaled or why.elsewhere:
        # Without stated sigmas the residuals set their own scale: nothing tells a deformed part from a coarse one.
        moved = events(pairs, tested.solution.X_MN, why.elsewhere, graph.tolerance_mm)
        _check_deformed(pairs, tested, (why, moved), settings)
    _check_unique(pairs, tested, rival, settings)
    _check_believable(graph, tested, why, settings)
    kept = pairs.rows(tested.kept)
    return Screened(
        kept.names,
        kept.nominal_mm,
        kept.nominal_cov_mm2,
        kept.measured_mm,
        kept.measured_cov_mm2,
        (*why.rejected, *averaged.rejected),
        tuple(averaged.dropped),
    )


# Which pairs agree -----------------------------------------------------------------------------------------------
def _consistency(pairs: Pairs, settings: FitSettings) -> _Graph:
    """Graph of consistent pairs and its largest clique, with the tolerance known or estimated."""
    difference = np.abs(distances(pairs.measured_mm) - distances(pairs.nominal_mm))
    if _all_known(pairs):
        tolerance = pair_tolerance_mm(
            pairs.nominal_mm, pairs.measured_mm, (pairs.nominal_cov_mm2, pairs.measured_cov_mm2), settings
        )
        adj = adjacency(difference <= tolerance)
        return _Graph(adj, bits(largest_clique(adj)), tolerance, None)
    return _estimated_graph(pairs, difference)


def _all_known(pairs: Pairs) -> bool:
    return bool(np.all(np.isfinite(pairs.nominal_cov_mm2)) and np.all(np.isfinite(pairs.measured_cov_mm2)))


def _estimated_graph(pairs: Pairs, difference: Array) -> _Graph:
    """Graph whose tolerance follows from the pairs themselves.

    The first scale sees all points, so bad ones widen it; it is estimated again inside the clique found with it until
    it no longer shrinks.
    """
    n = len(difference)
    inside, sigma = list(range(n)), np.inf
    graph = _Graph([], [], difference, None)
    for _ in range(_SHRINKS):
        found = estimated_sigma_mm(difference[np.ix_(inside, inside)], float(np.ptp(pairs.nominal_mm)))
        if not (found < 0.95 * sigma):
            break
        sigma = found
        tolerance = estimated_tolerance_mm(len(inside), sigma)
        adj = adjacency(difference <= tolerance)
        inside = bits(largest_clique(adj))
        graph = _Graph(adj, inside, np.full_like(difference, tolerance), sigma)
        if len(inside) < MIN_POINTS:
            break
    return graph


def _with_sigma(pairs: Pairs, sigma_mm: float) -> Pairs:
    """The pairs with an isotropic covariance where none was given, so that the total is sigma^2 a coordinate."""
    sides = [pairs.nominal_cov_mm2, pairs.measured_cov_mm2]
    unknown = [~np.all(np.isfinite(c), axis=(1, 2)) for c in sides]
    given = np.zeros(len(pairs.names))
    for cov, miss in zip(sides, unknown, strict=True):
        given += np.where(miss, 0.0, np.trace(np.nan_to_num(cov), axis1=1, axis2=2) / 3.0)
    missing = unknown[0].astype(int) + unknown[1].astype(int)
    share = np.maximum(sigma_mm**2 - given, SMALLEST_SIGMA_MM**2) / np.maximum(missing, 1)
    filled = [
        np.where(miss[:, None, None], share[:, None, None] * np.eye(3), cov)
        for cov, miss in zip(sides, unknown, strict=True)
    ]
    return Pairs(pairs.names, pairs.nominal_mm, pairs.measured_mm, filled[0], filled[1])


# Is the answer to be believed ------------------------------------------------------------------------------------
def _not_congruent(pairs: Pairs, graph: _Graph, settings: FitSettings) -> NotCongruent:
    agreeing = [(graph.adj[i]).bit_count() for i in range(len(pairs.names))]
    most = max(agreeing)
    accused = [i for i in range(len(pairs.names)) if agreeing[i] < most] or list(range(len(pairs.names)))
    names = ", ".join(pairs.names[i] for i in accused[:8])
    error = NotCongruent(
        settings.where,
        f"{names} disagree with the others by more than {np.median(graph.tolerance_mm):.3g} mm",
        value=len(graph.clique),
        limit=settings.min_agreeing,
    )
    others = len(pairs.names) - 1
    error.rejected = tuple(
        Rejection(pairs.names[i], "inconsistent", f"its distances agree with {agreeing[i]} of {others} points")
        for i in accused
    )
    return error


def _mixed_up(pairs: Pairs, graph: _Graph, settings: FitSettings) -> NotCongruent | None:
    """The refusal that names who was measured where, when the points fit under other labels; else None."""
    X = relabelled(pairs, float(np.median(graph.tolerance_mm)))
    if X is None:
        return None
    known = pairs if graph.sigma_mm is None else _with_sigma(pairs, graph.sigma_mm)
    why = explain(known, X, list(range(len(pairs.names))))
    named = tuple(r for r in why.rejected if r.partner)
    cause = f"the labels are mixed up: {len(named)} of {len(pairs.names)} points are where another should be"
    error = NotCongruent(settings.where, cause, value=len(graph.clique), limit=settings.min_agreeing)
    error.rejected = named
    return error


def _check_mirror(pairs: Pairs, graph: _Graph, settings: FitSettings) -> None:
    """Refuse a point set that is the nominal's mirror image: its distances all agree and only a reflection fits."""
    r = pairs.measured_mm - fit_svd(pairs.nominal_mm, pairs.measured_mm).apply(pairs.nominal_mm)
    proper = float(np.sqrt(np.mean(np.sum(r * r, axis=1))))
    limit = float(np.max(graph.tolerance_mm[np.ix_(graph.clique, graph.clique)]))
    if proper <= 3.0 * limit:
        return
    reflected = mirrored_rms_mm(pairs.nominal_mm, pairs.measured_mm)
    if 3.0 * reflected < proper:
        cause = (
            f"they are its mirror image (rms {proper:.3g} mm, reflected {reflected:.3g} mm): an axis has the wrong sign"
        )
        raise NotCongruent(settings.where, cause, value=0, limit=settings.min_agreeing)


def _best(pairs: Pairs, graph: _Graph, settings: FitSettings) -> tuple[Tested, list[int]]:
    """The consistent set that explains the points best, snooped, and the rows of a rival as good (none: empty).

    All cliques of the largest size and one below it compete; in a large graph the largest only. All points together
    compete too where each passes the test: the pairs alone never cost a clean set a point.
    """
    n, scaled = len(pairs.names), graph.sigma_mm is not None
    cliques = [graph.clique]
    if len(graph.clique) < n <= _RIVALS_UP_TO:
        least = max(len(graph.clique) - 1, MIN_POINTS)
        cliques += [c for c in map(bits, maximal_cliques(graph.adj, least, _RIVALS)) if c != graph.clique]
    found: dict[tuple[int, ...], Tested] = {}
    if len(graph.clique) < n and not scaled and (whole := all_agree(pairs, settings)) is not None:
        found[tuple(whole.kept)] = whole
    for clique in cliques:
        if clique is graph.clique or spread(pairs.nominal_mm[clique]).middle_mm > _least_middle_mm(pairs):
            tested = snoop(pairs, clique, settings, scaled)
            found.setdefault(tuple(tested.kept), tested)
    held = {kept: scaled or _holds(tested) for kept, tested in found.items()}
    best, *others = sorted(found.values(), key=lambda t: (not held[tuple(t.kept)], -len(t.kept), t.chi2))
    if n > _RIVALS_UP_TO:
        return best, bits(rival_clique(graph.adj, sum(1 << i for i in best.kept), len(graph.clique)))
    kept = set(best.kept)
    for t in others:
        if len(t.kept) >= len(kept) and len(kept & set(t.kept)) < MIN_POINTS and held[tuple(t.kept)]:
            return best, t.kept
    return best, []


def _check_unique(pairs: Pairs, tested: Tested, rival: list[int], settings: FitSettings) -> None:
    """Refuse when other points, with at most two of the kept ones, agree among themselves just as many."""
    if rival:
        first, second = sorted((tested.kept, rival))
        cause = " agree among themselves, and so do ".join(
            ", ".join(pairs.names[i] for i in rows[:8]) for rows in (first, second)
        )
        raise AmbiguousSet(settings.where, cause, value=len(rival))


def _holds(tested: Tested) -> bool:
    """Global test: the set's own residuals are no larger than its covariances say."""
    return chi2_tail(tested.chi2, 3 * len(tested.kept) - 6) >= _PLAUSIBLE


def _least_middle_mm(pairs: Pairs) -> float:
    """A set of points narrower than this across its longest direction has no say: it would turn freely about it."""
    return 0.02 * spread(pairs.nominal_mm).long_mm


def _check_deformed(
    pairs: Pairs, tested: Tested, told: tuple[Reasons, tuple[tuple[int, ...], ...]], settings: FitSettings
) -> None:
    """Refuse a part whose points follow a smooth shape. Swapped, misplaced or misread points have nothing to say."""
    why, moved = told
    found = deformation(pairs, tested, moved)
    if found is not None:
        error = ComponentDeformed(settings.where, found.shape, value=found.largest_mm, limit=found.noise_mm)
        error.rejected = why.rejected
        raise error


def _check_believable(graph: _Graph, tested: Tested, why: Reasons, settings: FitSettings) -> None:
    """Refuse a set that chance could bring together, a minority where that is asked, and points put out one by one."""
    kept, n = len(tested.kept), len(graph.adj)
    chance = _accidental(graph, tested.kept)
    unexplained = len(why.elsewhere)
    error = None
    if 2 * kept <= n and not (chance <= _ACCIDENTS):
        cause = f"so many agree by chance: {chance:.2g} such sets are to be expected; another part, or sigmas too small"
        error = NotCongruent(settings.where, cause, value=kept, limit=min(kept + 1, n))
    elif settings.majority and not (unexplained <= kept):
        cause = f"{unexplained} points are off without a pattern: another or a deformed part, or sigmas too small"
        error = NotCongruent(settings.where, cause, value=kept, limit=unexplained)
    elif not (tested.snooped <= max(1, len(graph.clique) // 4)):
        cause = f"{tested.snooped} points would have to go until the rest fits: deformed part, or sigmas too small"
        error = NotCongruent(settings.where, cause, value=kept, limit=kept + tested.snooped)
    elif not (kept >= settings.min_agreeing):
        error = NoRedundancy(settings.where, value=kept, limit=settings.min_agreeing)
    if error is not None:
        error.rejected = why.rejected
        raise error


def _accidental(graph: _Graph, kept: list[int]) -> float:
    """How many sets as large as the kept one would agree if pairs agreed at the rate of the pairs outside of it."""
    n, m = len(graph.adj), len(kept)
    inside = sum(1 << i for i in kept)
    pairs = (n * (n - 1) - m * (m - 1)) // 2
    if pairs == 0:
        return 0.0
    edges = sum(a.bit_count() for a in graph.adj) - sum((graph.adj[i] & inside).bit_count() for i in kept)
    rate = (0.5 * edges + 0.5) / (pairs + 1.0)
    ways = lgamma(n + 1) - lgamma(m + 1) - lgamma(n - m + 1)
    return exp(min(ways + 0.5 * m * (m - 1) * log(rate), 700.0))


def _posterior_sigma_mm(pairs: Pairs, tested: Tested) -> float:
    """sqrt(sum |r|^2 / (3 n - 6)) of the kept points."""
    r = residuals_mm(pairs.rows(tested.kept), tested.solution)
    return max(float(np.sqrt(np.sum(r * r) / max(3 * len(r) - 6, 1))), SMALLEST_SIGMA_MM)


def _named(rejected: list[Rejection]) -> str:
    """The first rejected points with their reasons, for the cause of an error."""
    return ", ".join(f"{r.name}: {r.reason}" for r in rejected[:8])
