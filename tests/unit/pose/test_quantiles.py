"""The quantiles are those of scipy.stats."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from docking.pose.quantiles import chi2_upper, fisher_upper, normal_tail, normal_upper


@pytest.mark.parametrize("probability", [0.3, 0.0027, 1e-3 / 198, 1e-9])
def test_upper_quantiles_are_those_of_the_distributions(probability: float) -> None:
    dof = np.array([3.0, 15.0, 588.0])
    assert normal_upper(probability) == pytest.approx(stats.norm.isf(probability), rel=1e-12)
    assert chi2_upper(probability, 3) == pytest.approx(stats.chi2.isf(probability, 3), rel=1e-12)
    assert fisher_upper(probability, 3, dof) == pytest.approx(stats.f.isf(probability, 3, dof), rel=1e-12)


def test_three_sigmas_leave_0_27_percent_on_both_sides() -> None:
    assert 2.0 * normal_tail(3.0) == pytest.approx(0.0026998, abs=1e-7)
    assert normal_upper(normal_tail(2.5)) == pytest.approx(2.5)
