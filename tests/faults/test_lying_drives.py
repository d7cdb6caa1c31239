"""CAN bring-up: for every object that is read back, one drive answers something else; the start is refused by name.

The list is not written down here: it is what the controller is seen to read on the bus while it brings up a cell.
"""

from __future__ import annotations

import struct

import pytest

from docking.config.cell import CellFile
from docking.errors import LinkError
from drivers.maps.objects import load_object_map
from sim.virtual_time import run_virtual
from tests.support.can_bench import Bench, can_cell

Address = tuple[int, int]
LIARS = {"position": "A.Y", "passive": "D.X", "force": "D.Z"}
"""An axis that holds a position, one that follows without power, one that holds a force."""

TOLD_ONLY = {(0x1008, 0), (0x100A, 0)}
"""Names for the report: nothing can be expected of them."""
STARTING_VALUES = {(0x6041, 0), (0x6064, 0)}
"""Where the axis stands now; the first read-back frame replaces them."""


def station_of(kind: str) -> CellFile:
    """The positioner with this liar alone: three nodes."""
    cell = can_cell("follower-force-can")
    return cell.model_copy(update={"positioners": tuple(p for p in cell.positioners if p.name == LIARS[kind][0])})


def reads_of(trace: list[tuple[int, bytes]], node: int) -> list[Address]:
    """Objects that the controller has asked this node for, in order, once each."""
    asked = [struct.unpack_from("<HB", data, 1) for cob, data in trace if cob == 0x600 + node and data[0] == 0x40]
    return list(dict.fromkeys((index, sub) for index, sub in asked))


def seen_reads() -> dict[str, dict[Address, int]]:
    """What is read of each liar during an undisturbed bring-up, and what it holds in the end."""
    found: dict[str, dict[Address, int]] = {}

    async def main() -> None:
        for kind, axis in LIARS.items():
            bench = Bench(station_of(kind))
            bench.watch()
            await bench.master.bring_up()
            node = bench.drives.nodes[bench.cell.axis_names.index(axis)]
            addresses = [a for a in reads_of(bench.trace, node.number) if a not in TOLD_ONLY | STARTING_VALUES]
            found[kind] = {address: node.number_of(*address) for address in addresses}
            bench.drives.close()

    run_virtual(main)
    return found


READS = seen_reads()


def bits(kind: str, address: Address) -> list[int]:
    """The bits to turn round: the lowest, and where others decide, those."""
    index, sub = address
    if index == 0x6502:
        return [9 if kind == "force" else 7]
    cob_id = 0x1400 <= index < 0x1C00 and not index & 0x200 and sub == 1
    return [0, 31] if cob_id or address in ((0x1005, 0), (0x1014, 0), (0x1016, 1)) else [0]


CASES = [(kind, address, bit) for kind, held in READS.items() for address in held for bit in bits(kind, address)]


def marks(kind: str, address: Address, bit: int) -> list[pytest.MarkDecorator]:
    """What several kinds of axes read is tried on the first of them, the rest in the full set."""
    first = next(name for name, held in READS.items() if address in held)
    return [] if first == kind else [pytest.mark.full]


@pytest.mark.parametrize(
    ("kind", "address", "bit"),
    [
        pytest.param(*case, id=f"{case[0]}-{case[1][0]:04X}-{case[1][1]}-{case[2]}", marks=marks(*case))
        for case in CASES
    ],
)
def test_a_drive_that_lies_about_one_object_is_refused_by_name(kind: str, address: Address, bit: int) -> None:
    async def main() -> None:
        bench = Bench(station_of(kind))
        index, sub = address
        bench.drives.faults.lie(LIARS[kind], index, READS[kind][address] ^ 1 << bit, sub)
        with pytest.raises(LinkError) as caught:
            await bench.master.bring_up()
        assert caught.value.where == LIARS[kind]
        assert f"{index:04X}h" in f"{caught.value.cause} {caught.value.value}"
        bench.drives.close()

    run_virtual(main)


def test_everything_that_is_written_is_read_back() -> None:
    """Nothing that the object map writes or that the PDOs rest on is missing from the list above."""
    omap = load_object_map("cia402")
    for kind in ("position", "force"):
        written = [omap.objects[name] for name, _ in omap.written]
        proved = [omap.objects[name] for name in (*omap.proved, "mode", "mode_display", "supported_modes")]
        if kind == "force":
            written += [omap.objects[name] for name, _ in omap.force_mode.written]
        wanted = {(entry.index, entry.sub) for entry in written + proved}
        wanted |= {(0x1018, sub) for sub in range(1, 5)} | {(0x6091, 1), (0x6092, 1), (0x608F, 1)}
        wanted |= {(communication, 1) for communication, _ in omap.pdos_off}
        set_points = "force_set_points" if kind == "force" else "set_points"
        for name in (set_points, "read_back", "force"):
            pdo = omap.pdos[name]
            wanted |= {(pdo.communication, 1), (pdo.communication, 2), (pdo.mapping, 0)}
            wanted |= {(pdo.mapping, number) for number in range(1, len(pdo.words) + 1)}
        assert wanted <= set(READS[kind])
