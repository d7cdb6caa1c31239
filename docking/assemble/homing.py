"""`docking home`: the drives of free positioners find their zeros, a whole group at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from docking.assemble.looking import Ends, LookRequest, Notify, load_looked_at, unheard, wires_of
from docking.assemble.motion_side import input_modules
from docking.assemble.real_time import on_interrupt, run_real
from docking.config import CellFile
from docking.config.cell import CanBus, HomingConfig
from docking.config.inputs import InputsConfig, Use
from docking.errors import BadArgument, ConfigInvalid, DockingError, HomingRefused
from docking.words import tell
from drivers.canopen.homing import method_of
from drivers.canopen.positioners import CanopenPositioners
from drivers.canopen.shared import SharedCan
from drivers.inputs import WiredInputs
from drivers.load_cells import AnalogueLoadCells
from drivers.weighed_axes import WeighedDrives

STOPS: tuple[Use, ...] = ("emergency-stop", "protective-stop")
HELD: tuple[Use, ...] = ("enabling-device",)


@dataclass(frozen=True)
class HomeRequest:
    """Which positioners of a cell are homed, all when empty; `free`: somebody has said that nothing rests on them."""

    look: LookRequest
    positioners: tuple[str, ...] = ()
    free: bool = False


@dataclass(frozen=True)
class HomingPlan:
    """What is going to happen: which axes of which positioners of the cell, and how."""

    cell: CellFile
    homing: HomingConfig
    positioners: tuple[str, ...]
    axes: tuple[str, ...]


def home_axes(request: HomeRequest, notify: Notify = unheard) -> dict[str, Any]:
    """Bring the positioners up, home the group, release them; what was done, as plain data.

    Raises as `homing_plan`; HomingRefused where a load cell shows a component, a stop is pressed or the enabling device
    is not held; else as `CanopenPositioners.home`.
    """
    plan = homing_plan(request)

    async def main() -> dict[str, Any]:
        async with wires_of(request.look, plan.cell) as ends:
            return await _home(plan, ends, notify)

    return run_real(main)


def homing_plan(request: HomeRequest) -> HomingPlan:
    """What `home_axes` would do; nothing is opened.

    Raises ConfigError; HomingRefused where a positioner has no load cell and nobody has said that it is free.
    """
    cell = load_looked_at(request.look)
    if not isinstance(cell.bus, CanBus):
        raise BadArgument("home", "positioner PLCs home their axes themselves", value=cell.bus.kind)
    if cell.homing is None:
        raise ConfigInvalid(cell.name, ("homing: missing; say how the drives find their zero",))
    known = [p.name for p in cell.positioners]
    for name in request.positioners:
        if name not in known:
            raise BadArgument("--positioner", f"one of {', '.join(known)}", value=name)
    chosen = [p for p in cell.positioners if p.name in (request.positioners or known)]
    unseen = [p.name for p in chosen if not p.load_cell]
    if unseen and not request.free:
        cause = "It has no load cell: somebody must say that nothing rests on it (--free)."
        raise HomingRefused(f"positioner {unseen[0]}", cause, value="not said", limit="free")
    axes = tuple(f"{p.name}.{axis.name}" for p in chosen for axis in p.axes if axis.driven)
    return HomingPlan(cell, cell.homing, tuple(p.name for p in chosen), axes)


async def _home(plan: HomingPlan, ends: Ends, notify: Notify) -> dict[str, Any]:
    cell = plan.cell
    if ends.bus.can is None:
        raise BadArgument("home", "a CAN bus", value=cell.bus.kind)
    positioners, inputs = _drivers(cell, ends, SharedCan(ends.bus.can))
    asked: list[str] = []
    on_interrupt(lambda: asked.append("Somebody interrupted it."))
    notify("bringing_up")
    try:
        await positioners.bring_up()
        if inputs is not None:
            await inputs.bring_up()
        stop = _stops(asked, inputs, cell.inputs)
        if reason := stop():
            raise HomingRefused(cell.name, reason, value="stop", limit="no stop")
        before = positioners.latest().position_mm.tolist()
        await positioners.home(plan.axes, _announced(stop, lambda: notify("homing", axes=", ".join(plan.axes))))
        after = positioners.latest().position_mm.tolist()
    finally:
        if inputs is not None:
            await inputs.close()
        await _release(positioners)
    axes = {f"{p.name}.{axis.name}": axis for p in cell.positioners for axis in p.axes}
    rows = [
        {"axis": name, "method": method_of(axes[name], plan.homing), "before_mm": a, "after_mm": b}
        for name, a, b in zip(cell.axis_names, before, after, strict=True)
        if name in plan.axes
    ]
    return {"cell": cell.name, "homed": rows, "not_homed": sorted(positioners.unhomed)}


def _drivers(cell: CellFile, ends: Ends, shared: SharedCan) -> tuple[CanopenPositioners, WiredInputs | None]:
    """The drives, with load cells that are wired elsewhere, and the contacts."""
    end = shared.end()
    if cell.inputs is None:
        return CanopenPositioners(cell, end), None
    modules = input_modules(cell.inputs, shared, ends.bus.modbus, ends.tap)
    weighing = {name: modules.pop(name) for name in sorted(cell.inputs.weighing)}
    drives = WeighedDrives(cell, end, AnalogueLoadCells(cell, weighing)) if weighing else CanopenPositioners(cell, end)
    return drives, WiredInputs(cell.inputs, modules)


async def _release(positioners: CanopenPositioners) -> None:
    """What a failed homing says matters more than what closing adds to it."""
    try:
        await positioners.close()
    except DockingError:
        if not positioners.unhomed:
            raise


def _stops(asked: list[str], inputs: WiredInputs | None, config: InputsConfig | None) -> Callable[[], str | None]:
    """Why the group is to halt: a person, a stop that is wired, an enabling device that is let go. A silent module
    counts as pressed and as let go."""
    stops, held = (config.names(*uses) if config is not None else () for uses in (STOPS, HELD))

    def reason() -> str | None:
        if asked:
            return asked[0]
        given = inputs.latest().given if inputs is not None else {}
        for name in stops:
            if given.get(name) is not False:
                return f"{name} is pressed, or silent."
        for name in held:
            if given.get(name) is not True:
                return f"{name} is not held, or silent."
        return None

    return reason


def _announced(stop: Callable[[], str | None], announce: Callable[[], None]) -> Callable[[], str | None]:
    """`stop`; when it is first asked the axes are about to be enabled, and that is announced."""
    said: list[bool] = []

    def reason() -> str | None:
        if not said:
            said.append(True)
            announce()
        return stop()

    return reason


def home_text(report: dict[str, Any], language: str = "en") -> str:
    """The same for people."""
    lines = [f"{'axis':<8}{'method':>8}{'before mm':>14}{'after mm':>14}"]
    lines += [
        f"{row['axis']:<8}{row['method']:>8}{row['before_mm']:>14.3f}{row['after_mm']:>14.3f}"
        for row in report["homed"]
    ]
    left = ", ".join(report["not_homed"])
    lines.append(tell(language, "not_homed", axes=left) if left else tell(language, "homed"))
    return "\n".join(lines)
