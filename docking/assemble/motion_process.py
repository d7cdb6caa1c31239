"""The motion process: the positioners' wires, the ticks, the monitors and the stops, and nothing else.

The cell starts it by `python -m docking.assemble.motion_process DESCRIPTOR` with one end of a socket pair, and sends an
order: which cell and job, at which addresses. It ends when the cell closes it or is gone, after the axes have stopped
on the path and are braked.
"""

from __future__ import annotations

import asyncio
import atexit
import os
import signal
import socket
import sys
from pathlib import Path
from typing import Any

from docking.assemble.motion_side import local_motion, service_settings
from docking.assemble.real_time import on_interrupt, run_real
from docking.assemble.wires import near_bus
from docking.config import CellFile
from docking.config.cell import CanBus
from docking.config.load import file_sha256, load_cell, load_job
from docking.errors import BadReply, DockingError, FileUnreadable
from docking.motion.channel import Channel, SocketChannel
from docking.motion.lateness import Lateness, measure_lateness
from docking.motion.messages import WHERE, decode, encode
from docking.motion.served import ServedMotion
from docking.transcript import Transcript

LOOKS_S = 0.002
"""Period at which lateness is measured where the bus has no cycle, and at most."""


def run_motion(cell_file: Path, job_file: Path, found: dict[str, Any], channel: Channel) -> ServedMotion:
    """Serve the axes of a cell on the running loop; `found` holds the addresses of simulated devices, and where the
    transcript goes.

    Raises ConfigError.
    """
    cell = load_cell(cell_file)
    job = load_job(job_file, cell)
    transcript = None
    if "transcript" in found:
        transcript = Transcript(Path(found["transcript"]), asyncio.get_running_loop().time)
        atexit.register(transcript.close)
    motion = local_motion(cell, job, near_bus(cell, found), transcript)
    return ServedMotion(motion, channel, service_settings(cell), lambda: _measure(cell))


async def _measure(cell: CellFile) -> Lateness:
    cycle_s = cell.bus.cycle_s if isinstance(cell.bus, CanBus) else LOOKS_S
    return await measure_lateness(min(cycle_s, LOOKS_S), cell.motion.lateness_s)


def order(cell_file: Path, job_file: Path, found: dict[str, Any]) -> bytes:
    """The message that tells a motion process what to serve: files with their hashes, and addresses."""
    files = [(str(path.resolve()), file_sha256(path)) for path in (cell_file, job_file)]
    return encode("order", 0, {"files": files, "found": found})


def _begin(message: bytes, channel: Channel) -> ServedMotion:
    kind, _, body = decode(message)
    if kind != "order":
        raise BadReply(WHERE, f"{kind} came before an order")
    for path, sha in body["files"]:
        if file_sha256(Path(path)) != sha:
            raise FileUnreadable(path, "it was changed while the program started")
    (cell_file, _), (job_file, _) = body["files"]
    return run_motion(Path(cell_file), Path(job_file), body["found"], channel)


async def _serve(end: socket.socket, first: bool) -> None:
    """Wait for the order, then serve until the cell has gone."""
    channel = await SocketChannel.open(end)
    begun: asyncio.Future[ServedMotion | None] = asyncio.get_running_loop().create_future()

    def ordered(message: bytes) -> None:
        try:
            served = _begin(message, channel)
        except DockingError as error:
            channel.send(encode("refused", 0, error))
            channel.close()
            begun.set_result(None)
            return
        on_interrupt(lambda: served.leave("It was asked to end."), (signal.SIGTERM, signal.SIGHUP))
        begun.set_result(served)

    channel.on_lost = lambda reason: begun.set_result(None)
    channel.send(encode("hello", 0, {"pid": os.getpid(), "priority": first}))
    channel.on_message = ordered
    served = await begun
    if served is not None:
        await served.ended.wait()
    channel.close()
    await channel.closed.wait()


def main() -> None:
    """Entry point. Ctrl-C is meant for the cell, which stops this process in its own way."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end = socket.socket(fileno=int(sys.argv[1]))
    permitted = True

    def refused() -> None:
        nonlocal permitted
        permitted = False

    run_real(lambda: _serve(end, permitted), refused)


if __name__ == "__main__":
    main()
