"""Upper tails of the distributions that the tests of points compare with.

SciPy's special functions give them directly; importing `scipy.stats` would take longer than most fits.
"""

from __future__ import annotations

from scipy import special

from docking.types import Array


def normal_tail(sigmas: float) -> float:
    """Probability that a standard normal value lies above `sigmas`."""
    return float(special.ndtr(-sigmas))


def normal_upper(probability: float) -> float:
    """Sigmas that a standard normal value exceeds with this probability."""
    return -float(special.ndtri(probability))


def chi2_upper(probability: float, dof: int) -> float:
    """Value that chi-square with `dof` degrees of freedom exceeds with this probability."""
    return float(special.chdtri(dof, probability))


def fisher_upper(probability: float, dof: int, dof_below: Array) -> Array:
    """Values that F with `dof` over `dof_below` (n,) degrees of freedom exceeds with this probability (n,)."""
    result: Array = special.fdtri(dof, dof_below, 1.0 - probability)
    return result


def fisher_tail(value: float, dof: int, dof_below: int) -> float:
    """Probability that F with `dof` over `dof_below` degrees of freedom exceeds `value`."""
    return float(special.fdtrc(dof, dof_below, value))


def chi2_tail(value: float, dof: int) -> float:
    """Probability that chi-square with `dof` degrees of freedom exceeds `value`; 1 without degrees of freedom."""
    return float(special.chdtrc(dof, value)) if dof > 0 else 1.0
