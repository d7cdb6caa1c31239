"""The live pose of a cell: settings from the files, the motion side behind them."""

from __future__ import annotations

import numpy as np

from docking.config import CellFile, JobFile
from docking.config.build import positioners_from
from docking.config.live import LiveConfig
from docking.config.nominal import feature_points, target_points
from docking.geometry import pose_from_vector
from docking.live import LiveSettings, LiveStreams, ReportingMotion, WatchedMotion
from docking.tracking.grades import GRADES
from docking.tracking.types import BodyModel
from docking.types import Pose


def watched_motion(
    cell: CellFile, job: JobFile, motion: ReportingMotion, streams: LiveStreams | None
) -> WatchedMotion | None:
    """`motion` watched as `[live]` says; None for a cell without. A cell with it is never run without its sensors."""
    if cell.live is None:
        return None
    if streams is None:
        raise ValueError("a cell with [live] needs the near ends of its sensors")
    return WatchedMotion(motion, streams, live_settings(cell, job, cell.live))


def live_settings(cell: CellFile, job: JobFile, live: LiveConfig) -> LiveSettings:
    """What the live pose needs of the files; the part is at the temperature that the job states."""
    part = job.component
    targets = target_points(part.targets, part, cell)
    features = feature_points(part, cell)
    names = (*(point.name for point in live.points), *targets.names)
    places = np.vstack([*(np.array(point.at_mm)[None] for point in live.points), targets.xyz_mm])
    mount = pose_from_vector(cell.inertial.mount_pose) if cell.inertial is not None else Pose.identity()
    return LiveSettings(
        body=BodyModel("part", names, places, np.array(part.com_mm), mount),
        # The lines of a camera pair name every point, those of a single camera its tools.
        tools=frozenset(names if cell.stereo is not None else (point.name for point in live.points)),
        feature_names=features.names,
        features_C_mm=features.xyz_mm,
        positioners=positioners_from(cell, job),
        X_WT=pose_from_vector(cell.camera.station_pose) if cell.camera is not None else Pose.identity(),
        model=GRADES[live.grade],
        method=live.method,
        match_mm=live.match_mm,
        sigma_mm=live.sigma_mm,
        delay_s=live.delay_s,
        deviation_mm=live.deviation_mm,
        frames=live.frames,
        predicted_sd_mm=live.predicted_sd_mm,
        blind_s=live.blind_s,
        rest_s=live.rest_s,
    )
