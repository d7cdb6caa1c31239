"""The wires of a cell for commands that only look: real ones, or simulated devices on real wires."""

from __future__ import annotations

import tempfile
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

from docking.assemble.requests import WireChoice, opened, read_wires
from docking.assemble.simulated import make_far_end, real_wires, truth_of
from docking.assemble.streams import stream_wires
from docking.assemble.wires import NearBus, near_bus
from docking.config import CellFile
from docking.config.load import default_job_path, load_cell, load_job
from docking.ports import SerialLink
from docking.transcript import TranscribedSerial, Transcript
from drivers.links.serial_port import SerialPort


@dataclass(frozen=True)
class LookRequest:
    """Which cell is looked at, over which wires; `seed` of simulated devices, where the transcript goes, in which
    language problems are told."""

    cell_path: Path
    wires: WireChoice
    seed: int = 1
    transcript: Path | None = None
    language: str = "en"


Notify = Callable[..., None]
"""`notify(key, **facts)`: a text of `docking.words` for the person at the machine."""


def unheard(key: str, **facts: object) -> None:
    """Where nobody listens."""


@dataclass(frozen=True)
class Ends:
    """The near ends of a cell's wires."""

    port: str
    serial: SerialLink
    bus: NearBus
    transcript: Transcript | None
    singles: Mapping[str, str] = field(default_factory=dict)
    """Where simulated single axes are, by the line in the cell file."""
    found: Mapping[str, object] = field(default_factory=dict)
    """Where simulated devices are, as `docking sim` writes it; empty for real ones."""

    @property
    def tap(self) -> Callable[[str, bool, bytes], None] | None:
        """What hears all bytes of Modbus connections."""
        return self.transcript.modbus if self.transcript is not None else None


@asynccontextmanager
async def wires_of(request: LookRequest, cell: CellFile) -> AsyncIterator[Ends]:
    """Open what is needed to look at `cell`; released at the end, simulated devices that were started here, too.

    Raises ConfigError.
    """
    async with AsyncExitStack() as stack:
        found: dict[str, object] = {}
        if request.wires.wires is not None:
            found = read_wires(request.wires.wires, cell)
        elif request.wires.sim:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="docking-")))
            job = load_job(default_job_path(request.cell_path), cell)
            far = make_far_end(cell, job, truth_of(request.cell_path), request.seed)
            stack.push_async_callback(far.close)
            found = await real_wires(cell, far, folder)
            found |= stream_wires(cell, job, request.cell_path.parent, far)
        transcript = opened(request.transcript)
        port = str(found.get("tracker", cell.tracker.port))
        serial: SerialLink = SerialPort(port, cell.tracker.baud)
        if transcript is not None:
            stack.callback(transcript.close)
            serial = TranscribedSerial(serial, transcript, "tracker")
        singles = found.get("singles")
        lines = singles if isinstance(singles, dict) else {}
        yield Ends(port, serial, near_bus(cell, found).transcribed(transcript), transcript, lines, found)


def load_looked_at(request: LookRequest) -> CellFile:
    """The cell to look at. Raises ConfigError."""
    return load_cell(request.cell_path)
