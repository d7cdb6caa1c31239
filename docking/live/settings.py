"""What the live pose needs to know of cell and part, and the tracker that it asks for."""

from __future__ import annotations

from dataclasses import dataclass

from docking.kinematics import Positioners
from docking.tracking.encoders import EncoderSettings, EncoderTracker
from docking.tracking.inertial import InertialSettings, InertialTracker
from docking.tracking.published import PublishedTracker
from docking.tracking.repaired import RepairedTracker
from docking.tracking.types import BodyModel, InertialModel, Start, Tracker
from docking.types import Array, Pose, _Frozen

START_TILT_RAD = 1e-3
"""How well the read-backs give the part's attitude at rest, 1 sigma an axis."""
AT_REST_MM_S = 1.0


@dataclass(frozen=True, eq=False)
class LiveSettings(_Frozen):
    """`body`: points that may be seen, in the component frame; those named in `tools` are tools of the camera, all
    others single markers. `features_C_mm` (f, 3) with `feature_names`: where a deviation counts. `X_WT`: the camera's
    approximate pose. The rest as `docking.config.live.LiveConfig` says.
    """

    body: BodyModel
    tools: frozenset[str]
    feature_names: tuple[str, ...]
    features_C_mm: Array
    positioners: Positioners
    X_WT: Pose
    model: InertialModel
    method: str
    match_mm: float
    sigma_mm: float
    delay_s: float
    deviation_mm: float
    frames: int
    predicted_sd_mm: float
    blind_s: float
    rest_s: float

    @property
    def chosen(self) -> str:
        """The method that is used: `auto` takes the read-backs, which bridge a gap better than any inertial sensor."""
        return "encoders" if self.method == "auto" else self.method


def tracker_at_rest(settings: LiveSettings, X_WB: Pose) -> Tracker:
    """A fresh tracker for a part that stands at about `X_WB`."""
    body, model = settings.body, settings.model
    if settings.chosen == "encoders":
        return EncoderTracker(body, EncoderSettings(offset_sd_mm=2.0 * settings.match_mm, watch=None))
    start = Start(X_WB.R, START_TILT_RAD, START_TILT_RAD, AT_REST_MM_S)
    if settings.chosen == "repaired":
        return RepairedTracker(body, model, start)
    if settings.chosen == "published":
        return PublishedTracker(body, model, start)
    # A move creeps as evenly as a part at rest: a quiet sensor proves nothing here.
    return InertialTracker(body, model, start, InertialSettings(zero_velocity=None, lever_limit_mm=float("inf")))
