"""Motion over positioners that play a queue of segments after one common start.

One task polls, judges and commands, from `enable` to `close`. The controllers ramp by themselves: a stop on the path is
their ordinary ramp, everything harder their quick one, which ends with brakes and no torque.
"""

from __future__ import annotations

import asyncio
from dataclasses import replace

import numpy as np

from docking.errors import (
    BadReply,
    Defect,
    DeviceSilent,
    DockingError,
    LinkLost,
    OutcomeUnknown,
    PlanStale,
    StoppedByOperator,
)
from docking.motion.arbiter import Arbiter, Mode, Reaction
from docking.motion.lateness import Lateness
from docking.motion.monitors import Watch
from docking.motion.playback import Playback
from docking.motion.queued_move import Phase, QueuedMove
from docking.motion.recorder import Recorder
from docking.motion.rhythm import Rhythm
from docking.motion.start import newest, require, require_enabled, require_free, require_here, share_of
from docking.motion.triggers import Finding, Trigger
from docking.ports import QueuedPositioners
from docking.types import Array, AxisState, Feedback, Identity, MoveResult, Plan, readonly

START_TOLERANCE_MM = 0.02
STANDSTILL_MM = 0.002
END_POLLS = 3
TRACE_PERIOD_S = 0.1
BRAKE_S = 2.0
TOLD_S = 0.5
"""In so long a stop has reached every controller that can be reached, and its end has been seen."""
RESET_S = 0.3
"""How long nothing may be found again after the controllers were told to forget their faults."""


class QueuedMotion:
    """The `Motion` port over `QueuedPositioners`. `arbiter` decides every stop that the controllers do not."""

    def __init__(self, positioners: QueuedPositioners, watch: Watch, poll_s: float) -> None:
        self._bus, self._watch, self._poll_s = positioners, watch, poll_s
        self.axes = positioners.axes
        self.arbiter = Arbiter(self._allowed_s)
        self._commanded: Array = np.zeros(len(self.axes))
        self._feedback: Feedback | None = None
        self._loaded: Playback | None = None
        self._move: QueuedMove | None = None
        self._early: list[str] = []
        self._share = self._told_share = 1.0
        self._applied = Reaction.NONE
        self._deaf = self._slowing = False
        self._still = self._unasked = 0
        self._keeper: asyncio.Task[None] | None = None
        self._rhythm = Rhythm(poll_s)
        positioners.on_lost = self._rhythm.wake

    @property
    def lateness(self) -> Lateness:
        """How late the polls came."""
        return self._rhythm.lateness

    # the port ----------------------------------------------------------------------------------------------------
    async def connect(self) -> tuple[Identity, ...]:
        return await self._bus.bring_up()

    async def enable(self) -> Array:
        """Raises AxisUnreferenced, or the fault that is kept: `reset` comes first."""
        self.arbiter.require_referenced()
        self._require_free()
        await self._end_keeper()
        self.arbiter.enter(Mode.OFF)
        self._feedback = await self._bus.enable()
        self._commanded = readonly(self._feedback.position_mm)
        self._loaded, self._deaf = None, False
        self._early.clear()
        self._watch.watch_about(self._commanded)
        self.arbiter.enter(Mode.STANDING)
        self._rhythm.begin()
        self._keeper = asyncio.get_running_loop().create_task(self._keep())
        return self._commanded

    async def load(self, plan: Plan) -> None:
        """Take a plan; the controllers take its start and its quick ramp. Nothing moves.

        Refused where the load cells show a part that is strained already; a relief is the plan for that.
        """
        self._require_free()
        require_here(plan, self._commanded, self._watch.driven, START_TOLERANCE_MM)
        self._loaded = None
        self._require_enabled()
        await self._bus.load(plan)
        await self._rhythm.next_cycle()
        self._require_free()
        self._require_enabled()
        self._watch.watch_about(plan.q_mm[0], relief=plan.kind == "relief")
        require(self._watch.strained_before(self.feedback()))
        self._commanded = plan.q_mm[0]
        self._loaded = Playback(plan)

    async def start(self, plan_hash: str) -> MoveResult:
        self._require_free()
        playback, self._loaded = self._loaded, None
        if playback is None or playback.plan.plan_hash != plan_hash:
            raise PlanStale("motion", "this plan is not loaded")
        self._require_enabled()
        require(self._watch.changed_at_rest(self.feedback()))
        recorder = Recorder(self._watch, max(1, round(TRACE_PERIOD_S / self._poll_s)))
        self.arbiter.enter(Mode.MOVING)
        self._move = move = QueuedMove(playback, recorder, asyncio.get_running_loop().create_future())
        self._slowing, self._still, self._unasked = False, 0, 0
        early, self._early = self._early, []
        for verb in early:
            self._obey(move, verb)
        self._rhythm.wake()
        try:
            return await asyncio.shield(move.done)
        except asyncio.CancelledError:
            # Nobody waits for this move any more, so nobody watches it.
            self.request("stop")
            raise

    def request(self, verb: str) -> None:
        """`hold`, `resume` or `stop`, all on the path. Never waits."""
        if self._move is None:
            self._early.append(verb)
            return
        self._obey(self._move, verb)
        self._rhythm.wake()

    def _obey(self, move: QueuedMove, verb: str) -> None:
        changed = None
        if verb == "resume" and self._feedback is not None:
            changed = self._watch.changed_at_rest(self._feedback)
        if verb == "stop":
            self._raise(Trigger.OPERATOR_STOP, StoppedByOperator("motion"))
        elif changed is not None:
            self._raise(changed.trigger, changed.error)
        else:
            move.held = verb == "hold"

    def override(self, percent: float) -> None:
        """Run this move and later ones at `percent` (0..100) of their speed, on the same path. A hold goes on.

        The controllers take a new rate at standstill only: a move in progress is held for it. Raises BadArgument.
        """
        self._share = share_of(percent)
        self._rhythm.wake()

    def report(self, finding: Finding) -> None:
        """Something outside the axes asks for a reaction: judged and latched as what the monitors find."""
        self._raise(finding.trigger, finding.error)
        self._rhythm.wake()

    async def reset(self, role: str) -> None:
        """Forget the fault that is kept, on a person's order; then the axes have to be enabled again. Moves nothing.

        Controllers in fault are reset, too. Raises EventRefused with the reason, and what their commands raise.
        """
        asked = self.arbiter.admit(role)
        await self._bus.command("reset")
        self._deaf = False
        await asyncio.sleep(RESET_S)
        self.arbiter.reset(asked, asyncio.get_running_loop().time())
        self._applied = Reaction.NONE
        self.arbiter.enter(Mode.OFF)

    def feedback(self) -> Feedback:
        """The newest read-back. Raises the fault that is kept."""
        return newest(self.arbiter, self._feedback)

    async def close(self) -> None:
        if self._move is not None and self._rhythm.running:
            self.request("stop")
            await asyncio.wait((self._move.done,))
        await self._end_keeper()
        await self._bus.close()

    def _require_free(self) -> None:
        require_free(self.arbiter, moving=self._move is not None)

    def _require_enabled(self) -> None:
        require_enabled(self.arbiter, self._watch, self._feedback)

    # the keeper --------------------------------------------------------------------------------------------------
    async def _keep(self) -> None:
        try:
            while self._applied is not Reaction.HW:
                await self._rhythm.nap(moving=self._move is not None)
                await self._cycle()
                self._rhythm.cycled()
        except Exception as error:
            # Nobody polls any more: the controllers are told once, and miss the heartbeat afterwards. Whoever waits
            # for the move learns why, and so does everyone who asks later.
            self._raise(Trigger.DEFECT, _defect(error))
            await self._react()
            move, self._move = self._move, None
            if move is not None:
                move.fail(error)
            raise
        finally:
            self._rhythm.end()

    async def _end_keeper(self) -> None:
        if self._keeper is not None:
            self._keeper.cancel()
            await asyncio.gather(self._keeper, return_exceptions=True)
            self._keeper = None

    async def _cycle(self) -> None:
        before = self._feedback
        feedback = await self._poll()
        if feedback is not None:
            self._count_still(before, feedback)
            self._judge(feedback)
            if self._move is not None:
                self._move.recorder.add(feedback, feedback.path_time_s)
        await self._react()
        now_s = asyncio.get_running_loop().time()
        self.arbiter.poll(now_s, self.arbiter.mode is Mode.STOPPING and self._at_rest())
        self._note_finding(now_s)
        await self._react()
        move = self._move
        if self.arbiter.mode in (Mode.STANDING, Mode.OFF):
            self._end_stop()
        elif move is not None and feedback is not None and self.arbiter.mode is Mode.MOVING:
            if move.ended(feedback) and self._still >= END_POLLS:
                self._finish("done")
            else:
                await self._lead(move, feedback)

    async def _poll(self) -> Feedback | None:
        """A read-back; None when it fails, and from then on read-backs of those that still answer."""
        try:
            self._feedback = await self._bus.poll(surviving=self._deaf)
        except DockingError as error:
            self._deaf = True
            self._raise(_trigger_of(error), error)
            return None
        return self._feedback

    def _count_still(self, before: Feedback | None, now: Feedback) -> None:
        """Count read-backs in a row, each a poll after the one before, in which those that answer stand."""
        fresh = now.age_cycles == 0.0
        if before is None or not fresh.any():
            self._still = 0
        elif now.t_s - before.t_s >= 0.5 * self._poll_s:
            moved = np.max(np.abs(now.position_mm - before.position_mm)[fresh])
            resting = AxisState.STOPPING not in now.states and moved <= STANDSTILL_MM
            self._still = self._still + 1 if resting else 0

    def _at_rest(self) -> bool:
        return self._still >= END_POLLS and (self._applied is not Reaction.SBT or self._bus.braked)

    async def _lead(self, move: QueuedMove, feedback: Feedback) -> None:
        """One command towards what operator and override ask for; the next read-back shows its effect."""
        wanted = not move.held and self._share > 0.0
        if move.phase is Phase.RUNNING:
            if not wanted or self._share != self._told_share:
                move.phase = Phase.HOLDING
                await self._tell("hold")
        elif wanted and AxisState.STOPPING not in feedback.states and not move.ended(feedback):
            verb = "run" if move.phase is Phase.LOADED else "resume"
            move.phase = Phase.RUNNING
            await self._tell(verb)
            move.playback.rate = self._told_share

    async def _tell(self, verb: str) -> None:
        self._still = 0
        self._slowing = verb in ("hold", "stop", "quick-stop")
        try:
            if not self._slowing and self._share != self._told_share:
                share = self._share
                await self._bus.override(share)
                self._told_share = share
            await self._bus.command(verb)
        except DockingError as error:
            self._deaf = True
            self._raise(_trigger_of(error), error)
        if self._slowing:
            self._note_command()

    # monitors and reactions --------------------------------------------------------------------------------------
    def _judge(self, feedback: Feedback) -> None:
        """Put the monitors' finding to the arbiter. In a quick stop the controllers switch off by themselves."""
        may_stop = self._may_stop(feedback)
        if self._deaf or self.arbiter.mode is Mode.OFF or self._applied >= Reaction.FAST_PPS:
            return
        move = self._move
        if move is None:
            finding = self._watch.evaluate(feedback, self._commanded, 0.0, moving=False, may_stop=may_stop)
        else:
            # Controllers are read in different scans: each axis belongs to the path time that its own one shows.
            at_s = feedback.path_time_s if feedback.path_times_s is None else feedback.path_times_s
            chord, slope = move.playback.chord_at(at_s), move.playback.slope_at(at_s)
            speed = move.playback.rate * slope
            finding = self._watch.evaluate(feedback, chord, speed, moving=True, may_stop=may_stop)
            finding = finding or self._watch.parted(feedback, slope)
        if finding is not None:
            self._raise(finding.trigger, finding.error)

    def _may_stop(self, feedback: Feedback) -> bool:
        """Whether an axis may be ramping down now: after a hold or a stop, and for one poll without.

        A controller that faults takes the others along over the common lines; the next poll tells which it was.
        """
        unasked = AxisState.STOPPING in feedback.states and not self._slowing
        self._unasked = self._unasked + 1 if unasked else 0
        return self._move is not None and self._unasked <= 1

    def _raise(self, trigger: Trigger, error: DockingError) -> None:
        now_s = asyncio.get_running_loop().time()
        self.arbiter.raise_(Finding(trigger, error), now_s)
        self._note_finding(now_s)

    def _note_finding(self, now_s: float) -> None:
        if self._move is not None:
            self._move.clock.follow(self.arbiter.latched, self.arbiter.reaction, now_s)

    def _note_command(self) -> None:
        """All controllers that can be reached have the command by now."""
        if self._move is not None:
            self._move.clock.commanded(asyncio.get_running_loop().time())

    def _allowed_s(self, reaction: Reaction) -> float:
        """How long a reaction that begins now may take."""
        ramp_s = self._bus.ramp_s if reaction is Reaction.PPS else self._bus.quick_ramp_s
        return BRAKE_S if reaction is Reaction.SBT else ramp_s + TOLD_S + (END_POLLS + 1) * self._poll_s

    async def _react(self) -> None:
        """Begin the reaction in force, unless it has begun. A failed command may raise it once more."""
        while self.arbiter.reaction > self._applied:
            begun, self._applied = self._applied, self.arbiter.reaction
            if self._applied is Reaction.HW:
                self._bus.go_silent()
                self._note_command()
                self._finish("fault")
            elif self._applied >= Reaction.FAST_PPS > begun:
                await self._tell("quick-stop")
            elif self._applied is Reaction.PPS:
                await self._tell("stop")

    def _end_stop(self) -> None:
        """The axes have come to rest after a stop: end the move, if there is one."""
        move, feedback = self._move, self._feedback
        if self._applied >= Reaction.FAST_PPS or (feedback is not None and AxisState.FAULT in feedback.states):
            # The controllers have braked and taken the torque, or will: a fault of their own ends with that.
            self.arbiter.enter(Mode.OFF)
        if move is not None and feedback is not None:
            move.clock.rested(asyncio.get_running_loop().time())
            self._finish("fault" if self.arbiter.latched else "done" if move.ended(feedback) else "stopped")
        if not self.arbiter.latched:
            self._applied = self.arbiter.reaction

    def _finish(self, outcome: str) -> None:
        move, self._move = self._move, None
        if move is None:
            return
        path_time_s = self._feedback.path_time_s if self._feedback is not None else float("nan")
        if path_time_s >= 0.0:
            self._commanded = readonly(move.playback.chord_at(path_time_s))
        cause = self.arbiter.first.error if self.arbiter.first is not None else None
        if self.arbiter.mode is Mode.MOVING:
            self.arbiter.enter(Mode.STANDING)
        if not move.done.done():
            ended = move.result(outcome, path_time_s, self._commanded, cause)
            move.done.set_result(replace(ended, reaction=self.arbiter.in_force, also=self.arbiter.also))


def _trigger_of(error: DockingError) -> Trigger:
    """What a failed exchange with one controller means."""
    if isinstance(error, LinkLost):
        return Trigger.HEARTBEAT_LOST
    silent = isinstance(error, DeviceSilent | BadReply | OutcomeUnknown)
    return Trigger.FEEDBACK_MISSING if silent else Trigger.DRIVE_FAULT


def _defect(error: Exception) -> Defect:
    """An error of the program itself, as the cause that is kept."""
    defect = Defect("motion", f"{type(error).__name__}: {error}")
    defect.__cause__ = error
    return defect
