"""What is asked of a run: files, wires, where journal and report go. All of it is checked before anything begins."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from docking.config import CellFile, JobFile
from docking.config.inputs import ModbusModule
from docking.config.load import default_job_path, load_cell, load_job
from docking.errors import BadArgument, FileUnreadable, FileUnwritable
from docking.transcript import Transcript

LOOPBACK = ("127.0.0.1", "::1", "localhost")
Say = Callable[[str], None]


@dataclass(frozen=True)
class RunRequest:
    """What one run is asked to do: files, seed of the simulation, where report and journal go, language, what is to
    happen to the simulated devices."""

    cell_path: Path
    job_path: Path | None
    seed: int
    report: Path | None
    journal: Path | None
    language: str
    scenario: Path | None = None
    transcript: Path | None = None


@dataclass(frozen=True)
class WireChoice:
    """Which wires: simulated ones (`sim`), at the addresses in `wires` or started for this run."""

    sim: bool
    wires: Path | None


@dataclass(frozen=True)
class Files:
    """The loaded files of a run."""

    cell: CellFile
    job: JobFile
    job_path: Path


def load_files(request: RunRequest) -> Files:
    """Load and check both files; raises ConfigError with all problems."""
    cell = load_cell(request.cell_path)
    job_path = request.job_path or default_job_path(request.cell_path)
    return Files(cell, load_job(job_path, cell), job_path)


def journal_path(request: RunRequest, stack: ExitStack) -> Path:
    """Where the journal of this run goes: as asked, beside the report, or into a folder that ends with the run.

    Raises FileUnwritable before anything moves where journal or report cannot be written.
    """
    if request.report is not None:
        prepare(request.report)
    if request.journal is not None:
        return _fresh(request.journal)
    if request.report is not None:
        return _fresh(request.report.with_suffix(".journal.jsonl"))
    return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="docking-"))) / "journal.jsonl"


def _fresh(path: Path) -> Path:
    """One journal a run: an earlier one is kept beside it under the next free number."""
    prepare(path)
    if path.exists():
        n = 1
        while (kept := path.with_name(f"{path.stem}.{n}{path.suffix}")).exists():
            n += 1
        with writing(path):
            path.rename(kept)
    return path


def prepare(path: Path) -> None:
    """Make the folder of a file that is to be written, and find out whether it can be."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not os.access(path.parent, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


@contextmanager
def writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise FileUnwritable(str(path), (error.strerror or str(error)).lower()) from error


def _refuse_real_devices(path: Path, found: dict[str, Any]) -> None:
    """Simulated devices live on this machine: on a pty, a local socket, the loopback interface. Nothing else is moved
    without a person."""
    listed = found.get("modbus")
    hosts = [str(at[0]) for at in listed.values() if at] if isinstance(listed, dict) else []
    far = [host for host in hosts if host not in LOOPBACK]
    ports = [str(found.get(name, "")) for name in ("tracker", "line", "camera", "inertial")]
    far += [port for port in ports if port and not port.startswith("/dev/pts/")]
    singles = found.get("singles", {})
    paths = [str(path) for path in singles.values()] if isinstance(singles, dict) else [str(singles)]
    far += [path for path in paths if not path.startswith("/dev/pts/")]
    far += [path for path in _bus_paths(found) if path and not Path(path).is_socket()]
    if far:
        raise BadArgument("--wires", f"{far[0]} is no simulated device of this machine", value=str(path))


def _has_buses(cell: CellFile, found: dict[str, Any]) -> bool:
    """The line of a cell on RTU; a socket for the one CAN bus of the cell, or one for each of several."""
    if cell.bus.kind == "modbus-rtu":
        return isinstance(found.get("line"), str)
    can, channels = found.get("can"), getattr(cell.bus, "channels", ())
    if len(channels) > 1:
        return isinstance(can, dict) and set(can) == set(channels)
    return isinstance(can, str)


def _bus_paths(found: dict[str, Any]) -> list[str]:
    """The sockets of the CAN buses."""
    can = found.get("can", "")
    return [str(path) for path in can.values()] if isinstance(can, dict) else [str(can)]


def opened(path: Path | None) -> Transcript | None:
    """A fresh transcript in `path` on the time of the running loop. Raises FileUnwritable."""
    if path is None:
        return None
    prepare(path)
    with writing(path):
        path.unlink(missing_ok=True)
    return Transcript(path, asyncio.get_running_loop().time)


def read_wires(path: Path, cell: CellFile) -> dict[str, Any]:
    """The addresses that `docking sim` wrote. Raises FileUnreadable, BadArgument when they are not this cell's."""
    try:
        found = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise FileUnreadable(str(path), (error.strerror or str(error)).lower()) from error
    except ValueError as error:
        raise FileUnreadable(str(path), f"not JSON: {error}") from error
    if not isinstance(found, dict) or found.get("cell") != cell.name:
        raise BadArgument("--wires", f"the file is not for cell {cell.name}", value=str(path))
    modules = cell.inputs.modules if cell.inputs is not None else ()
    expected = {module.name for module in modules if isinstance(module, ModbusModule)}
    queued = cell.bus.kind == "modbus-tcp"
    expected |= {p.name for p in cell.positioners} if queued else set()
    listed = found.get("modbus", {})
    whole = isinstance(listed, dict) and set(listed) == expected and (queued or _has_buses(cell, found))
    _refuse_real_devices(path, found)
    serial = ["tracker"]
    serial += ["camera"] if cell.camera is not None or cell.stereo is not None else []
    serial += ["inertial"] if cell.inertial is not None else []
    if not (whole and all(isinstance(found.get(name), str) for name in serial)):
        cause = "the file lacks addresses of this cell; let `docking sim` write it"
        raise BadArgument("--wires", cause, value=str(path))
    return found
