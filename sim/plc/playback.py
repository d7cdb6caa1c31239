"""The segment FIFO of one PLC: knots on an even grid of path time, played along straight chords between them.

Path time runs at `rate` times the PLC's own clock. Every start and stop changes the rate only, linearly in time with
1/`ramp_s` or, in a quick stop, 1/`quick_ramp_s`: the axes leave the chords at no rate.
"""

from __future__ import annotations

from collections import deque

from sim.plc.registers import following

Point = tuple[float, float, float]


class Playback:
    """A queue of at most `capacity` knots (mm, three axes) and the place that is being played."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.ramp_s = self.quick_ramp_s = 0.5
        self.play_seq = 0
        self.fraction = 0.0
        self.clear()

    def clear(self) -> None:
        """Forget the plan; the rate is zero. The place stays to be reported until the next plan's first knot."""
        self.knots: deque[Point] = deque()
        self.period_s = 0.0
        self.last_seq = 0
        self.complete = False
        self.rate = 0.0
        self.goal = 0.0
        self.lead_s = 0.0
        self._slope_s = self.ramp_s

    @property
    def free(self) -> int:
        return self.capacity - len(self.knots)

    @property
    def remaining_s(self) -> float:
        """Path time between the place that is played and the last knot in the queue."""
        return (len(self.knots) - 1 - self.fraction) * self.period_s

    @property
    def at_end(self) -> bool:
        """True when the last knot of the plan is reached."""
        return self.complete and len(self.knots) == 1

    @property
    def stopping_s(self) -> float:
        """Path time that a stop from the present rate takes: rate^2 ramp / 2."""
        return 0.5 * self.rate * self.rate * self.ramp_s

    def runs_dry(self, margin_s: float) -> bool:
        """True when a stop begun within `margin_s` from now would come to the last knot before the plan's end."""
        return not self.complete and self.remaining_s <= self.stopping_s + margin_s

    def push(self, knot: Point, last: bool) -> None:
        """Append the knot after `last_seq`."""
        self.last_seq = following(self.last_seq)
        if not self.knots:
            self.play_seq, self.fraction = self.last_seq, 0.0
        self.knots.append(knot)
        self.complete = last

    def start(self, rate: float, goal: float, late_s: float) -> None:
        """Let path time run: at once with `rate`, rising to `goal`; the first `late_s` are lost (skew of the edge)."""
        self.rate, self.goal, self.lead_s = rate, goal, -late_s
        self._slope_s = self.ramp_s

    def stop(self, quick: bool = False) -> None:
        """Ramp the rate down to zero; a quick stop makes a ramp steeper, an ordinary one never flatter."""
        self._slope_s = min(self._slope_s, self.quick_ramp_s) if quick else self._slope_s
        self.goal = 0.0

    def advance(self, dt_s: float) -> None:
        """Let `dt_s` of the PLC's clock pass."""
        if self.lead_s < 0.0:
            self.lead_s += dt_s
            dt_s = max(0.0, self.lead_s)
        self.fraction += self._path_step_s(dt_s) / self.period_s
        while self.fraction >= 1.0 and len(self.knots) > 1:
            self.knots.popleft()
            self.play_seq = following(self.play_seq)
            self.fraction -= 1.0
        if len(self.knots) == 1:
            self.fraction = 0.0

    def _path_step_s(self, dt_s: float) -> float:
        """Path time passed while the rate goes linearly to its goal (area under the rate)."""
        rate, goal = self.rate, self.goal
        if rate == goal:
            return rate * dt_s
        ramp_s = abs(goal - rate) * self._slope_s
        if ramp_s <= dt_s:
            self.rate = goal
            return 0.5 * (rate + goal) * ramp_s + goal * (dt_s - ramp_s)
        self.rate = rate + (goal - rate) * dt_s / ramp_s
        return 0.5 * (rate + self.rate) * dt_s

    def point(self) -> Point:
        """The commanded position on the chord (mm)."""
        a = self.knots[0]
        f = self.fraction
        if f == 0.0:
            return a
        b = self.knots[1]
        return (a[0] + (b[0] - a[0]) * f, a[1] + (b[1] - a[1]) * f, a[2] + (b[2] - a[2]) * f)
