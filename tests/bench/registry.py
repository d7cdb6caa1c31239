"""All metrics of `make bench`: one file a group."""

from __future__ import annotations

from tests.bench import (
    bundle_adjustment,
    can_frames,
    fault_reaction,
    guidance_speed,
    modbus_wire,
    planning,
    pose_fit,
    stop_replan,
    stop_residual,
    study,
    tick_lateness,
    tracker_frames,
    tracking,
    virtual_time,
)
from tests.bench.metric import Group

GROUPS: dict[str, Group] = {
    "P1": tracker_frames.measure,
    "P2": pose_fit.measure,
    "P3": planning.measure,
    "P4": stop_replan.measure,
    "P5": can_frames.measure,
    "P6": modbus_wire.measure,
    "P8": tick_lateness.measure,
    "P9": fault_reaction.measure,
    "P10": stop_residual.measure,
    "P11": virtual_time.measure,
    "P12": study.measure,
    "P13": tracking.measure,
    "P17": bundle_adjustment.measure,
    "P18": guidance_speed.measure,
}
