"""How many wrong points the screening survives: the study's bars on reduced sets; all of them with --full."""

import numpy as np
import pytest

from docking.errors import PoseError
from docking.pose import FitSettings, fit_pose, screen
from docking.study.screening import CASES, NOISES, Case, draw, run_case
from docking.types import Points, Pose

WRONG = [case for case in CASES if case.wrong]


@pytest.mark.parametrize("case", WRONG, ids=lambda case: case.name)
def test_wrong_points_are_found_and_no_other(case: Case) -> None:
    """With a true share of 97 % twenty-six or more of thirty succeed but once in two hundred studies."""
    row = run_case(case, "isotropic" if case.n < 15 else "tracker", 30, seed=2)
    assert row["verdicts"].get("success", 0) >= 26, row["verdicts"]


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("case", [Case("swapped", 10, 7), Case("swapped", 7, 4), Case("slid", 10, 4)], ids=str)
def test_few_good_points_name_the_wrong_ones_too(case: Case, noise: str) -> None:
    """Three good points put a far place half a millimetre off: that is no reason to call a swapped point mis-aimed."""
    verdicts = run_case(case, noise, 40, seed=3)["verdicts"]
    assert verdicts.get("misnamed", 0) <= 1, verdicts
    assert verdicts["success"] >= 36, verdicts


def test_sigmas_stated_too_small_leave_no_minority_to_believe() -> None:
    """Of ten clean points whose sigmas are a fifth of the truth a few agree by chance: that is no pose."""
    rng, believed, causes = np.random.default_rng(4), 0, list[str]()
    for _ in range(40):
        w = draw(rng, Case("clean", 10, 0), "isotropic")
        measured = Points(w.measured.names, w.measured.xyz_mm, w.measured.cov_mm2 / 25.0)
        try:
            believed += len(screen(w.nominal, measured, FitSettings()).names) <= 5
        except PoseError as error:
            causes.append(error.text())
    assert believed <= 2
    assert sum("by chance" in cause and "sigmas too small" in cause for cause in causes) >= 6


@pytest.mark.full
@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_bars_in_full(case: Case, noise: str) -> None:
    row = run_case(case, noise, 1000 if case.wrong else 5000)
    assert row["held"], row


def test_clean_sets_are_rejected_at_the_level_of_the_test() -> None:
    row = run_case(Case("clean", 15, 0, 0.99), "isotropic", 300, seed=2)
    assert row["verdicts"]["success"] >= 290, row["verdicts"]


def outcome(nominal: Points, measured: Points) -> tuple[set[tuple[str, str, str]], set[str]]:
    s = screen(nominal, measured, FitSettings())
    return {(r.name, r.reason, r.partner) for r in s.rejected}, set(s.names)


def moved(points: Points, X: Pose, scale: float = 1.0) -> Points:
    turn = scale * X.R
    return Points(points.names, scale * X.apply(points.xyz_mm), turn @ points.cov_mm2 @ turn.T)


@pytest.mark.parametrize("kind", ["mis-aimed", "swapped", "slid"])
def test_frames_order_and_unit_of_length_do_not_matter(kind: str) -> None:
    rng = np.random.default_rng(5)
    for _ in range(8):
        w = draw(rng, Case(kind, 10, 3), "tracker")
        A, B = (draw(rng, Case("clean", 7, 0), "isotropic").X_WC for _ in range(2))
        here = outcome(w.nominal, w.measured)
        assert outcome(moved(w.nominal, A), moved(w.measured, B)) == here
        assert outcome(moved(w.nominal, A, 1e-3), moved(w.measured, B, 1e-3)) == here
        order = rng.permutation(10)
        a = Points(tuple(w.nominal.names[i] for i in order), w.nominal.xyz_mm[order], w.nominal.cov_mm2[order])
        assert outcome(a, w.measured) == here


def test_the_fit_follows_the_unit_of_length() -> None:
    rng = np.random.default_rng(6)
    w = draw(rng, Case("clean", 10, 0), "tracker")
    mm, m = (
        fit_pose(screen(moved(w.nominal, Pose.identity(), k), moved(w.measured, Pose.identity(), k)))
        for k in (1.0, 1e-3)
    )
    assert np.allclose(m.X_MN.R, mm.X_MN.R, atol=1e-12)
    assert np.allclose(1e3 * m.X_MN.t_mm, mm.X_MN.t_mm, atol=1e-6)
    assert m.chi2 == pytest.approx(mm.chi2, rel=1e-6)
    assert np.allclose(np.diag(m.cov)[:3], np.diag(mm.cov)[:3], rtol=1e-6)
