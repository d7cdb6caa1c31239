"""Checks that need no geometry: names, references, order. They run on the plain document, so that a file that fails
its model still has these problems named in the same report; what is missing or of the wrong type is passed over."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from itertools import pairwise
from typing import Any

from docking.config.base import LARGEST
from docking.config.findings import Finding, error, warning

Document = Mapping[str, Any]
Entry = tuple[str, Any]


def entries(doc: Any, path: str, prefix: str = "") -> Iterator[Entry]:
    """All (key path, value) that `path` names, `[]` standing for every item: `positioners[].axes[].node`."""
    head, _, rest = path.partition(".")
    key = head.removesuffix("[]")
    if not isinstance(doc, Mapping) or key not in doc or doc[key] is None:
        return
    place, value = f"{prefix}{key}", doc[key]
    found = [(place, value)]
    if head.endswith("[]"):
        found = [(f"{place}[{i}]", v) for i, v in enumerate(value)] if isinstance(value, list | tuple) else []
    for where, item in found:
        if rest:
            yield from entries(item, rest, f"{where}.")
        else:
            yield where, item


def numbers(doc: Any, path: str) -> list[tuple[str, float]]:
    """The finite numbers among `entries`."""
    return [(k, float(v)) for k, v in entries(doc, path) if _is_number(v)]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def duplicates(found: Iterable[Entry], what: str) -> list[Finding]:
    """An error for every value that an earlier entry already has."""
    first: dict[Any, str] = {}
    findings = []
    for key, value in found:
        if not isinstance(value, str | int | tuple):
            continue
        if value in first:
            findings.append(error(key, f"{_plain(value)} is a duplicate: {first[value]} has the same {what}"))
        else:
            first[value] = key
    return findings


def _plain(value: Any) -> str:
    return ":".join(str(v) for v in value) if isinstance(value, tuple) else repr(value)


def cell_document_findings(doc: Document) -> list[Finding]:
    """Duplicates, missing addresses and limits out of order in a CELL document."""
    return [
        *duplicates(entries(doc, "positioners[].name"), "name"),
        *duplicates(entries(doc, "tracker.ers[].name"), "name"),
        *duplicates(entries(doc, "permissives[]"), "name"),
        *_axes(doc),
        *_addresses(doc),
        *_limits(doc),
        *_load_cells(doc),
        *_single_axes(doc),
    ]


def _axes(doc: Document) -> list[Finding]:
    findings = []
    for key, axes in entries(doc, "positioners[].axes"):
        names = [name for _, name in entries({"axes": axes}, "axes[].name")]
        if len(names) == 3 and sorted(map(str, names)) != ["X", "Y", "Z"]:
            findings.append(error(key, f"the names are {', '.join(map(str, names))}; X, Y and Z are needed, each once"))
    margins = [margin for _, margin in numbers(doc, "limits.stroke_margin_mm")] or [0.0]
    for key, stroke in entries(doc, "positioners[].axes[].stroke_mm"):
        findings += _stroke(key, stroke, margins[0])
    for key, axis in entries(doc, "positioners[].axes[]"):
        findings += _in_order(axis, "a_mm_s2", "a_quick_mm_s2", f"{key}.")
    return findings


def _stroke(key: str, stroke: Any, margin_mm: float) -> list[Finding]:
    if not isinstance(stroke, list | tuple) or len(stroke) != 2 or not all(_is_number(v) for v in stroke):
        return []
    low, high = stroke
    if not high > low:
        return [error(key, f"[{low:g}, {high:g}]: the first value must be below the second")]
    if not high - low > 2.0 * margin_mm:
        return [error(key, f"{high - low:g} mm of stroke leave nothing inside limits.stroke_margin_mm = {margin_mm:g}")]
    return []


def _addresses(doc: Document) -> list[Finding]:
    kind = next((value for _, value in entries(doc, "bus.kind")), None)
    if kind == "canopen":
        missing = [
            error(f"{key}.node", f"missing: axis {axis.get('name', '')} needs its CANopen node id")
            for key, axis in entries(doc, "positioners[].axes[]")
            if isinstance(axis, Mapping) and axis.get("node") is None
        ]
        twice = duplicates(entries(doc, "positioners[].axes[].node"), "node id")
        return missing + twice + _can_channels(doc) + _can_timing(doc)
    if kind == "modbus-tcp":
        found = [(key, p) for key, p in entries(doc, "positioners[]") if isinstance(p, Mapping)]
        missing = [
            error(f"{key}.{part}", f"missing: positioner {p.get('name', '')} needs host, port and unit")
            for key, p in found
            for part in ("host", "port", "unit")
            if p.get(part) is None
        ]
        complete = [(key, tuple(p.get(part) for part in ("host", "port", "unit"))) for key, p in found]
        return missing + duplicates(((k, a) for k, a in complete if None not in a and _hashable(a)), "address")
    if kind == "modbus-rtu":
        found = [(key, p) for key, p in entries(doc, "positioners[]") if isinstance(p, Mapping)]
        missing = [error(f"{key}.unit", "missing: its unit on the line") for key, p in found if p.get("unit") is None]
        return missing + duplicates(entries(doc, "positioners[].unit"), "unit")
    return []


def _single_axes(doc: Document) -> list[Finding]:
    """Axes that carry nothing together: names and units of their own, and never the wire of the positioners."""
    found = [(key, one) for key, one in entries(doc, "single_axes[]") if isinstance(one, Mapping)]
    names = [*entries(doc, "positioners[].name"), *((f"{key}.name", one.get("name")) for key, one in found)]
    units = [(key, (str(one.get("line")), str(one.get("unit")))) for key, one in found]
    taken = [value for _, value in entries(doc, "bus.line")]
    shared = [
        error(f"{key}.line", f"{one['line']!r} is the line of the positioners, which has no time for others")
        for key, one in found
        if one.get("line") in taken
    ]
    return duplicates(names, "name") + duplicates(units, "line and unit") + shared if found else []


def _hashable(address: tuple[Any, ...]) -> bool:
    return all(isinstance(part, str | int) for part in address)


def _channels_of_axes(doc: Document) -> list[tuple[str, str]]:
    """(key of its positioner, CAN channel) of every axis."""
    first = next((value for _, value in entries(doc, "bus.channel")), None)
    return [
        (key, str(station.get("can_channel") or first))
        for key, station in entries(doc, "positioners[]")
        if isinstance(station, Mapping)
        for _ in entries(station, "axes[]")
    ]


def _can_channels(doc: Document) -> list[Finding]:
    """Every channel once, every positioner on one of them, none without a positioner."""
    named = [*entries(doc, "bus.channel"), *entries(doc, "bus.further_channels[]")]
    known = [value for _, value in named]
    used = {channel for _, channel in _channels_of_axes(doc)}
    wrong = [
        error(key, f"{value!r} is none of the buses: {', '.join(map(str, known))}")
        for path in ("positioners[].can_channel", "inputs.modules[].can_channel")
        for key, value in entries(doc, path)
        if value is not None and value not in known
    ]
    idle = [error(key, f"no positioner is on {value!r}") for key, value in named if value not in used]
    return duplicates(iter(named), "CAN channel") + wrong + (idle if not wrong else [])


def _can_timing(doc: Document) -> list[Finding]:
    """Worst-case frame bits of one cycle (SYNC, 7-byte RPDO and 8-byte TPDO an axis) against the cycle time."""
    rates, cycles = numbers(doc, "bus.bitrate"), numbers(doc, "bus.cycle_s")
    beats, guards = numbers(doc, "bus.heartbeat_s"), numbers(doc, "bus.drive_timeout_s")
    findings = []
    if beats and guards and not guards[0][1] > beats[0][1]:
        findings.append(error(guards[0][0], f"{guards[0][1]:g} s must be over bus.heartbeat_s = {beats[0][1]:g} s"))
    if rates and cycles and rates[0][1] > 0.0 and cycles[0][1] > 0.0:
        axes = max(Counter(channel for _, channel in _channels_of_axes(doc)).values(), default=0)
        load = (55 + axes * (125 + 135)) / rates[0][1] / cycles[0][1]
        text = f"{cycles[0][1]:g} s: {axes} axes at {rates[0][1]:g} bit/s load the bus to {load:.0%}, "
        if not load <= 1.0:
            findings.append(error(cycles[0][0], text + "over 100 %"))
        elif not load <= 0.6:
            findings.append(warning(cycles[0][0], text + "over the advisable 60 %"))
    return findings


def _limits(doc: Document) -> list[Finding]:
    limits = doc.get("limits", {})
    pairs = (
        ("following_error_rest_mm", "following_error_vmax_mm"),
        ("sync_error_mm", "ball_residual_mm"),
        ("station_correction_min_mm", "station_correction_max_mm"),
    )
    return [finding for low, high in pairs for finding in _in_order(limits, low, high, "limits.")]


def _in_order(table: Any, low: str, high: str, prefix: str) -> list[Finding]:
    lows, highs = numbers(table, low), numbers(table, high)
    if not lows or not highs or lows[0][1] <= highs[0][1]:
        return []
    return [error(f"{prefix}{low}", f"{lows[0][1]:g} must not be over {prefix}{high} = {highs[0][1]:g}")]


def _load_cells(doc: Document) -> list[Finding]:
    fitted = [key for key, value in entries(doc, "positioners[].load_cell") if value is True]
    described = isinstance(doc.get("load_cells"), Mapping)
    if fitted and not described:
        return [error("load_cells", f"missing: {fitted[0]} = true needs the range of the load cells")]
    if described and not fitted:
        return [warning("load_cells", "no positioner has load_cell = true: forces are not measured")]
    return []


def job_document_findings(doc: Document) -> list[Finding]:
    """Duplicates, order of the stages and the start in a JOB document."""
    measured = ("component.targets[].name", "component.check_points[].name", "mate.targets[].name")
    return [
        *duplicates(entries(doc, "instructions[].name"), "name"),
        *duplicates(entries(doc, "instructions[].order"), "place in the order"),
        *duplicates((e for path in measured for e in entries(doc, path)), "name"),
        *duplicates(entries(doc, "component.features[].name"), "name"),
        *duplicates(entries(doc, "component.balls[].positioner"), "positioner"),
        *duplicates(entries(doc, "stages[].name"), "name"),
        *duplicates(entries(doc, "goal_locks[]"), "degree of freedom"),
        *_stage_order(doc),
        *_start(doc),
        *_in_order(doc.get("measuring", {}), "passes", "max_passes", "measuring."),
    ]


def _stage_order(doc: Document) -> list[Finding]:
    found = numbers(doc, "stages[].standoff_mm")
    findings = [
        error(key, f"{value:g} mm must be below the stage before it ({before:g} mm)")
        for (_, before), (key, value) in pairwise(found)
        if not value < before
    ]
    if found and len(found) == sum(1 for _ in entries(doc, "stages[]")) and found[-1][1] != 0.0:
        findings.append(error(found[-1][0], f"{found[-1][1]:g} mm: the last stage must dock, at 0 mm"))
    return findings


def _start(doc: Document) -> list[Finding]:
    if doc.get("start") != "empty":
        return []
    return [
        error(
            "start",
            "'empty' is refused: a docking does not begin with homing and ball entry; home free axes with `docking "
            'home`, seat the part and lock the balls with the positioners\' own controls, and use start = "seated"',
        )
    ]
