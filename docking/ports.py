"""What the cell and the motion side ask of the world, each as a small Protocol.

Drivers implement these; `docking.assemble` binds them. Every method may raise a `docking.errors.LinkError`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from docking.errors import DockingError, LinkError
from docking.sightings import InertialSample, PointFrame
from docking.state import Event
from docking.types import Array, Feedback, Identity, InputState, MoveResult, Plan, Reading


class Tracker(Protocol):
    """A point-by-point coordinate instrument on a serial line."""

    two_face: bool

    async def connect(self) -> Identity:
        """Open the line, prove that the device answers, return what it says of itself."""
        ...

    async def measure(self, target: str, near_T_mm: Array, face: int = 1) -> Reading:
        """Measure `target`, expected near `near_T_mm` (3,) in the station frame.

        Raises TargetLost when the instrument sees no reflector, DeviceSilent on a time-out.
        """
        ...

    async def close(self) -> None: ...


class PointStream(Protocol):
    """A camera that reports tools and single markers many times a second.

    `on_frame` gets every frame once, in order; `on_lost` is called once when the stream ends by itself.
    """

    on_frame: Callable[[PointFrame], None]
    on_lost: Callable[[LinkError], None]

    async def connect(self) -> Identity: ...

    async def start(self) -> None:
        """Begin to stream."""
        ...

    async def stop(self) -> None: ...

    async def close(self) -> None: ...


class InertialSensor(Protocol):
    """Accelerations and turning rates many times a second; as `PointStream`."""

    on_sample: Callable[[InertialSample], None]
    on_lost: Callable[[LinkError], None]

    async def connect(self) -> Identity: ...

    async def start(self) -> None: ...

    async def stop(self) -> None: ...

    async def close(self) -> None: ...


class StreamedPositioners(Protocol):
    """Axes that take one set-point each cycle and apply all of them at one common instant (CANopen CSP + SYNC).

    `a_quick_mm_s2` (m,) are the axes' quick-stop decelerations.
    """

    axes: tuple[str, ...]
    cycle_s: float
    a_quick_mm_s2: Array

    async def bring_up(self) -> tuple[Identity, ...]:
        """Prove identity and settings of every node; leave the axes disabled and reporting."""
        ...

    async def enable(self) -> Feedback:
        """Enable the driven axes, each first commanded to where it stands; return their read-back."""
        ...

    def latest(self) -> Feedback:
        """The newest read-back."""
        ...

    def send(self, setpoint_mm: Array) -> None:
        """Send set-points (m,) and the common SYNC. Passive entries are ignored."""
        ...

    async def arm_stops(self, peak_mm_s: Array, t_stop_s: float) -> None:
        """At standstill: let every drive's own quick stop take `t_stop_s` from its planned peak speed (m,)."""
        ...

    async def restore_stops(self) -> None:
        """Give every drive its full quick-stop deceleration back, as a move of a single axis needs it."""
        ...

    def quick_stop(self) -> None:
        """Tell every drive to stop by itself at once. Never waits, never raises."""
        ...

    async def brake(self) -> None:
        """At standstill: close all brakes and, where they report closed, take the torque. `send` goes on meanwhile."""
        ...

    def go_silent(self) -> None:
        """End SYNC and heartbeat for good: watchdogs and safety relay act. Never waits, never raises."""
        ...

    async def reset_faults(self) -> None:
        """On a person's order: reset drives in fault, forget what was reported. `send` goes on meanwhile."""
        ...

    async def close(self) -> None:
        """Disable the axes (brakes confirmed first) and release the bus."""
        ...


class QueuedPositioners(Protocol):
    """Axes whose controllers play a queue of segments after one common start (Modbus positioner PLCs).

    `ramp_s` and `quick_ramp_s`: how long a stop takes from full rate; `braked`: the driven axes report closed brakes.
    `on_lost` is called when the connection to a controller breaks, whether anybody waits for an answer or not.
    """

    axes: tuple[str, ...]
    segment_s: float
    ramp_s: float
    on_lost: Callable[[], None]

    @property
    def quick_ramp_s(self) -> float: ...

    @property
    def braked(self) -> bool: ...

    async def bring_up(self) -> tuple[Identity, ...]: ...

    async def enable(self) -> Feedback: ...

    async def load(self, plan: Plan) -> None:
        """Clear the queues and fill them with the start of `plan` (rows on a grid of `segment_s`); set the quick ramp
        for its speeds. Nothing moves."""
        ...

    async def command(self, verb: str) -> None:
        """One of `run`, `hold`, `resume`, `stop`, `quick-stop`, `reset`: acknowledged by all or OutcomeUnknown."""
        ...

    async def override(self, rate: float) -> None:
        """At standstill: the playback rate (over 0, to 1) from the next run or resume on."""
        ...

    async def poll(self, *, surviving: bool = False) -> Feedback:
        """Keep the queues filled and the heartbeats alive; return one read-back of all axes.

        `surviving`: controllers that do not answer are only shown as old, nothing is raised for them.
        """
        ...

    def go_silent(self) -> None:
        """End all heartbeats for good: the controllers' watchdogs act. Never waits, never raises."""
        ...

    async def close(self) -> None: ...


class Inputs(Protocol):
    """Wired inputs beside the axes: contacts, temperatures. `on_change` is called when `latest` has something new."""

    on_change: Callable[[], None]

    async def bring_up(self) -> tuple[Identity, ...]:
        """Prove every module, and wait until each has said what its inputs are."""
        ...

    def latest(self) -> InputState:
        """What they say now, debounced."""
        ...

    async def close(self) -> None: ...


class LoadCells(Protocol):
    """Load cells that are wired beside the axes. `on_fault` is called once when a cell's wire or module fails."""

    on_fault: Callable[[DockingError], None]

    async def bring_up(self) -> tuple[Identity, ...]:
        """Prove every module, and that every cell reads."""
        ...

    def latest(self) -> Array:
        """Newest forces along all axes (m,), N; NaN where no cell is, or nothing is known of it now."""
        ...

    async def close(self) -> None: ...


class Motion(Protocol):
    """All the cell knows of motion: load a table, start it, hold, resume or stop on the path, see where it stands."""

    axes: tuple[str, ...]
    speed_limit_mm_s: float
    """The fastest move that the motion side bears, known after `connect`: how late its ticks come decides it."""

    async def connect(self) -> tuple[Identity, ...]:
        """Prove every positioner: identity, settings, watchdogs."""
        ...

    async def enable(self) -> Array:
        """Enable the driven axes as one group; return the commanded positions (m,), equal to where the axes stand."""
        ...

    async def load(self, plan: Plan) -> None:
        """Take a plan; refused when it does not start where the axes are commanded (PlanStale). Nothing moves."""
        ...

    async def start(self, plan_hash: str) -> MoveResult:
        """Run the loaded plan to its end, or to standstill after a stop or a fault."""
        ...

    async def reset(self, role: str) -> None:
        """Forget the fault that is held, on a person's order; then the axes have to be enabled again. Moves nothing.
        Raises EventRefused with the reason, and what the devices answer."""
        ...

    def request(self, verb: str) -> None:
        """`hold`, `resume` or `stop`, all on the path. Never waits; kept for the start when it comes before it."""
        ...

    def override(self, percent: float) -> None:
        """Run plans at 0 to 100 % of their speed from now on, the path unchanged: only the rate of path time changes,
        with the plan's own slew. Never waits; kept over holds, resumes and from move to move until it is set anew.
        Raises BadArgument outside 0 to 100, and nothing changes."""
        ...

    def stop_for(self, error: DockingError) -> None:
        """Stop the running move on its path because of what was found outside the motion side, a LiveDeviation or a
        PoseUncertain; kept as the fault that ended it. Never waits; without effect when no move runs."""
        ...

    def feedback(self) -> Feedback:
        """The newest read-back. Raises the fault that the motion side holds until it is reset."""
        ...

    def inputs(self) -> InputState:
        """What the wired inputs say, as last heard."""
        ...

    async def close(self) -> None: ...


class Journal(Protocol):
    """Write-ahead record of everything that happens."""

    def write(self, kind: str, body: dict[str, Any]) -> None: ...

    async def sync(self) -> None:
        """Return when everything that has been written is durable; the loop goes on meanwhile."""
        ...

    def close(self) -> None: ...


class Operator(Protocol):
    """Who confirms. Dry-run confirms by itself; the terminal asks a person."""

    def attend(self, post: Callable[[Event], None], override: Callable[[float], None]) -> None:
        """Begin: `post` takes the operator's hold, resume and abort at any time, `override` the speed in percent."""
        ...

    def show(self, plan: Plan, shown: dict[str, Any]) -> None:
        """Show the deviation that was measured, where one is known, and the planned displacement of every axis."""
        ...

    async def permissives(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Ask for the named inputs; return those that are not given."""
        ...

    async def wait_for(self, name: str) -> bool:
        """The wired input `name` is not given: True to look again, False when nobody is there who could give it."""
        ...

    async def confirm(self, plan: Plan, shown: dict[str, Any]) -> Event:
        """CONFIRMED or DECLINED, or RETREAT where `shown` says that it is `retreatable`."""
        ...

    async def blocked(self, error: DockingError, *, retreatable: bool) -> Event | None:
        """The component cannot be measured: AGAIN or, where there is a way back, RETREAT. None when nobody is there
        to decide: then the error stands."""
        ...

    async def how_far(self, places: tuple[str, ...]) -> int:
        """How many moves a retreat goes back, 1 to len(places); `places` says where one, two ... moves lead."""
        ...

    async def hold_to_run(self, facts: dict[str, Any]) -> bool:
        """Whether a supervisor asks for the next relief step, now: False on anything else and when the time is up."""
        ...

    def notify(self, key: str, **facts: Any) -> None:
        """Say what is happening: a text of `docking.words` with its facts."""
        ...


T = TypeVar("T")


class Aside(Protocol):
    """Works out what takes long while the ticks go on."""

    async def __call__(self, work: Callable[[], T]) -> T: ...


async def at_once(work: Callable[[], T]) -> T:
    """The `Aside` of virtual time, which stands still while work is done."""
    return work()


ByteSink = Callable[[bytes], None]


class SerialLink(Protocol):
    """The one seam of a serial wire: bytes out, bytes in by callback on the loop.

    `on_bytes` is set by the driver before `open`. `on_lost` is called once with a reason when the port vanishes.
    """

    on_bytes: ByteSink
    on_lost: Callable[[str], None]

    async def open(self) -> None: ...

    def write(self, data: bytes) -> None: ...

    def close(self) -> None: ...


class SpeedLink(SerialLink, Protocol):
    """A serial link whose far end chooses its speed while it is open."""

    async def set_baud(self, baud: int) -> None:
        """Change the host's speed, bit/s. Raises LinkLost."""
        ...

    async def send_break(self) -> None:
        """Hold the line low for longer than a character; without effect where the link has no such thing."""
        ...


CanFrame = tuple[int, bytes]
"""(11-bit identifier, up to 8 data bytes)."""


class CanLink(Protocol):
    """The one seam of a CAN bus: frames out in one batch, frames in by batches on the loop."""

    on_frames: Callable[[list[CanFrame]], None]
    on_lost: Callable[[str], None]

    async def open(self) -> None: ...

    def send(self, frames: list[CanFrame]) -> None: ...

    def close(self) -> None: ...
