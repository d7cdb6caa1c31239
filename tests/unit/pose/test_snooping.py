"""The statistics of data snooping follow the distributions that their thresholds are taken from."""

import numpy as np
import pytest
from scipy import special

from docking.geometry import euler_to_matrix
from docking.pose.quantiles import chi2_upper
from docking.pose.settings import FitSettings
from docking.pose.snooping import Pairs, _statistics, snoop, solve
from docking.types import Array

NAMES = tuple("ABCDEFG")
J = np.random.default_rng(6).uniform([-4000, -2000, -2000], [4000, 2000, 2000], (7, 3))
R = euler_to_matrix(0.4, -0.3, 1.2)


def drawn(rng: np.random.Generator, size: float = 1.0) -> Pairs:
    """Points with unlike covariances on both sides, and errors `size` times as large as these say."""
    nominal = np.array([np.diag([0.02, 0.05, 0.01 * (k + 1)]) ** 2 for k in range(7)])
    measured = np.array([np.diag([0.01 * (7 - k), 0.03, 0.06]) ** 2 for k in range(7)])
    off = [np.einsum("nij,nj->ni", np.sqrt(cov), rng.normal(size=(7, 3))) for cov in (nominal, measured)]
    return Pairs(NAMES, J + size * off[0], J @ R.T + size * off[1], nominal, measured)


@pytest.mark.parametrize("kept", [list(range(7)), [0, 1, 2, 4, 6]])
def test_each_points_statistic_has_three_degrees_of_freedom(kept: list[int]) -> None:
    """A kept point has a part in the pose that judges it, another has not: both make chi-square with mean 3."""
    rng, rows = np.random.default_rng(7), list[Array]()
    for _ in range(600):
        pairs = drawn(rng)
        rows.append(_statistics(pairs, solve(pairs.rows(kept), 0.0), kept))
    assert np.mean(rows, axis=0) == pytest.approx(np.full(7, 3.0), abs=4.5 * np.sqrt(6.0 / 600))
    beyond = np.mean(np.array(rows) > chi2_upper(0.05, 3), axis=0)
    assert beyond == pytest.approx(np.full(7, 0.05), abs=4.5 * np.sqrt(0.05 * 0.95 / 600))


@pytest.mark.parametrize("scaled", [False, True])
def test_single_points_go_as_often_as_the_level_says(scaled: bool) -> None:
    """With a level of 40 % for all points of a set together; where the scale is not known the errors may be larger."""
    settings, rng = FitSettings(false_alarm=0.5), np.random.default_rng(8)
    lost = [snoop(drawn(rng, 5.0 if scaled else 1.0), list(range(7)), settings, scaled).snooped for _ in range(300)]
    # Seven tests at 0.4 / 7 that hardly know of each other.
    expected = 1.0 - (1.0 - 0.4 / 7.0) ** 7
    assert np.mean(np.array(lost) > 0) == pytest.approx(expected, abs=4.0 * np.sqrt(0.22 / 300))


def test_an_error_is_found_as_often_as_its_size_says() -> None:
    """Noncentral chi-square, 3 degrees of freedom, with what of the error shows in the residual; level of one test."""
    rng, settings, kept = np.random.default_rng(9), FitSettings(), list(range(7))
    error, found = np.array([0.0, 0.18, 0.0]), []
    for _ in range(300):
        pairs = drawn(rng)
        measured = pairs.measured_mm.copy()
        measured[3] += error
        spoiled = pairs._replace(measured_mm=measured)
        found.append(3 not in snoop(spoiled, kept, settings, False).kept)
    exact = Pairs(NAMES, J, J @ R.T + np.eye(7)[3][:, None] * error, *drawn(rng)[3:])
    size = float(_statistics(exact, solve(exact, 0.0), kept)[3])
    power = 1.0 - float(special.chndtr(chi2_upper(0.008 / 7.0, 3), 3.0, size))
    assert 0.3 < power < 0.9
    assert np.mean(found) == pytest.approx(power, abs=4.0 * np.sqrt(power * (1.0 - power) / 300) + 0.02)
