"""`docking devices`: who answers on the wires of a cell, and what is wrong with it. Nothing is enabled."""

from __future__ import annotations

import asyncio
import statistics
from dataclasses import dataclass
from datetime import date
from typing import Any

from docking.assemble.controller import tracker_of
from docking.assemble.looking import Ends, LookRequest, Notify, load_looked_at, unheard, wires_of
from docking.assemble.real_time import run_real
from docking.assemble.single import look_at_singles
from docking.assemble.streams import sensors_of
from docking.assemble.timed import TimedCan, TimedSerial
from docking.config import CellFile
from docking.config.cell import CanBus
from docking.errors import BadArgument, DockingError, LinkError, LinkLost
from docking.ports import CanLink, InertialSensor, PointStream
from docking.words import tell
from drivers.canopen.look import BusLook
from drivers.canopen.positioners import CanopenPositioners
from drivers.look import Found
from drivers.modbus_look import ModbusLook
from drivers.modbus_positioners import ModbusPositioners

STRANGER = "not in the cell"
SYNC, HOST = "SYNC", "heartbeat of a host"
"""By which another controller is known."""
PROVE_S = 1.0
"""How long the read-backs of a bus are timed."""


@dataclass(frozen=True)
class Proving:
    """What is done beside looking: `settings` of positioners are written and read back as before a docking, nothing is
    enabled; for their `watchdogs` the heartbeat of a CAN bus is withheld besides, until every drive has missed it.
    `notify` tells the person at the machine."""

    settings: bool = False
    watchdogs: bool = False
    notify: Notify = unheard

    @property
    def wanted(self) -> bool:
        return self.settings or self.watchdogs


LOOKING = Proving()


def require_watchdogs(request: LookRequest) -> None:
    """Raises BadArgument where the positioners of the cell have no watchdogs to prove, ConfigError."""
    cell = load_looked_at(request)
    if not isinstance(cell.bus, CanBus):
        cause = "a CANopen bus: PLCs are not left without their host"
        raise BadArgument("--prove-watchdogs", cause, value=cell.bus.kind)


def find_devices(request: LookRequest, proving: Proving = LOOKING) -> dict[str, Any]:
    """Everything that `docking devices` says, as plain data. Raises ConfigError, and as `require_watchdogs`."""
    cell = load_looked_at(request)
    if proving.watchdogs:
        require_watchdogs(request)

    async def main() -> dict[str, Any]:
        async with wires_of(request, cell) as ends:
            rows = [await _tracker(cell, ends)]
            sensors = sensors_of(cell, request.cell_path.parent, ends.found, ends.transcript)
            rows += [await _sensor(*sensor) for sensor in sensors]
            skew = None
            if ends.bus.can is not None:
                rows += await _bus(cell, ends.bus.can)
            look = ModbusLook(cell, ends.bus.modbus, ends.tap, ends.bus.line)
            try:
                rows += await look.find()
                if await look.controlled():
                    rows.append(Found(STRANGER, HOST, state="another controller runs these positioners"))
                skew = await look.start_skew_s()
            finally:
                look.close()
            rows += await look_at_singles(cell, ends)
            alone = not any(found.where == STRANGER and found.address in (SYNC, HOST) for found in rows)
            proof = _UNPROVED
            if proving.wanted:
                proof = await _prove(cell, ends, proving) if alone else _Proof(_occupied())
            return _report(cell, rows, skew, proof, request.language)

    return run_real(main, ticks=proving.wanted)


@dataclass(frozen=True)
class _Proof:
    """What failed in a bring-up; the spread of the read-backs of one SYNC; how soon each drive missed the heartbeat."""

    problem: DockingError | None = None
    skew_s: tuple[float, float] | None = None
    missed_s: dict[str, float] | None = None


_UNPROVED = _Proof()


def _occupied() -> DockingError:
    return LinkLost("bus", "Another controller runs the positioners: nothing was written.")


async def _tracker(cell: CellFile, ends: Ends) -> Found:
    timed = TimedSerial(ends.serial)
    tracker = tracker_of(cell, timed)
    identity, problem = None, None
    try:
        identity = await tracker.connect()
    except DockingError as error:
        problem = error
    finally:
        await tracker.close()
    settings = cell.tracker
    address = f"{ends.port} at {settings.baud} bit/s, {settings.protocol}"
    return Found("tracker", address, identity, "", "", "", tuple(timed.taken_s), problem)


async def _sensor(where: str, port: str, sensor: PointStream | InertialSensor) -> Found:
    """A sensor that streams beside the tracker, brought up as before a docking and released."""
    identity, problem = None, None
    try:
        identity = await sensor.connect()
    except DockingError as error:
        problem = error
    finally:
        await sensor.close()
    return Found(where, port, identity, problem=problem)


async def _bus(cell: CellFile, link: CanLink) -> tuple[Found, ...]:
    look = BusLook(cell, link)
    try:
        await look.open()
        found = await look.find()
    except LinkError as error:
        return (Found("bus", f"{error.value}", problem=error),)
    finally:
        look.close()
    if look.controlled:
        found = (*found, Found(STRANGER, SYNC, state="another controller runs this bus"))
    return found


async def _prove(cell: CellFile, ends: Ends, proving: Proving) -> _Proof:
    """Bring the positioners up as before a docking, enable nothing, release them."""
    positioners: CanopenPositioners | ModbusPositioners
    timed: TimedCan | None = None
    if isinstance(cell.bus, CanBus) and ends.bus.can is not None:
        nodes = [axis.node or 0 for p in cell.positioners for axis in p.axes]
        timed = TimedCan(ends.bus.can, frozenset(0x180 + node for node in nodes))
        positioners = CanopenPositioners(cell, timed)
    else:
        positioners = ModbusPositioners(cell, ends.bus.modbus, ends.tap, ends.bus.line)
    problem, missed_s = None, None
    proving.notify("bringing_up")
    try:
        await positioners.bring_up()
        await asyncio.sleep(PROVE_S if timed is not None else 0.0)
        if proving.watchdogs and isinstance(positioners, CanopenPositioners):
            proving.notify("silence")
            missed_s = await positioners.prove_watchdogs()
    except DockingError as error:
        problem = error
    try:
        await positioners.close()
    except DockingError as error:
        problem = problem or error
    if timed is None or not timed.late_s:
        return _Proof(problem, None, missed_s)
    typical = [statistics.median(late) for late in timed.late_s.values()]
    spread_s = max(statistics.pstdev(late) for late in timed.late_s.values())
    return _Proof(problem, (max(typical) - min(typical), spread_s), missed_s)


# what is told ------------------------------------------------------------------------------------------------------
def _report(
    cell: CellFile,
    rows: list[Found],
    skew_s: tuple[float, float] | None,
    proved: _Proof = _UNPROVED,
    language: str = "en",
) -> dict[str, Any]:
    proof, skew = proved.problem, skew_s or proved.skew_s
    devices = [_row(found, language) for found in rows]
    due = cell.tracker.calibration_due
    today = date.today()
    warnings = []
    if due is not None and due < today:
        warnings.append(f"the calibration of the instrument was due on {due}, {(today - due).days} days ago")
    if due is None:
        warnings.append("tracker.calibration_due is not given: nobody watches the calibration of the instrument")
    warnings += [f"{row['address']} answers and belongs to nothing in the cell file" for row in devices if row["stray"]]
    missing = [row["where"] for row in devices if row["problem"] is not None]
    return {
        "cell": cell.name,
        "ok": not missing and proof is None,
        "devices": devices,
        "missing": missing,
        "start_skew_ms": None if skew is None else 1e3 * skew[0],
        "start_skew_known_to_ms": None if skew is None else 1e3 * skew[1],
        "calibration_due": str(due) if due is not None else None,
        "watchdogs_ms": {name: 1e3 * s for name, s in proved.missed_s.items()} if proved.missed_s else None,
        "bring_up": None if proof is None else {**_problem(proof, language), "where": proof.where},
        "warnings": warnings,
    }


def _problem(error: DockingError, language: str) -> dict[str, Any]:
    return {"code": error.code, "message": error.text(language), "remedy": error.remedy(language)}


def _row(found: Found, language: str) -> dict[str, Any]:
    identity, taken = found.identity, found.round_trips_s
    problem = found.problem
    return {
        "where": found.where,
        "address": found.address,
        "answers": identity is not None,
        "stray": found.where == STRANGER,
        "vendor": identity.vendor if identity else None,
        "product": identity.product if identity else None,
        "serial": identity.serial if identity else None,
        "firmware": identity.firmware if identity else None,
        "state": found.state or None,
        "units": found.units or None,
        "watchdog": found.watchdog or None,
        "round_trip_ms": 1e3 * statistics.median(taken) if taken else None,
        "round_trip_max_ms": 1e3 * max(taken) if taken else None,
        "problem": None if problem is None else _problem(problem, language),
    }


def devices_text(report: dict[str, Any], language: str = "en") -> str:
    """The same for people: two or three lines a device, then what is wrong."""
    lines = []
    for row in report["devices"]:
        mark = "!!" if row["problem"] else "--" if row["stray"] else "ok"
        who = " ".join(filter(None, (row["vendor"], row["product"])))
        lines.append(f"{mark} {row['where']:<18} {row['address']:<28} {who}")
        trip = row["round_trip_ms"]
        facts = [f"serial {row['serial']}, firmware {row['firmware']}" if row["answers"] else "", row["state"]]
        facts += [row["units"], f"watchdog: {row['watchdog']}" if row["watchdog"] else ""]
        facts.append(f"round trip {trip:.2f} ms, at most {row['round_trip_max_ms']:.2f}" if trip is not None else "")
        lines += [f"      {fact}" for fact in facts if fact]
        if row["problem"]:
            lines.append(f"      {row['problem']['code']}: {row['problem']['message']}")
            lines.append(f"      -> {row['problem']['remedy']}")
    skew = report["start_skew_ms"]
    if skew is not None:
        lines.append(f"start skew as measured: {skew:.2f} ms, known to {report['start_skew_known_to_ms']:.2f} ms")
    if report["watchdogs_ms"]:
        took = report["watchdogs_ms"].values()
        lines.append(tell(language, "missed", first_ms=min(took), last_ms=max(took)))
    if report["calibration_due"]:
        lines.append(f"calibration of the instrument due: {report['calibration_due']}")
    if refused := report["bring_up"]:
        what, remedy = refused["message"], refused["remedy"]
        lines.append(tell(language, "bring_up_refused", code=refused["code"], error=what, remedy=remedy))
    lines += [f"warning: {text}" for text in report["warnings"]]
    refused_by = [report["bring_up"]["where"]] if report["bring_up"] else []
    names = ", ".join(dict.fromkeys((*report["missing"], *refused_by)))
    lines.append(tell(language, "all_answer") if report["ok"] else tell(language, "not_in_order", names=names))
    return "\n".join(lines)
