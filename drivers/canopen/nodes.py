"""Which CANopen node moves which axis: the cell file seen from the bus."""

from __future__ import annotations

from dataclasses import dataclass

from docking.config.cell import AxisConfig, CanBus, CellFile
from docking.config.inputs import CanModule
from docking.config.wired_forces import as_axes_know_it
from docking.errors import ConfigInvalid


@dataclass(frozen=True)
class AxisNode:
    """One axis on the bus `channel`; `index` is its place in the cell's axis order.

    `load_cell`: its drive reports the force of one. `weighed`: there is one, at the drive or on an I/O module.
    """

    name: str
    index: int
    node: int
    axis: AxisConfig
    load_cell: bool
    channel: str = ""
    weighed: bool = False

    @property
    def driven(self) -> bool:
        """It holds a position."""
        return self.axis.driven

    @property
    def powered(self) -> bool:
        """It holds a position or a force."""
        return self.axis.powered

    @property
    def force_n(self) -> float | None:
        """The force it holds, None for an axis that holds none."""
        return self.axis.force_n

    @property
    def label(self) -> str:
        """Name and node number, for causes in errors."""
        return f"{self.name}, node {self.node}"


def can_bus_of(cell: CellFile) -> CanBus:
    """The cell's CAN bus. Raises ConfigInvalid where the cell has another kind of bus."""
    if not isinstance(cell.bus, CanBus):
        raise ConfigInvalid(cell.name, (f"bus.kind is {cell.bus.kind!r}, this driver needs 'canopen'",))
    return cell.bus


def channel_of_node(cell: CellFile) -> dict[int, str]:
    """The bus of every node, axes and I/O modules. Node numbers are unique in a cell, whichever bus they are on."""
    first = can_bus_of(cell).channel
    found = {axis.node: p.can_channel or first for p in cell.positioners for axis in p.axes if axis.node is not None}
    modules = [m for m in cell.inputs.modules if isinstance(m, CanModule)] if cell.inputs else []
    return {**found, **{module.node: module.can_channel or first for module in modules}}


def axis_nodes(cell: CellFile, host_node: int) -> tuple[AxisNode, ...]:
    """All axes in cell order. Raises ConfigInvalid for missing, repeated or reserved node numbers."""
    nodes: list[AxisNode] = []
    problems: list[str] = []
    taken = {host_node: "the controller"}
    first = can_bus_of(cell).channel
    for positioner, fitted in zip(as_axes_know_it(cell).positioners, cell.positioners, strict=True):
        for axis in positioner.axes:
            name = f"{positioner.name}.{axis.name}"
            if axis.node is None:
                problems.append(f"axis {name} has no node")
                continue
            if axis.node in taken:
                problems.append(f"axis {name}: node {axis.node} belongs to {taken[axis.node]}")
            taken[axis.node] = name
            channel = positioner.can_channel or first
            own, weighed = positioner.load_cell, fitted.load_cell
            nodes.append(AxisNode(name, len(nodes), axis.node, axis, own, channel, weighed))
    if problems:
        raise ConfigInvalid(cell.name, tuple(problems))
    return tuple(nodes)
