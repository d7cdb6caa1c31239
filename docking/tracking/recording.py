"""A recording of one moving body: what its sources said, as arrays. Pure noun; readers are in `docking.recordings`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from docking.tracking.types import BodyModel
from docking.types import Array, _Frozen


@dataclass(frozen=True, eq=False)
class Recording(_Frozen):
    """Everything on one clock, in order.

    Inertial samples `imu_t_s` (N,), `force_m_s2`, `rate_rad_s` (N, 3); frames `frame_t_s` (M,), `points_W_mm` (M, n, 3)
    with NaN where a point is not seen, `sigma_mm` (M, n, 3). `attitude_WB` (M, 3, 3), NaN where not known: used for the
    start only. Encoder poses `encoder_t_s` (K,), `encoder_R` (K, 3, 3), `encoder_t_mm` (K, 3). `moving` (M,): 1 where
    somebody marked motion, 0 where not, NaN where nobody did. `cov_mm2` (M, n, 3, 3) where the points have more to say
    than `sigma_mm`, as those of a camera pair do.
    """

    name: str
    body: BodyModel
    imu_t_s: Array
    force_m_s2: Array
    rate_rad_s: Array
    frame_t_s: Array
    points_W_mm: Array
    sigma_mm: Array
    attitude_WB: Array
    encoder_t_s: Array
    encoder_R: Array
    encoder_t_mm: Array
    moving: Array
    cov_mm2: Array | None = None

    @property
    def begin_s(self) -> float:
        """Time of the first frame."""
        return float(self.frame_t_s[0])

    def cov_of(self, frame: int) -> Array:
        """Covariances (n, 3, 3) of the points of one frame, mm^2."""
        if self.cov_mm2 is not None:
            return np.asarray(self.cov_mm2[frame])
        return np.asarray(self.sigma_mm[frame][:, :, None] ** 2 * np.eye(3))

    def seen(self) -> NDArray[np.bool_]:
        """(M, n): which points every frame shows."""
        return np.asarray(np.isfinite(self.points_W_mm).all(axis=2))


class Gap(NamedTuple):
    """All points hidden from `start_s` for `length_s`, counted from the first frame."""

    start_s: float
    length_s: float
