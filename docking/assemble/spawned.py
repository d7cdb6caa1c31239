"""The cell's hold on its motion process: starts it, joins it by a socket, knows how it ended."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any

from docking.assemble.motion_process import order
from docking.assemble.motion_side import lease_settings
from docking.config import CellFile
from docking.motion.channel import SocketChannel
from docking.motion.remote import RemoteMotion, Tell

END_S = 20.0
"""Longest wait for the process to stop the axes and end by itself."""
REAP_S = 0.2
LAST_WORDS = 4000


class MotionProcess:
    """One motion process; leaving the context ends it, whatever has happened.

    It is in a session of its own, so that Ctrl-C reaches only the cell, and what it writes is kept from the terminal.
    """

    def __init__(self) -> None:
        self._near, far = socket.socketpair()
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process, in __exit__
        with far:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "docking.assemble.motion_process", str(far.fileno())],
                pass_fds=[far.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=self._said,
                stderr=self._said,
                start_new_session=True,
            )

    def __enter__(self) -> MotionProcess:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._near.close()
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        self._said.close()

    async def join(self, files: tuple[Path, Path], cell: CellFile, found: dict[str, Any], tell: Tell) -> RemoteMotion:
        """Order it to serve the cell of `files` (cell, job); give the cell's side of it."""
        channel = await SocketChannel.open(self._near)
        channel.send(order(*files, found))
        return RemoteMotion(channel, cell.axis_names, lease_settings(cell), tell, self.explain)

    def explain(self, reason: str) -> str:
        """How it ended, or why it is given up."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            code = self._process.wait(REAP_S)
            last = self.last_words().strip().splitlines()[-1:]
            return ": ".join([_ending(code), *last])
        return reason

    def last_words(self) -> str:
        """The end of what it wrote."""
        self._said.seek(0, 2)
        self._said.seek(max(0, self._said.tell() - LAST_WORDS))
        return self._said.read().decode("utf-8", "replace")

    async def end(self) -> dict[str, Any]:
        """Wait until it has ended, by force if it must be; how, and what it wrote."""
        try:
            await asyncio.to_thread(self._process.wait, END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
        return {"ended": _ending(self._process.wait()), "said": self.last_words()}


def _ending(code: int) -> str:
    if code >= 0:
        return f"it ended with code {code}"
    return f"it was ended by {signal.Signals(-code).name}"
