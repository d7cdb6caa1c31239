"""`docking home`: the drives of free positioners find their zeros, a whole group at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from docking.assemble.looking import Ends, LookRequest, load_looked_at, wires_of
from docking.assemble.motion_side import input_modules
from docking.assemble.real_time import on_interrupt, run_real
from docking.config import CellFile
from docking.config.cell import CanBus, HomingConfig
from docking.config.inputs import InputsConfig, Use
from docking.errors import BadArgument, ConfigInvalid, DockingError, HomingRefused
from drivers.canopen.homing import method_of
from drivers.canopen.positioners import CanopenPositioners
from drivers.canopen.shared import SharedCan
from drivers.inputs import WiredInputs

STOPS: tuple[Use, ...] = ("emergency-stop", "protective-stop")


@dataclass(frozen=True)
class HomeRequest:
    """Which positioners of a cell are homed, all when empty; `free`: somebody has said that nothing rests on them."""

    look: LookRequest
    positioners: tuple[str, ...] = ()
    free: bool = False


def home_axes(request: HomeRequest) -> dict[str, Any]:
    """Bring the positioners up, home the group, release them; what was done, as plain data.

    Raises ConfigError; HomingRefused where a positioner has no load cell and nobody has said that it is free, or where
    a stop is pressed; else as `CanopenPositioners.home`.
    """
    cell = load_looked_at(request.look)
    homing, group = _group(cell, request)

    async def main() -> dict[str, Any]:
        async with wires_of(request.look, cell) as ends:
            return await _home(cell, homing, group, ends)

    return run_real(main)


def _group(cell: CellFile, request: HomeRequest) -> tuple[HomingConfig, tuple[str, ...]]:
    """How, and which axes. Raises as `home_axes`."""
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
    return cell.homing, tuple(f"{p.name}.{axis.name}" for p in chosen for axis in p.axes if axis.driven)


async def _home(cell: CellFile, homing: HomingConfig, group: tuple[str, ...], ends: Ends) -> dict[str, Any]:
    if ends.bus.can is None:
        raise BadArgument("home", "a CAN bus", value=cell.bus.kind)
    shared = SharedCan(ends.bus.can)
    positioners = CanopenPositioners(cell, shared.end())
    inputs = None
    if cell.inputs is not None:
        inputs = WiredInputs(cell.inputs, input_modules(cell.inputs, shared, ends.bus.modbus, ends.tap))
    asked: list[str] = []
    on_interrupt(lambda: asked.append("Somebody interrupted it."))
    try:
        await positioners.bring_up()
        if inputs is not None:
            await inputs.bring_up()
        stop = _stops(asked, inputs, cell.inputs)
        if reason := stop():
            raise HomingRefused(cell.name, reason, value="stop", limit="no stop")
        before = positioners.latest().position_mm.tolist()
        await positioners.home(group, stop)
        after = positioners.latest().position_mm.tolist()
    finally:
        if inputs is not None:
            await inputs.close()
        await _release(positioners)
    axes = {f"{p.name}.{axis.name}": axis for p in cell.positioners for axis in p.axes}
    rows = [
        {"axis": name, "method": method_of(axes[name], homing), "before_mm": a, "after_mm": b}
        for name, a, b in zip(cell.axis_names, before, after, strict=True)
        if name in group
    ]
    return {"cell": cell.name, "homed": rows, "not_homed": sorted(positioners.unhomed)}


async def _release(positioners: CanopenPositioners) -> None:
    """What a failed homing says matters more than what closing adds to it."""
    try:
        await positioners.close()
    except DockingError:
        if not positioners.unhomed:
            raise


def _stops(asked: list[str], inputs: WiredInputs | None, config: InputsConfig | None) -> Callable[[], str | None]:
    """Why the group is to halt: a person, or a stop that is wired; a silent module counts as pressed."""
    names = [name for use in STOPS for name in (config.names(use) if config is not None else ())]

    def reason() -> str | None:
        if asked:
            return asked[0]
        given = inputs.latest().given if inputs is not None else {}
        pressed = [name for name in names if given.get(name) is not False]
        return f"{pressed[0]} is pressed, or silent." if pressed else None

    return reason


def home_text(report: dict[str, Any]) -> str:
    """The same for people."""
    lines = [f"{'axis':<8}{'method':>8}{'before mm':>14}{'after mm':>14}"]
    lines += [
        f"{row['axis']:<8}{row['method']:>8}{row['before_mm']:>14.3f}{row['after_mm']:>14.3f}"
        for row in report["homed"]
    ]
    left = ", ".join(report["not_homed"])
    lines.append(f"still not homed: {left}" if left else "every axis knows its zero")
    return "\n".join(lines)
