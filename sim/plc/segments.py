"""What a PLC checks of a segment before it enters the FIFO."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from docking.config.cell import PositionerConfig
from sim.plc.playback import Playback, Point
from sim.plc.registers import AXES, FLAG_LAST, SEGMENT_CRC, SEGMENT_HEAD, SEGMENT_POINT, Reject, crc16, following

START_MM = 0.01
"""Largest distance of a plan's first knot from the read-back."""
SPEED_MARGIN = 1.05
PERIOD_MS = range(20, 501)


@dataclass(frozen=True)
class Segment:
    """One segment as it came: a knot of the plan at path time (seg_seq - 1) * dt."""

    plan_id: int
    sequence: int
    dt_ms: int
    last: bool
    n_axes: int
    intact: bool
    point_mm: Point

    @staticmethod
    def decode(data: bytes) -> Segment:
        """Segment from the bytes of the whole window."""
        plan_id, sequence, dt_ms, flags, n_axes = SEGMENT_HEAD.unpack_from(data)
        (crc,) = SEGMENT_CRC.unpack_from(data, SEGMENT_HEAD.size)
        payload = data[SEGMENT_HEAD.size + SEGMENT_CRC.size :]
        x, y, z = SEGMENT_POINT.unpack(payload)
        intact = crc16(data[: SEGMENT_HEAD.size] + payload) == crc
        return Segment(
            plan_id, sequence, dt_ms, bool(flags & FLAG_LAST), n_axes, intact, (x / 1000.0, y / 1000.0, z / 1000.0)
        )


class SegmentGate:
    """Decides on segments for the driven axes of one positioner; passive axes are masked."""

    def __init__(self, config: PositionerConfig) -> None:
        self._axes = config.axes
        self.driven = tuple(i for i, axis in enumerate(config.axes) if axis.driven)

    def judge(self, segment: Segment, queue: Playback, plan_id: int, position_mm: Sequence[float]) -> Reject:
        """Why the segment, next after `queue.last_seq`, may not enter the queue; `position_mm` is the read-back."""
        if not segment.intact:
            return Reject.CRC
        if segment.n_axes != AXES:
            return Reject.SHAPE
        first = queue.last_seq == 0
        reject = self._order(segment, queue, first, plan_id)
        if reject is not Reject.NONE:
            return reject
        if not self._inside(segment.point_mm):
            return Reject.STROKE
        if first:
            return Reject.NONE if self._near(segment.point_mm, position_mm) else Reject.OFF_POSITION
        return Reject.NONE if self._slow(segment, queue.knots[-1]) else Reject.SPEED

    @staticmethod
    def _order(segment: Segment, queue: Playback, first: bool, plan_id: int) -> Reject:
        if segment.sequence != following(queue.last_seq):
            return Reject.SEQUENCE
        if not first and segment.plan_id != plan_id:
            return Reject.PLAN
        if queue.complete:
            return Reject.AFTER_LAST
        if segment.dt_ms not in PERIOD_MS or (not first and segment.dt_ms != round(queue.period_s * 1000.0)):
            return Reject.PERIOD
        return Reject.NONE if queue.free > 0 else Reject.FULL

    def _inside(self, point_mm: Point) -> bool:
        return all(self._axes[i].stroke_mm[0] <= point_mm[i] <= self._axes[i].stroke_mm[1] for i in self.driven)

    def _near(self, point_mm: Point, position_mm: Sequence[float]) -> bool:
        return all(abs(point_mm[i] - position_mm[i]) <= START_MM + 1e-9 for i in self.driven)

    def _slow(self, segment: Segment, before_mm: Point) -> bool:
        reach_s = SPEED_MARGIN * segment.dt_ms / 1000.0
        return all(
            abs(segment.point_mm[i] - before_mm[i]) <= self._axes[i].v_mm_s * reach_s + 0.001 for i in self.driven
        )
