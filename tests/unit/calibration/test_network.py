"""Several stations adjusted together: exact without noise, honest with it, better than one, and not fooled."""

from __future__ import annotations

import numpy as np
import pytest

from docking.calibration import Network, View, adjust_network, locate_station
from docking.errors import AmbiguousSet, NotCongruent, SigmaMissing, TooFewPoints
from docking.geometry import euler_to_matrix
from docking.pose import LASER_TRACKER
from docking.pose.uncertainty import pose_difference
from docking.types import Array, Points, Pose

STATIONS = (
    Pose(euler_to_matrix(0.01, -0.02, 2.1), np.array([500.0, -9000.0, 800.0])),
    Pose(euler_to_matrix(-0.02, 0.01, -1.0), np.array([-800.0, 8000.0, 1500.0])),
    Pose(euler_to_matrix(0.00, 0.03, 0.4), np.array([-9500.0, 500.0, 2500.0])),
)
SPOTS = np.array(
    [
        [-6000, -5000, 0], [6000, -5000, 300], [7000, 4000, 0], [-7000, 4000, 900], [0, 6000, 1500], [0, -6500, 2500],
        [-4000, 0, 2000], [4000, 300, 2200], [0, 0, 100], [2000, -1500, 1000], [-2500, 1800, 500], [1200, 2500, 2600],
    ],
    dtype=float,
)  # fmt: skip
NAMES = tuple(f"P{i + 1:02d}" for i in range(12))
ERS_SIGMA = 0.01


def noisy(xyz: Array, cov: Array, rng: np.random.Generator | None) -> Array:
    return xyz if rng is None else xyz + np.einsum("nij,nj->ni", np.linalg.cholesky(cov), rng.normal(size=xyz.shape))


def view(k: int, rows: list[int], rng: np.random.Generator | None) -> View:
    at_T = STATIONS[k].inverse().apply(SPOTS[rows])
    cov = LASER_TRACKER.covariance(at_T)
    return View("ABC"[k], Points(tuple(NAMES[i] for i in rows), noisy(at_T, cov, rng), cov))


def references(rng: np.random.Generator | None, count: int = 6) -> Points:
    cov = np.tile(ERS_SIGMA**2 * np.eye(3), (count, 1, 1))
    return Points(NAMES[:count], noisy(SPOTS[:count], cov, rng), cov)


def spoiled(one: View, name: str, by: list[float]) -> View:
    xyz = one.readings.xyz_mm.copy()
    xyz[one.readings.names.index(name)] += by
    return View(one.name, Points(one.readings.names, xyz, one.readings.cov_mm2))


ALL = list(range(12))
CHAIN = ([0, 1, 2, 3, 4, 5, 6, 7], [4, 5, 6, 7, 8, 9, 10], [6, 8, 9, 10, 11])
"""The third station sees none of the references: only the second ties it."""


@pytest.mark.parametrize("with_ers", [True, False])
@pytest.mark.parametrize("rows", [(ALL, ALL, ALL), CHAIN])
def test_without_noise_everything_is_found_again(rows: tuple[list[int], ...], with_ers: bool) -> None:
    views = tuple(view(k, seen, None) for k, seen in enumerate(rows))
    found = adjust_network(views, references(None) if with_ers else None)
    X = Pose.identity() if with_ers else STATIONS[0].inverse()
    assert found.stations == ("A", "B", "C")
    for pose, true in zip(found.poses, STATIONS, strict=True):
        spots = true.inverse().apply(SPOTS)
        assert np.max(np.abs(pose.apply(spots) - X.apply(SPOTS))) <= 1e-9
    at = [NAMES.index(name) for name in found.points.names]
    assert sorted(at) == ALL
    assert np.max(np.abs(found.points.xyz_mm - X.apply(SPOTS[at]))) <= 1e-9
    assert found.rejected == ()
    assert found.consistent
    held = [np.all(found.cov[6 * k : 6 * k + 6] == 0.0) for k in range(3)]
    assert held == [not with_ers, False, False]


def test_one_station_is_what_the_station_fit_finds() -> None:
    rng = np.random.default_rng(4)
    ers, one = references(rng), view(0, ALL, rng)
    fit, found = locate_station(ers, one.readings), adjust_network((one,), ers)
    assert np.allclose(found.poses[0].R, fit.X_MN.R, atol=1e-13)
    assert np.max(np.abs(found.poses[0].t_mm - fit.X_MN.t_mm)) <= 1e-7
    assert found.chi2 == pytest.approx(fit.chi2, rel=1e-9)
    assert found.dof == fit.dof
    move = np.eye(6)
    arm = fit.pivot_mm - found.pivots_mm[0]
    move[3:, :3] = -np.array([[0, -arm[2], arm[1]], [arm[2], 0, -arm[0]], [-arm[1], arm[0], 0]])
    sigma = np.sqrt(np.diag(fit.cov))
    assert np.allclose(move @ found.cov @ move.T / np.outer(sigma, sigma), fit.cov / np.outer(sigma, sigma), atol=1e-3)


def error_of(found: Network) -> Array:
    parts = [pose_difference(X, t, p) for X, t, p in zip(found.poses, STATIONS, found.pivots_mm, strict=True)]
    return np.concatenate(parts)


def test_the_joint_covariance_is_honest() -> None:
    """Normalised error squared of all three poses together is chi-square with 18, of every point with 3 degrees."""
    rng, draws = np.random.default_rng(6), 120
    nees, points, chi2 = [], [], []
    for _ in range(draws):
        found = adjust_network(tuple(view(k, rows, rng) for k, rows in enumerate(CHAIN)), references(rng))
        e = error_of(found)
        nees.append(float(e @ np.linalg.solve(found.cov, e)))
        off = found.points.xyz_mm - SPOTS[[NAMES.index(n) for n in found.points.names]]
        points.append(np.einsum("ni,ni->n", off, np.linalg.solve(found.points.cov_mm2, off[:, :, None])[:, :, 0]))
        chi2.append(found.chi2)
    assert np.mean(nees) == pytest.approx(18.0, abs=4.5 * np.sqrt(36.0 / draws))
    # The points of one draw share their stations: their mean scatters more than that of independent ones.
    assert np.mean(points) == pytest.approx(3.0, abs=4.5 * np.sqrt(6.0 / draws))
    assert np.mean(chi2) == pytest.approx(found.dof, abs=4.5 * np.sqrt(2.0 * found.dof / draws))


def test_two_stations_see_points_better_than_one() -> None:
    rng = np.random.default_rng(7)
    off: dict[int, list[Array]] = {1: [], 2: [], 11: [], 12: []}
    inner = [6, 7, 8, 9, 10, 11]
    for _ in range(40):
        ers, views = references(rng), tuple(view(k, ALL, rng) for k in range(2))
        for count in (1, 2):
            found = adjust_network(views[:count], ers)
            at = [found.points.names.index(NAMES[i]) for i in inner]
            off[count].append(found.points.xyz_mm[at] - SPOTS[inner])
            sigma = np.sqrt(np.trace(found.points.cov_mm2[at], axis1=1, axis2=2))
            off[10 + count].append(sigma)
    rms = {count: float(np.sqrt(np.mean(np.sum(np.square(off[count]), axis=2)))) for count in (1, 2)}
    assert rms[2] < 0.7 * rms[1]
    for count in (1, 2):
        assert rms[count] == pytest.approx(float(np.sqrt(np.mean(np.square(off[10 + count])))), rel=0.15)


@pytest.mark.parametrize("size", [0.4, 3.0, 900.0])
def test_one_bad_observation_a_station_is_found_and_named(size: float) -> None:
    rng = np.random.default_rng(9)
    views = [view(k, ALL, rng) for k in range(3)]
    clean = adjust_network(tuple(views), references(np.random.default_rng(1)))
    bad = {"A": ("P07", [size, 0, 0]), "B": ("P09", [0, -size, 0]), "C": ("P12", [0, 0, size])}
    views = [spoiled(one, *bad[one.name]) for one in views]
    found = adjust_network(tuple(views), references(np.random.default_rng(1)))
    assert {r.name for r in found.rejected} == {"A: P07", "B: P09", "C: P12"}
    assert {r.reason for r in found.rejected} == {"mis-aimed"}
    assert found.consistent
    for one, other in zip(found.poses, clean.poses, strict=True):
        assert np.max(np.abs(one.apply(SPOTS) - other.apply(SPOTS))) < 0.03
    assert found.views[found.points.names.index("P12")] == 2


def mixed_up(one: View, order: dict[str, str]) -> View:
    """The view with its labels changed: what stands at a key is called as the value says."""
    names = tuple(order.get(name, name) for name in one.readings.names)
    return View(one.name, Points(names, one.readings.xyz_mm, one.readings.cov_mm2))


TWO_PAIRS = {"P01": "P02", "P02": "P01", "P08": "P11", "P11": "P08"}


@pytest.mark.parametrize("which", [0, 1, 2])
def test_swapped_labels_of_one_station_are_named(which: int) -> None:
    rng = np.random.default_rng(15)
    views = [view(k, ALL, rng) for k in range(3)]
    views[which] = mixed_up(views[which], TWO_PAIRS)
    found = adjust_network(tuple(views), None)
    told = {(r.name, r.reason, r.partner) for r in found.rejected}
    assert told == {(f"{'ABC'[which]}: {name}", "swapped", TWO_PAIRS[name]) for name in TWO_PAIRS}
    assert found.consistent


def test_labels_swapped_in_one_of_two_views_are_told_though_not_whose() -> None:
    rng = np.random.default_rng(16)
    views = view(0, ALL, rng), mixed_up(view(1, ALL, rng), {"P03": "P07", "P07": "P03"})
    found = adjust_network(views, None)
    assert {r.name for r in found.rejected} == {f"{k}: {name}" for k in "AB" for name in ("P03", "P07")}
    for r in found.rejected:
        other = "P07" if r.name.endswith("P03") else "P03"
        assert (r.reason, r.detail.partition("(")[2]) == ("undecided", f"swapped with {other})")


def test_a_reading_in_another_unit_is_named() -> None:
    rng = np.random.default_rng(17)
    views = [view(k, ALL, rng) for k in range(3)]
    xyz = views[2].readings.xyz_mm.copy()
    xyz[5] /= 25.4
    views[2] = View("C", Points(NAMES, xyz, views[2].readings.cov_mm2))
    (r,) = adjust_network(tuple(views), None).rejected
    assert (r.name, r.reason) == ("C: P06", "unit-mix-up")


def test_a_reference_that_has_moved_is_found() -> None:
    rng = np.random.default_rng(10)
    ers = references(rng)
    xyz = ers.xyz_mm.copy()
    xyz[2] += [0.0, 0.6, 0.0]
    views = tuple(view(k, ALL, rng) for k in range(3))
    found = adjust_network(views, Points(ers.names, xyz, ers.cov_mm2))
    assert [r.name for r in found.rejected] == ["ERS: P03"]
    assert np.linalg.norm(found.points.xyz_mm[found.points.names.index("P03")] - SPOTS[2]) < 0.1


def test_where_two_views_disagree_nobody_says_which_is_wrong() -> None:
    rng = np.random.default_rng(11)
    views = (view(0, ALL, rng), spoiled(view(1, ALL, rng), "P09", [0.0, 0.0, 2.0]))
    found = adjust_network(views, references(rng))
    assert sorted(r.name for r in found.rejected) == ["A: P09", "B: P09"]
    assert {r.reason for r in found.rejected} == {"undecided"}
    assert "P09" not in found.points.names


def test_clean_networks_lose_no_point() -> None:
    rng = np.random.default_rng(12)
    lost = sum(
        bool(adjust_network(tuple(view(k, ALL, rng) for k in range(2)), references(rng)).rejected) for _ in range(60)
    )
    assert lost <= 4


def test_passes_are_averaged_and_a_lost_beam_is_named() -> None:
    rng = np.random.default_rng(13)
    one, again = view(0, ALL, rng).readings, view(0, ALL, rng).readings
    xyz = np.vstack([one.xyz_mm, again.xyz_mm])
    xyz[[3, 15]] = 0.0
    both = Points(one.names * 2, xyz, np.concatenate([one.cov_mm2] * 2), (1,) * 12 + (2,) * 12)
    found = adjust_network((View("A", both), view(1, ALL, rng)), references(rng))
    assert [(r.name, r.reason) for r in found.rejected] == [("A: P04", "lost-beam")]
    assert found.views[found.points.names.index("P04")] == 2


def test_a_network_that_cannot_be_tied_or_trusted_refuses() -> None:
    rng = np.random.default_rng(14)
    with pytest.raises(TooFewPoints) as caught:
        adjust_network((view(0, [0, 1, 2, 3, 4], rng), view(1, [3, 4, 6, 7, 8, 9], rng)), None)
    assert (caught.value.where, caught.value.value) == ("B", 2)
    one = view(1, ALL, rng)
    unknown = View("B", Points(one.readings.names, one.readings.xyz_mm, np.full((12, 3, 3), np.nan)))
    with pytest.raises(SigmaMissing, match="B: P01"):
        adjust_network((view(0, ALL, rng), unknown), None)
    other = View("B", Points(NAMES, rng.uniform(-5000, 5000, (12, 3)), one.readings.cov_mm2))
    with pytest.raises((NotCongruent, AmbiguousSet)):
        adjust_network((view(0, ALL, rng), other), None)
    with pytest.raises(TooFewPoints):
        adjust_network((), None)


def test_too_small_sigmas_make_the_network_inconsistent() -> None:
    """Noise twice as large as stated, spread over all: no single observation is to blame, and chi2 tells."""
    rng = np.random.default_rng(15)
    views = []
    for k in range(2):
        at_T = STATIONS[k].inverse().apply(SPOTS)
        cov = LASER_TRACKER.covariance(at_T)
        views.append(View("AB"[k], Points(NAMES, noisy(at_T, 2.2 * cov, rng), cov)))
    found = adjust_network(tuple(views), references(rng))
    assert not found.consistent
