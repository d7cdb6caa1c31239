"""Motion over a bus that takes one set-point a cycle: the tick, at a fixed rate on absolute deadlines.

Every tick: newest read-back, monitors, arbiter, path time, set-points and SYNC. So what is found changes the set-points
of the same tick.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from dataclasses import replace

import numpy as np

from docking.errors import Defect, DockingError, LinkLost, PlanStale, StoppedByOperator, TickLate
from docking.motion.arbiter import Arbiter, Mode, Reaction
from docking.motion.braking import Braking
from docking.motion.lateness import Lateness
from docking.motion.monitors import Watch
from docking.motion.playback import Playback
from docking.motion.recorder import Recorder
from docking.motion.standstill import Standstill
from docking.motion.start import newest, require, require_enabled, require_free, require_here, share_of
from docking.motion.stops import PlannedStop, planned_stop
from docking.motion.streamed_move import StreamedMove
from docking.motion.triggers import Finding, Trigger
from docking.ports import StreamedPositioners
from docking.types import Array, Feedback, Identity, MoveResult, Plan, readonly

START_TOLERANCE_MM = 0.01
TRACE_PERIOD_S = 0.1
STOP_CYCLES = 2
"""Cycles by which a stop on the path may outlast itself."""
QUICK_STOP_S = 0.1
"""By which a quick stop may outlast its ramp until all axes are seen at rest."""
BRAKE_S = 2.0
RESET_S = 0.3
"""How long nothing may be found again after what the nodes reported has been forgotten: three heartbeats."""


class StreamedMotion:
    """The `Motion` port over `StreamedPositioners`. Owns the tick from `enable` to `close`.

    A tick that comes more than `late_cycles` late stops the axes. `arbiter` decides every stop; `lateness` counts how
    late the ticks came.
    """

    def __init__(self, positioners: StreamedPositioners, watch: Watch, late_cycles: float) -> None:
        self._bus, self._watch = positioners, watch
        self.axes = positioners.axes
        self.lateness = Lateness()
        self.arbiter = Arbiter(self._allowed_s)
        self._cycle_s = positioners.cycle_s
        self._late_limit_s = late_cycles * self._cycle_s
        self._setpoint: Array = np.zeros(len(self.axes))
        self._history: deque[Array] = deque(maxlen=2)
        self._feedback: Feedback | None = None
        self._loaded: tuple[Playback, PlannedStop] | None = None
        self._move: StreamedMove | None = None
        self._early: list[str] = []
        self._share = 1.0
        self._applied = Reaction.NONE
        # Brakes that stay unconfirmed let the arbiter open the hardware chain when their time is over.
        self._braking = Braking(positioners, lambda error: self._raise(Trigger.AXIS_OFF, error))
        self._standstill = Standstill()
        self._quick_stop_s = QUICK_STOP_S
        self._timer: asyncio.Handle | None = None
        self._ticked = asyncio.Event()
        self._deadline_s = self._skipped_s = 0.0

    # the port ----------------------------------------------------------------------------------------------------
    async def connect(self) -> tuple[Identity, ...]:
        return await self._bus.bring_up()

    async def enable(self) -> Array:
        """Raises AxisUnreferenced, or the fault that is kept: `reset` comes first."""
        self.arbiter.require_referenced()
        self._require_free()
        self._end_ticks()
        self.arbiter.enter(Mode.OFF)
        feedback = await self._bus.enable()
        self._setpoint = readonly(feedback.position_mm)
        self._history.extend([self._setpoint] * 2)
        self._feedback, self._loaded = feedback, None
        self._early.clear()
        self._watch.watch_about(self._setpoint)
        self.arbiter.enter(Mode.STANDING)
        loop = asyncio.get_running_loop()
        self._deadline_s = loop.time()
        self._timer = loop.call_soon(self._tick)
        return self._setpoint

    async def load(self, plan: Plan) -> None:
        """Take a plan, and set the drives' own ramps for it. Nothing moves.

        Refused where the part is strained already (MeasuredForceTrip, MeasuredWarpTrip, BallForceTrip, BallUnloaded);
        a relief is the plan for that.
        """
        self._require_free()
        require_here(plan, self._setpoint, self._watch.driven, START_TOLERANCE_MM)
        self._require_enabled()
        stop = planned_stop(plan, self._bus.a_quick_mm_s2, self._cycle_s)
        self._loaded = None
        await self._bus.arm_stops(stop.peak_mm_s, stop.t_stop_s)
        self._require_free()
        # Axes without a set-point stand where the component has taken them: the plan begins there.
        self._setpoint = readonly(np.where(self._watch.driven, self._setpoint, plan.q_mm[0]))
        self._history.extend([self._setpoint] * 2)
        await self._next_tick()
        self._watch.watch_about(plan.q_mm[0], relief=plan.kind == "relief")
        require(self._watch.strained_before(self.feedback()))
        self._quick_stop_s = stop.t_stop_s + QUICK_STOP_S
        self._loaded = Playback(plan, self._share), stop

    async def start(self, plan_hash: str) -> MoveResult:
        self._require_free()
        loaded, self._loaded = self._loaded, None
        if loaded is None or loaded[0].plan.plan_hash != plan_hash:
            raise PlanStale("motion", "this plan is not loaded")
        self._require_enabled()
        require(self._watch.changed_at_rest(self.feedback()))
        playback, stop = loaded
        recorder = Recorder(self._watch, max(1, round(TRACE_PERIOD_S / self._cycle_s)))
        done: asyncio.Future[MoveResult] = asyncio.get_running_loop().create_future()
        self.arbiter.enter(Mode.MOVING)
        self._move = StreamedMove(playback, recorder, stop, done)
        if self._early:
            playback.wait()
        for verb in self._early:
            self._obey(self._move, verb)
        try:
            return await done
        except asyncio.CancelledError:
            # Nobody waits for this move any more, so nobody watches it.
            self.request("stop")
            raise
        finally:
            self._early.clear()

    def request(self, verb: str) -> None:
        """`hold`, `resume` or `stop`, all on the path. Never waits."""
        if self._move is None:
            # A hold that comes before the first set-point counts from the first set-point on.
            self._early.append(verb)
        else:
            self._obey(self._move, verb)

    def override(self, percent: float) -> None:
        """Run this move and later ones at `percent` (0..100) of their speed, on the same path. A hold goes on.

        Raises BadArgument.
        """
        self._share = share_of(percent)
        move = self._move
        if move is not None and self.arbiter.mode is Mode.MOVING:
            move.playback.override(self._share)

    def report(self, finding: Finding) -> None:
        """Something outside the axes asks for a reaction: judged and latched as what the monitors find."""
        self._raise(finding.trigger, finding.error)

    async def reset(self, role: str) -> None:
        """Forget the fault that is kept, on a person's order; then the axes have to be enabled again. Moves nothing.

        Drives in fault are reset, too. Raises EventRefused with the reason, EnableFailed, LinkError.
        """
        asked = self.arbiter.admit(role)
        await self._bus.reset_faults()
        await asyncio.sleep(RESET_S)
        self.arbiter.reset(asked, self._clock_s())
        self._applied = Reaction.NONE
        self.arbiter.enter(Mode.OFF)

    def feedback(self) -> Feedback:
        """The newest read-back. Raises the fault that is kept."""
        return newest(self.arbiter, self._feedback)

    async def close(self) -> None:
        if self._move is not None:
            over = self._move.over
            self.request("stop")
            await over.wait()
        self._end_ticks()
        await self._braking.cancel()
        await self._bus.close()

    def _require_free(self) -> None:
        require_free(self.arbiter, moving=self._move is not None)

    def _require_enabled(self) -> None:
        require_enabled(self.arbiter, self._watch, self._feedback)

    def _obey(self, move: StreamedMove, verb: str) -> None:
        if verb == "stop":
            self._raise(Trigger.OPERATOR_STOP, StoppedByOperator("motion"))
        elif self.arbiter.mode is not Mode.MOVING:
            return
        elif verb == "hold":
            move.playback.hold()
        else:
            changed = self._watch.changed_at_rest(self._feedback) if self._feedback is not None else None
            if changed is None:
                move.playback.resume()
            else:
                self._raise(changed.trigger, changed.error)

    async def _next_tick(self) -> None:
        """Wait until just after a tick: what takes a few milliseconds then makes no tick late."""
        self._ticked.clear()
        if self._timer is not None:
            await self._ticked.wait()
        self._require_free()

    def _end_ticks(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    # the tick ----------------------------------------------------------------------------------------------------
    def _tick(self) -> None:
        self._timer = None
        try:
            self._cycle()
        except Exception as error:
            # No more set-points. Whoever waits for the move learns why, and so does everyone who asks later.
            move = self._move
            self._raise(Trigger.DEFECT, Defect("motion", f"{type(error).__name__}: {error}"))
            self._end()
            if move is not None and not move.done.done():
                move.done.set_exception(error)
            raise
        finally:
            self._ticked.set()

    def _cycle(self) -> None:
        now_s = asyncio.get_running_loop().time()
        late_s = now_s - self._deadline_s
        self.lateness.add(late_s)
        # Missed deadlines are skipped, never made up for in a burst; the next is at least half a cycle away.
        missed = max(0, math.floor(late_s / self._cycle_s + 0.5))
        self._skipped_s += missed * self._cycle_s
        before, feedback = self._feedback, self._bus.latest()
        self._feedback = feedback
        applied = self._applied
        self._judge(feedback)
        if not (late_s <= self._late_limit_s):
            self._raise(Trigger.TICK_LATE, TickLate("motion", value=late_s, limit=self._late_limit_s))
        stopping = self.arbiter.mode is Mode.STOPPING
        if self._applied is Reaction.SBT and self._braking.waits:
            self._braking.cycle(self._stand(before, feedback))
        self._react(self.arbiter.poll(self._clock_s(), stopping and self._at_rest(before, feedback)))
        if self._applied is not Reaction.HW:
            self._go_on(before, feedback, quick=self._applied >= Reaction.SQS > applied)
        if self._applied is Reaction.HW:
            self._finish("fault")
            return
        self._deadline_s += (1 + missed) * self._cycle_s
        self._timer = asyncio.get_running_loop().call_at(self._deadline_s, self._tick)

    def _go_on(self, before: Feedback | None, feedback: Feedback, *, quick: bool) -> None:
        """Path time, set-points and SYNC; `quick` says that the quick stop has just sent this cycle's frames."""
        move = self._move
        if move is not None:
            move.recorder.add(feedback, move.playback.path_time_s)
            if self.arbiter.mode in (Mode.STANDING, Mode.OFF):
                self._end_stop(move, before, feedback)
            elif self._applied < Reaction.SQS:
                self._setpoint = move.playback.advance(self._cycle_s)
        self._history.append(self._setpoint)
        if not quick:
            self._send()
        self._note_command()
        if self._move is not None and self.arbiter.mode is Mode.MOVING and self._move.playback.at_end:
            self._finish("done")

    def _send(self) -> None:
        try:
            self._bus.send(self._setpoint)
        except LinkLost as error:
            self._raise(Trigger.LINK_LOST, error)
        except DockingError as error:
            # Set-points that a drive cannot take: nothing was sent, so the drives have to stop by themselves.
            self._raise(Trigger.DEFECT, error)

    def _note_command(self) -> None:
        """What has been sent just now is the first that differs, if a stop has begun."""
        if self._move is not None:
            self._move.clock.commanded(asyncio.get_running_loop().time())

    def _end_stop(self, move: StreamedMove, before: Feedback | None, feedback: Feedback) -> None:
        """The commands are at rest after a stop: end the move as soon as the axes are seen at rest, too."""
        if not move.has_ended(self._stand(before, feedback), asyncio.get_running_loop().time()):
            return
        if self._applied >= Reaction.SQS:
            self._setpoint = readonly(feedback.position_mm)
        self._finish("fault" if self.arbiter.latched else "done" if move.playback.at_end else "stopped")
        self._applied = self.arbiter.reaction

    # monitors and reactions --------------------------------------------------------------------------------------
    def _judge(self, feedback: Feedback) -> None:
        mode, move = self.arbiter.mode, self._move
        if mode is Mode.OFF:
            return
        # A read-back belongs to the set-point of two cycles ago: one cycle on the bus, one until the drive applies it.
        speed = 0.0 if move is None else move.playback.speed_at(move.playback.path_time_s)
        finding = self._watch.evaluate(
            feedback,
            self._history[0],
            speed,
            moving=mode is not Mode.STANDING,
            may_stop=self._applied >= Reaction.SQS,
        )
        if finding is None:
            return
        if finding.trigger is Trigger.AXIS_OFF and mode is Mode.STANDING and self._applied >= Reaction.SQS:
            # What the stop itself has left behind: enabling brings the axes back.
            return
        self._react(self.arbiter.raise_(finding, self._clock_s()))

    def _raise(self, trigger: Trigger, error: DockingError) -> None:
        self._react(self.arbiter.raise_(Finding(trigger, error), self._clock_s()))

    def _clock_s(self) -> float:
        """Time for the arbiter: cycles that did not take place lengthen a stop without making it wrong."""
        return asyncio.get_running_loop().time() - self._skipped_s

    def _allowed_s(self, reaction: Reaction) -> float:
        """How long a reaction that begins now may take."""
        if reaction is Reaction.SBT:
            return self._quick_stop_s + BRAKE_S
        if reaction >= Reaction.SQS or self._move is None:
            return self._quick_stop_s
        return self._move.led_stop_s(reaction) + STOP_CYCLES * self._cycle_s

    def _react(self, reaction: Reaction) -> None:
        """Begin the reaction in force, unless it has begun."""
        now_s = asyncio.get_running_loop().time()
        move = self._move
        if move is not None:
            move.clock.follow(self.arbiter.latched, reaction, now_s)
        if not (reaction > self._applied):
            return
        self._applied = reaction
        self._standstill.begin()
        if move is not None and reaction < Reaction.SQS:
            move.slow_down(reaction)
        elif reaction is Reaction.HW:
            self._bus.go_silent()
            self._note_command()
        elif reaction >= Reaction.SQS:
            self._bus.quick_stop()
            self._note_command()
        if reaction is Reaction.SBT:
            self._braking.begin(now_s + self._quick_stop_s, standing=move is None or move.playback.standing)

    def _stand(self, before: Feedback | None, feedback: Feedback) -> bool:
        """One cycle on: whether all axes are seen at rest."""
        gone = tuple(self.axes.index(axis) for axis in self.arbiter.restarted)
        return self._standstill.seen(before, feedback, gone)

    def _at_rest(self, before: Feedback | None, feedback: Feedback) -> bool:
        """Whether the reaction in force has reached its end."""
        if self._applied is Reaction.SBT:
            return self._braking.confirmed
        if self._applied is Reaction.SQS:
            return self._stand(before, feedback)
        return self._move is None or self._move.playback.standing or self._move.playback.at_end

    def _finish(self, outcome: str) -> None:
        """End the move, if there is one."""
        move = self._move
        if move is None:
            return
        cause = self.arbiter.first.error if self.arbiter.first is not None else None
        ended = move.result(outcome, self._setpoint, cause)
        result = replace(ended, reaction=self.arbiter.in_force, also=self.arbiter.also)
        self._end()
        if not move.done.done():
            move.done.set_result(result)

    def _end(self) -> None:
        move, self._move = self._move, None
        if self.arbiter.mode is Mode.MOVING:
            self.arbiter.enter(Mode.STANDING)
        if move is not None:
            move.over.set()
