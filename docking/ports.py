"""What the cell and the motion side ask of the world, each as a small Protocol.

Drivers implement these; `docking.assemble` binds them. Every method may raise a `docking.errors.LinkError`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from docking.state import Event
from docking.types import Array, Feedback, Identity, MoveResult, Plan, Reading


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


class StreamedPositioners(Protocol):
    """Axes that take one set-point each cycle and apply all of them at one common instant (CANopen CSP + SYNC)."""

    axes: tuple[str, ...]
    cycle_s: float

    async def bring_up(self) -> tuple[Identity, ...]:
        """Prove identity and settings of every node; leave the axes disabled and reporting."""
        ...

    async def enable(self) -> Feedback:
        """Enable the driven axes, each first commanded to where it stands; return their read-back."""
        ...

    def exchange(self, setpoint_mm: Array) -> Feedback:
        """Send set-points (m,) and the common SYNC; return the newest read-back. Passive entries are ignored."""
        ...

    def quick_stop(self) -> None:
        """Tell every drive to stop by itself at once. Never waits, never raises."""
        ...

    async def close(self) -> None:
        """Disable the axes (brakes confirmed first) and release the bus."""
        ...


class QueuedPositioners(Protocol):
    """Axes whose controllers play a queue of segments after one common start (Modbus positioner PLCs)."""

    axes: tuple[str, ...]
    segment_s: float

    async def bring_up(self) -> tuple[Identity, ...]: ...

    async def enable(self) -> Feedback: ...

    async def load(self, plan: Plan) -> None:
        """Clear the queues and fill them with the start of `plan` (rows on a grid of `segment_s`). Nothing moves."""
        ...

    async def command(self, verb: str) -> None:
        """One of `run`, `hold`, `resume`, `stop`, `quick-stop`: acknowledged by all or OutcomeUnknown."""
        ...

    async def poll(self) -> Feedback:
        """Keep the queues filled and the heartbeats alive; return one read-back of all axes."""
        ...

    async def close(self) -> None: ...


class Motion(Protocol):
    """All the cell knows of motion: load a table, start it, hold, resume or stop on the path, see where it stands."""

    axes: tuple[str, ...]

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

    def request(self, verb: str) -> None:
        """`hold`, `resume` or `stop`, all on the path. Never waits; kept for the start when it comes before it."""
        ...

    def feedback(self) -> Feedback:
        """The newest read-back. Raises the fault that the motion side holds until the next `enable`."""
        ...

    async def close(self) -> None: ...


class Journal(Protocol):
    """Write-ahead record of everything that happens; `write` returns after the record is durable when `durable`."""

    def write(self, kind: str, body: dict[str, Any], *, durable: bool = False) -> None: ...

    def close(self) -> None: ...


class Operator(Protocol):
    """Who confirms. Dry-run confirms by itself; the terminal asks a person."""

    def attend(self, post: Callable[[Event], None]) -> None:
        """Begin: `post` takes the operator's hold, resume and abort at any time."""
        ...

    def show(self, plan: Plan, shown: dict[str, Any]) -> None:
        """Show the deviation that was measured and the displacement of every axis that is planned."""
        ...

    async def permissives(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Ask for the named inputs; return those that are not given."""
        ...

    async def confirm(self, plan: Plan, shown: dict[str, Any]) -> bool:
        """True = go, False = abort."""
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


CanFrame = tuple[int, bytes]
"""(11-bit identifier, up to 8 data bytes)."""


class CanLink(Protocol):
    """The one seam of a CAN bus: frames out in one batch, frames in by batches on the loop."""

    on_frames: Callable[[list[CanFrame]], None]
    on_lost: Callable[[str], None]

    async def open(self) -> None: ...

    def send(self, frames: list[CanFrame]) -> None: ...

    def close(self) -> None: ...
