"""The head of the simulated total station: where it points, what it has found, the last distance.

x is east, y north, z up. Hz turns clockwise from north, V is the zenith angle; in face 2 V is beyond pi.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from sim.tracker.optics import Optics, Shot

FULL_TURN = 2.0 * math.pi
FRESH_S = 2.0


@dataclass(frozen=True)
class Air:
    """Pressure (hPa) and dry and wet temperatures (C) that a distance is corrected for, or that there are."""

    pressure_hpa: float = 1013.25
    dry_c: float = 12.0
    wet_c: float = 8.7

    def ppm(self) -> float:
        """First velocity correction of an infrared distance meter whose reference index is 1.00028634."""
        warm = 1.0 + self.dry_c / 273.15
        saturated_hpa: float = 6.1078 * 10.0 ** (7.5 * self.wet_c / (237.3 + self.wet_c))
        vapour_hpa = saturated_hpa - 0.000662 * self.pressure_hpa * (self.dry_c - self.wet_c)
        return 286.34 - (0.29525 * self.pressure_hpa - 0.04126 * vapour_hpa) / warm


@dataclass
class Distance:
    """One distance in the making: `due_s` when it will be ready, what it found, when it was taken."""

    due_s: float = math.inf
    shot: Shot | None = None
    slope_m: float = 0.0
    taken_s: float = math.nan


@dataclass
class Head:
    """Aim, search and distance on the time of the caller. `prism_mm` and `air` are what the instrument corrects for;
    `true_prism_mm` and `true_air` (None: as corrected for) are what there is. `keeps_distance` never renews it."""

    optics: Optics
    hz: float = 0.0
    v: float = 0.5 * math.pi
    atr: bool = True
    prism_mm: float = 0.0
    air: Air = field(default_factory=Air)
    true_prism_mm: float = 0.0
    true_air: Air | None = None
    keeps_distance: bool = False
    distance: Distance = field(default_factory=Distance)
    _found: tuple[float, Shot] | None = None

    @property
    def face(self) -> int:
        return 1 if self.v <= math.pi else 2

    def turn(self, hz: float, v: float) -> None:
        """Point somewhere; what was found before counts no more."""
        self.hz, self.v, self._found = hz % FULL_TURN, v, None

    def change_face(self) -> None:
        """The same line of sight, in the other face."""
        self.turn(self.hz + math.pi, FULL_TURN - self.v)

    def seek(self, now_s: float) -> bool:
        """Find the reflector near the aim and put the cross-hairs on it; whether there is one."""
        shot = self._shoot(now_s)
        if shot.status == "no-target":
            return False
        self._aim_at(shot)
        self._found = (now_s, shot)
        return True

    def search(self, window_rad: tuple[float, float], now_s: float) -> bool:
        """Scan the window (full width of Hz and V) row by row about the aim; stop where a reflector shows."""
        hz, v = self.hz, self.v
        step = 0.01
        for up in _outward(window_rad[1], step):
            for across in _outward(window_rad[0], step):
                self.turn(hz + across, v + up)
                if self._shoot(now_s).status != "no-target":
                    return True
        self.turn(hz, v)
        return False

    def start_distance(self, now_s: float) -> None:
        """Begin to measure a distance."""
        old = self.distance
        self.distance = Distance(due_s=now_s + self.optics.measure_s, slope_m=old.slope_m, taken_s=old.taken_s)

    def clear_distance(self) -> None:
        """Forget it."""
        kept = self.distance if self.keeps_distance else Distance()
        self.distance = Distance(slope_m=kept.slope_m, taken_s=kept.taken_s)

    def finish_distance(self, now_s: float) -> Shot | None:
        """The shot whose distance is ready, None while there is none."""
        distance = self.distance
        if distance.shot is None and now_s >= distance.due_s - 1e-9:
            distance.shot = self._take_found(now_s) or self._shoot(now_s)
            if distance.shot.status != "no-target":
                self._aim_at(distance.shot)
                if not (self.keeps_distance and distance.slope_m > 0.0):
                    distance.slope_m, distance.taken_s = self._reads_m(distance.shot), now_s
        return distance.shot

    def _reads_m(self, shot: Shot) -> float:
        """The corrected distance: right where the corrections are those of the prism and of the air that there are."""
        true_mm = float(np.linalg.norm(shot.p_T_mm))
        ppm = 0.0 if self.true_air is None else self.air.ppm() - self.true_air.ppm()
        return (true_mm * (1.0 + ppm * 1e-6) + self.prism_mm - self.true_prism_mm) / 1000.0

    def _take_found(self, now_s: float) -> Shot | None:
        """The reflector of a search just made: aim and distance see the same one, with one chance of a gross error."""
        found, self._found = self._found, None
        fresh = found is not None and now_s - found[0] <= self.optics.measure_s + FRESH_S
        return found[1] if found is not None and fresh else None

    def _shoot(self, now_s: float) -> Shot:
        sin_v = math.sin(self.v)
        direction = np.array([sin_v * math.sin(self.hz), sin_v * math.cos(self.hz), math.cos(self.v)])
        return self.optics.shoot_towards(direction, now_s, self.face)

    def _aim_at(self, shot: Shot) -> None:
        """Point at the shot's coordinates (x east, y north, z up), in the face in which the telescope is."""
        east, north, up = (float(c) for c in shot.p_T_mm)
        azimuth = math.pi / 2.0 - math.atan2(north, east)
        zenith = math.acos(up / math.sqrt(east * east + north * north + up * up))
        second = self.face == 2
        self.hz = (azimuth + (math.pi if second else 0.0)) % FULL_TURN
        self.v = FULL_TURN - zenith if second else zenith


def _outward(width: float, step: float) -> list[float]:
    """0, +step, -step, +2 step ... out to half of `width` on either side."""
    count = int(0.5 * width / step)
    return [0.0] + [sign * k * step for k in range(1, count + 1) for sign in (1.0, -1.0)]
