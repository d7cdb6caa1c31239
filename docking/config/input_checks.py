"""Cross checks of the inputs of a cell: modules, channels, names, axes."""

from __future__ import annotations

from docking.config.cell import CanBus, CellFile
from docking.config.document import duplicates
from docking.config.findings import Finding, error, warning
from docking.config.inputs import CanModule, DigitalInput, InputsConfig, ModbusModule, TemperatureInput

HOST_NODE = 127
"""Node id of the controller's own heartbeat."""
FAIL_SAFE = {"permissive": "high", "enabling-device": "high", "emergency-stop": "low", "protective-stop": "low"}
"""Levels at which a broken wire reads as the safe answer."""
OF_AN_AXIS = ("limit-switch", "brake-closed")


def input_findings(cell: CellFile) -> list[Finding]:
    """All findings about `[inputs]`, errors and warnings."""
    inputs = cell.inputs
    if inputs is None:
        return []
    names = [(f"inputs.modules[{i}].name", m.name) for i, m in enumerate(inputs.modules)]
    cells = [(f"inputs.forces[{i}].name", f.name) for i, f in enumerate(inputs.forces)]
    contacts = [(f"inputs.digital[{i}].name", d.name) for i, d in enumerate(inputs.digital)]
    sensors = [(f"inputs.temperatures[{i}].name", t.name) for i, t in enumerate(inputs.temperatures)]
    parts = [(f"inputs.temperatures[{i}].of", t.of) for i, t in enumerate(inputs.temperatures)]
    findings = duplicates(names, "name") + duplicates(contacts + sensors + cells, "name") + duplicates(parts, "part")
    findings += _modules(cell, inputs) + _channels(inputs) + _forces(cell, inputs)
    for i, item in enumerate(inputs.digital):
        findings += _contact(cell, f"inputs.digital[{i}]", item)
    return findings


def _modules(cell: CellFile, inputs: InputsConfig) -> list[Finding]:
    taken = {axis.node: f"axis {p.name}.{axis.name}" for p in cell.positioners for axis in p.axes if axis.node}
    taken[HOST_NODE] = "the controller"
    positioners = {p.name for p in cell.positioners}
    findings = []
    for i, module in enumerate(inputs.modules):
        key = f"inputs.modules[{i}]"
        if isinstance(module, ModbusModule) and module.name in positioners:
            findings.append(error(f"{key}.name", f"{module.name!r} is a positioner: its address would be taken for it"))
        if isinstance(module, CanModule):
            if not isinstance(cell.bus, CanBus):
                findings.append(error(f"{key}.kind", f"'cia401' needs a CANopen bus, bus.kind is {cell.bus.kind!r}"))
            if module.node in taken:
                findings.append(error(f"{key}.node", f"{module.node} belongs to {taken[module.node]}"))
            taken[module.node] = f"module {module.name}"
    return findings


def _channels(inputs: InputsConfig) -> list[Finding]:
    known = {module.name for module in inputs.modules}
    groups: tuple[tuple[str, tuple[DigitalInput | TemperatureInput, ...]], ...] = (
        ("digital", inputs.digital),
        ("temperatures", inputs.temperatures),
    )
    findings: list[Finding] = []
    for group, items in groups:
        where = [(f"inputs.{group}[{i}]", item) for i, item in enumerate(items)]
        findings += [
            error(f"{key}.module", f"{item.module!r} is not a module ({', '.join(sorted(known))})")
            for key, item in where
            if item.module not in known
        ]
        findings += duplicates(((f"{key}.channel", (item.module, item.channel)) for key, item in where), "channel")
    return findings


def _forces(cell: CellFile, inputs: InputsConfig) -> list[Finding]:
    """Load cells have modules of their own, sit under a ball that has one, and share no wire."""
    known = {module.name for module in inputs.modules}
    fitted = {p.name for p in cell.positioners if p.load_cell and cell.load_cells is not None}
    others = {item.module for item in inputs.digital} | {sensor.module for sensor in inputs.temperatures}
    where = [(f"inputs.forces[{i}]", force) for i, force in enumerate(inputs.forces)]
    findings = duplicates(((f"{key}.positioner", force.positioner) for key, force in where), "positioner")
    wires = [(f"{key}.channels", (force.module, channel)) for key, force in where for channel in force.channels]
    findings += duplicates(iter(wires), "channel")
    for key, force in where:
        if force.module not in known:
            findings.append(error(f"{key}.module", f"{force.module!r} is not a module ({', '.join(sorted(known))})"))
        if force.module in others:
            findings.append(
                error(f"{key}.module", f"{force.module!r} has other inputs: load cells need their own module")
            )
        if force.positioner not in fitted:
            text = f"{force.positioner!r} is no positioner with load_cell = true, in a cell with load_cells"
            findings.append(error(f"{key}.positioner", text))
    return findings


def _contact(cell: CellFile, key: str, item: DigitalInput) -> list[Finding]:
    findings = []
    offered = item.name in cell.permissives
    if item.use == "permissive" and not offered:
        findings.append(error(f"{key}.name", f"{item.name!r} is not in permissives of the cell"))
    if item.use != "permissive" and offered:
        findings.append(error(f"{key}.use", f"{item.name!r} is in permissives of the cell: its use is 'permissive'"))
    if item.use in OF_AN_AXIS and item.axis not in cell.axis_names:
        findings.append(error(f"{key}.axis", f"{item.axis!r} is not an axis of this cell; '{item.use}' needs one"))
    if item.use not in OF_AN_AXIS and item.axis is not None:
        findings.append(error(f"{key}.axis", f"'{item.use}' belongs to no axis"))
    if item.on != FAIL_SAFE.get(item.use, item.on):
        text = (
            f"{item.on!r}: a broken wire would not read as the safe answer; '{item.use}' is better wired to the other"
        )
        findings.append(warning(f"{key}.on", text))
    return findings
