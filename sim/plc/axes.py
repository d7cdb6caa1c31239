"""What a PLC watches of its own axes in each scan while path time runs."""

from __future__ import annotations

from sim.plc.playback import Point
from sim.plc.registers import AXES, Fault
from sim.plc.sensors import Sensors


class AxisGuard:
    """The axes of one positioner: inputs of their drives and limit switches, following error, standing still.

    `driven` are the axes under power; `limit` and `drive_fault` the inputs. A PLC knows a stuck axis by itself, one
    scan after it hangs back by more than `stuck_mm`: no host on a network could tell the others in time.
    """

    def __init__(self, driven: tuple[int, ...], sensors: Sensors, trip_mm: float) -> None:
        self._driven, self._sensors, self._trip_mm = driven, sensors, trip_mm
        self.limit = [False] * AXES
        self.drive_fault = [False] * AXES
        self.stuck_mm, self.lag_s = 0.02, 0.0
        self._step_mm: Point = (0.0, 0.0, 0.0)
        self._dt_s = 0.0

    def commanded(self, before_mm: Point, after_mm: Point, dt_s: float) -> None:
        """Note by how much the set-points went on in this scan of `dt_s`."""
        self._dt_s = dt_s
        self._step_mm = (after_mm[0] - before_mm[0], after_mm[1] - before_mm[1], after_mm[2] - before_mm[2])

    def complaint(self) -> tuple[Fault, int] | None:
        """The fault of an axis and its index, judged by the set-points of the scan before; None when all is well."""
        for i in self._driven:
            if self.drive_fault[i]:
                return Fault.DRIVE, i
            if self.limit[i]:
                return Fault.LIMIT, i
        if not self._dt_s > 0.0:
            return None
        x, y, z = self._step_mm
        fastest = max(abs(x), abs(y), abs(z)) / self._dt_s
        if not self._sensors.strays(min(self._trip_mm, self.stuck_mm - self.lag_s * fastest)):
            return None
        return self._closer_look()

    def _closer_look(self) -> tuple[Fault, int] | None:
        errors, before = self._sensors.following_error_mm(), self._sensors.following_error_before_mm()
        for i in self._driven:
            if not abs(errors[i]) <= self._trip_mm:
                return Fault.FOLLOWING_ERROR, i
            step = self._step_mm[i]
            # The encoder moved by the step less what the following error grew.
            moved = step - (errors[i] - before[i])
            behind = abs(errors[i] - self.lag_s * step / self._dt_s)
            if behind > self.stuck_mm and abs(moved) < 0.5 * abs(step):
                return Fault.STUCK, i
        return None
