"""The scalar law s(t): docs/mechanics.md (33), (34)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from docking.planning.time_law import TimeLaw, quintic, s_curve


def peaks(law: TimeLaw) -> np.ndarray:
    result: np.ndarray = np.abs(law.samples(4000)).max(axis=1)
    return result


def test_quintic_peaks_are_those_of_its_derivatives() -> None:
    """s' 15/8, s'' 10/sqrt(3) = 5.7735, s''' 60, all at T = 1; and scaled by powers of T."""
    assert peaks(quintic())[1:] == pytest.approx([1.875, 5.7735, 60.0], rel=1e-5)
    assert peaks(quintic(2.0))[1:] == pytest.approx([1.875 / 2, 5.7735 / 4, 60.0 / 8], rel=1e-5)


def test_seven_segments_take_the_time_of_the_formula() -> None:
    """100 mm at 5 mm/s, 10 mm/s^2, 50 mm/s^3: D/V + V/A + A/J = 20.7 s, against 37.5 s of the quintic."""
    law = s_curve(5 / 100, 10 / 100, 50 / 100)
    assert law.duration_s == pytest.approx(20.7)
    assert peaks(law)[1:] * 100 == pytest.approx([5.0, 10.0, 50.0], rel=1e-9)
    assert pytest.approx(37.5) == 1.875 * 100 / 5


@given(v=st.floats(1e-4, 1e3), a=st.floats(1e-4, 1e3), j=st.floats(1e-4, 1e3))
def test_seven_segments_go_from_rest_to_rest_inside_their_limits(v: float, a: float, j: float) -> None:
    law = s_curve(v, a, j)
    s, ds, dds, ddds = law.samples(700)
    assert (s[0], ds[0], dds[0]) == (0.0, 0.0, 0.0)
    assert s[-1] == pytest.approx(1.0, abs=1e-12)
    assert ds[-1] / ds.max() == pytest.approx(0.0, abs=1e-9)
    rounding = 4.0 * np.finfo(float).eps * law.duration_s * j / a  # of the end time, against one ramp of the jerk
    assert dds[-1] / np.abs(dds).max() == pytest.approx(0.0, abs=max(1e-6, rounding))
    assert ds.min() >= -1e-9 * ds.max()
    assert ds.max() <= v * (1 + 1e-6)
    assert np.abs(dds).max() <= a * (1 + 1e-6)
    assert np.abs(ddds).max() <= j * (1 + 1e-6)
    assert law.duration_s >= max(1 / v, (6 * 1 / j) ** (1 / 3))


@pytest.mark.parametrize("law", [quintic(3.0), s_curve(0.5, 0.8, 2.0), s_curve(5.0, 0.8, 2.0), s_curve(5.0, 80.0, 2.0)])
def test_values_and_derivatives_belong_together(law: TimeLaw) -> None:
    t = np.linspace(0.0, law.duration_s, 20001)
    s = law.at(t)
    speed = np.gradient(s, t)
    assert speed.max() == pytest.approx(peaks(law)[1], rel=1e-4)
    assert np.abs(np.gradient(speed, t)).max() == pytest.approx(peaks(law)[2], rel=2e-3)
    assert np.all(np.diff(s) >= -1e-15)


def test_a_law_holds_at_both_ends() -> None:
    law = s_curve(0.5, 0.8, 2.0)
    assert law.at(np.array([-1.0, 0.0, law.duration_s, law.duration_s + 5.0])).tolist() == [0.0, 0.0, 1.0, 1.0]
    np.testing.assert_allclose(law.at(law.duration_s * np.array([0.25, 0.75])).sum(), 1.0, atol=1e-12)
