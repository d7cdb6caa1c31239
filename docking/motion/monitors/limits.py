"""The limits of the monitors, and how near clean runs have come to them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class WatchLimits:
    """Limits of the monitors (CELL file, `limits`): mm and N.

    The following error may grow with the speed up to its ceiling. `passive_mm` bounds how far an axis that follows the
    part stays behind, `adrift_mm` how far from its place it may come with time; one that holds a force has then lost
    its ball. `measured_*` bound what the load cells show beyond the expected reactions: the change since the move was
    loaded, and, wider because cells drift and cross-talk, the whole (`measured_whole_*`); `standing_force_n` bounds the
    change while the axes stand, from load to start and from hold to resume. `sync_error` bounds what path times apart
    may squeeze. `overload` and `underload` are fractions of the expected load of a ball; the rating of an axis may be
    exceeded by `rating`.
    """

    following_rest_mm: float
    following_vmax_mm: float
    ball_residual_mm: float
    internal_force_n: float
    warp_force_n: float
    missing_cycles: float
    stuck_mm: float = 0.02
    standstill_mm: float = 0.02
    passive_mm: float = 0.1
    adrift_mm: float = 0.5
    ball_rms_mm: float = 0.06
    ball_pair_mm: float = 0.15
    sync_error_mm: float = 0.05
    measured_force_n: float = 1500.0
    measured_warp_n: float = 600.0
    measured_whole_force_n: float = 2500.0
    measured_whole_warp_n: float = 1200.0
    standing_force_n: float = 300.0
    overload: float = 1.1
    underload: float = 0.5
    rating: float = 1.1


@dataclass(frozen=True)
class Timing:
    """Period of the read-backs, and following error of a healthy axis divided by its speed."""

    cycle_s: float = 0.01
    servo_lag_s: float = 0.002


class Margins:
    """The nearest that each monitor has come to its limit, as a fraction of it; 1 is a trip."""

    def __init__(self) -> None:
        self.peaks: dict[str, float] = {}

    def note(self, monitor: str, fraction: float) -> bool:
        """Keep the fraction if it is the largest so far; True when it is at most 1, which NaN is not."""
        if not (fraction <= self.peaks.get(monitor, -1.0)):
            self.peaks[monitor] = fraction
        return fraction <= 1.0
