"""Faults where encoders and image are compared: which of the two is wrong, and what is then not believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from docking.errors import SensorFrozen
from docking.tracking.axis_filters import Mask
from docking.tracking.faults import Alarms, ClockWatch, FrameWatch, WatchSettings, swapped
from docking.tracking.types import BodyModel
from docking.types import Array

GATE = 30.0
"""Largest squared Mahalanobis distance of a point's innovation (3 dof)."""
REPEATED_FRAMES = 3
"""Frames alike to the last digit while the read-backs go on."""
GONE_ON_MM = 0.1
"""By so much the read-backs have to have gone on meanwhile."""
STEPPED = 0.5
"""Share of a disagreement that has come from one frame to the next where it is a step."""
SETTLES_MM = 1.0
"""A body may settle so far with no axis moving."""


class EncoderWatch:
    """Looks at the read-backs of one body, and at frames against what they predict."""

    def __init__(self, body: BodyModel, settings: WatchSettings, alarms: Alarms) -> None:
        self._names, self._s, self._alarms = body.names, settings, alarms
        self._where = f"{body.name} encoders"
        self._clock = ClockWatch(settings, alarms, self._where)
        self._frames = FrameWatch(body, replace(settings, same_frames=REPEATED_FRAMES), alarms)
        self._same, self._place = 0, np.zeros(0)
        self._fresh: Array | None = None
        self._agreed = np.zeros(3)
        self._first: Array | None = None
        self._anchor = self._beyond = np.zeros(3)
        self.frozen = False
        """Whether the read-backs stand still although the body moves."""

    def thawed(self, t_s: float, place_mm: Array) -> bool:
        """One read-back, the body's points (n, 3) by it; True where it is the first of encoders that were frozen."""
        self._clock.good(t_s)
        same = self._place.shape == place_mm.shape and bool(np.all(self._place == place_mm))
        self._same, self._place = self._same + 1 if same else 0, place_mm
        if same:
            return False
        before, self.frozen = self.frozen, False
        self._alarms.gone(SensorFrozen, self._where)
        return before

    def silent(self, now_s: float) -> bool:
        """Whether no read-back has come for so long that the encoders have to count as lost."""
        return self._clock.silent(now_s)

    def repeated(self, xyz_mm: Array, here_mm: Array) -> bool:
        """Whether the camera repeats itself while the read-backs have gone on to `here_mm` (3,)."""
        resting = self._fresh is None or float(np.linalg.norm(here_mm - self._fresh)) <= GONE_ON_MM
        found = self._frames.frozen(xyz_mm, resting)
        if not self._frames.repeats:
            self._fresh = here_mm
        return found

    def compare(self, beyond_mm: Array, sd_mm: float) -> None:
        """What a frame's points (k, 3) with noise `sd_mm` (in space) show beyond the read-backs: where it grows while
        these stay the same to the last digit, it is they that are wrong. A step is not: that is the tracker's."""
        off = beyond_mm.mean(axis=0)
        before, self._beyond = self._beyond, off
        if self._same < self._s.same_samples:
            self._anchor = off
            return
        limit = max(6.0 * sd_mm / float(np.sqrt(len(beyond_mm))), SETTLES_MM)
        if float(np.linalg.norm(off - before)) > STEPPED * limit:
            self._anchor = self._anchor + off - before
        if float(np.linalg.norm(off - self._anchor)) > limit:
            self.frozen = True
            self._alarms.raise_(SensorFrozen(self._where, value=self._same, limit=self._s.same_samples))

    def agreeing(self, rows: NDArray[np.intp], seen_mm: Array, residual_mm: Array, cov_mm2: Array) -> Mask:
        """Which of the points (k, 3) agree with their prediction, `cov_mm2` (k, 3, 3) that of the residual."""
        solved = np.linalg.solve(cov_mm2, residual_mm[:, :, None])[:, :, 0]
        good = np.asarray(np.einsum("ki,ki->k", residual_mm, solved) <= GATE)
        pairs: list[tuple[int, int]] = []
        if not good.all():
            near_mm = float(np.sqrt(GATE * np.trace(cov_mm2, axis1=1, axis2=2).max() / 3.0))
            pairs = swapped(seen_mm - residual_mm, seen_mm, near_mm)
        self._frames.tell_swapped(tuple(self._names[i] for i in rows), pairs)
        if good.any():
            self._frames.used()
            self._first, self._agreed = None, residual_mm[good].mean(axis=0)
        return good

    def refused(self, t_s: float, residual_mm: Array, sd_mm: float) -> bool:
        """A frame of which no point agrees; True when tracking has to begin anew. A step comes at once and stays."""
        shift = residual_mm.mean(axis=0)
        if self._first is None:
            self._first = shift
        size = float(np.linalg.norm(self._first))
        came = float(np.linalg.norm(self._first - self._agreed)) >= STEPPED * size
        room_mm = 0.3 * size + 3.0 * sd_mm / float(np.sqrt(len(residual_mm)))
        stays = float(np.linalg.norm(shift - self._first)) <= room_mm
        return self._frames.refused(t_s, residual_mm, sd_mm, came and stays)
