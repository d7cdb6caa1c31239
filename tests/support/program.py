"""The real program in processes of its own: the simulated devices, and a person at a terminal."""

from __future__ import annotations

import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

CELLS = Path(__file__).parents[2] / "sim" / "cells"
PROGRAM = (sys.executable, "-c", "from docking.cli import main; main()")


def environment(**more: str) -> dict[str, str]:
    kept = {k: v for k, v in os.environ.items() if k not in ("DOCKING_LANGUAGE", "LC_ALL", "LANG")}
    return {**kept, "LANG": "C.UTF-8", "PYTHONWARNINGS": "error", **more}


def cell_copy(folder: Path, name: str, *changes: tuple[str, str, str]) -> Path:
    """The three files of a reference cell in `folder`; `changes` are (ending of the file, text, its replacement)."""
    folder.mkdir(parents=True, exist_ok=True)
    for ending in (".toml", ".job.toml", ".sim.toml"):
        text = (CELLS / f"{name}{ending}").read_text("utf-8")
        for of, old, new in changes:
            if of == ending:
                assert old in text, f"{name}{ending} has no {old!r}"
                text = text.replace(old, new)
        (folder / f"{name}{ending}").write_text(text, "utf-8")
    return folder / f"{name}.toml"


def quick_cell(folder: Path, name: str) -> Path:
    """A laboratory cell whose instrument takes 10 ms a point: tests of the operator need not wait for it."""
    return cell_copy(folder, name, (".sim.toml", "measure_s = 0.1", "measure_s = 0.01"))


def unwired(cell: Path) -> Path:
    """The same cell without its inputs: the operator declares every permissive."""
    text = cell.read_text("utf-8")
    begin, end = text.index("\n[inputs]"), text.index("\n[load_cells]")
    cell.write_text(text[:begin] + text[end:], "utf-8")
    return cell


def on_an_ordinary_computer(folder: Path, name: str) -> Path:
    """A full-size cell whose controller and simulated devices may wait for the CPU, as the laboratory cells' may.

    A production cell judges silence after 2 cycles of 10 ms; a virtual machine alone may take 50 ms away.
    """
    changes = [
        (".toml", "\n[limits]\n", "\n[limits]\nmissing_cycles = 20\ntick_late_cycles = 20\n"),
        (".sim.toml", 'sync_loss = "quick-stop"\n', 'sync_loss = "quick-stop"\nsync_loss_cycles = 25.0\n'),
    ]
    if name.endswith("-modbus"):
        changes.append((".toml", "\ntimeout_s = 0.05\nwatchdog_s = 0.12\n", "\ntimeout_s = 0.2\nwatchdog_s = 0.5\n"))
    return cell_copy(folder, name, *changes)


@contextmanager
def served(cell: Path, folder: Path, *options: str) -> Iterator[Path]:
    """`docking sim` in another process; gives its wires file. It ends on SIGTERM with exit code 0 and no complaint."""
    wires, said = folder / "wires.json", folder / "sim.txt"
    with said.open("w") as out:
        asked = [*PROGRAM, "sim", str(cell), "--wires", str(wires), *options]
        process = subprocess.Popen(asked, stdout=out, stderr=out, stdin=subprocess.DEVNULL, env=environment())
    try:
        end_s = time.monotonic() + 30.0
        while not wires.exists():
            assert process.poll() is None, said.read_text()
            assert time.monotonic() < end_s, "docking sim does not serve"
            time.sleep(0.05)
        yield wires
        process.send_signal(signal.SIGTERM)
        assert process.wait(10.0) == 0, said.read_text()
        assert "Traceback" not in said.read_text()
        assert "Error" not in said.read_text()
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


class Terminal:
    """`docking ARGUMENTS` on a pseudo-terminal of its own, which `see` reads and `type` writes."""

    def __init__(self, *arguments: str, language: str = "en") -> None:
        self.text = ""
        self._seen = 0
        self._master, slave = pty.openpty()
        self.process = subprocess.Popen(
            [*PROGRAM, *arguments],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
            env=environment(DOCKING_LANGUAGE=language),
        )
        os.close(slave)

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self.hang_up()

    def see(self, pattern: str, within_s: float = 30.0) -> str:
        """Wait until what has been printed since the last sight matches; give that text and count it as seen."""
        end_s = time.monotonic() + within_s
        while (found := re.search(pattern, self.text[self._seen :])) is None:
            assert self._read(end_s), f"{pattern!r} was not said:\n{self.text}"
        start, self._seen = self._seen, self._seen + found.end()
        return self.text[start : self._seen]

    def type(self, line: str) -> None:
        os.write(self._master, line.encode() + b"\n")

    def end_input(self) -> None:
        """Ctrl-D on an empty line."""
        os.write(self._master, b"\x04")

    def hang_up(self) -> None:
        """Close the terminal."""
        if self._master >= 0:
            os.close(self._master)
            self._master = -1

    def interrupt(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def ended(self, within_s: float = 30.0) -> int:
        """The exit code, when all has been read."""
        end_s = time.monotonic() + within_s
        while self._master >= 0 and self._read(end_s):
            pass
        return self.process.wait(max(1.0, end_s - time.monotonic()))

    def _read(self, end_s: float) -> bool:
        """Take what is printed next; False when nothing will come any more or in time."""
        ready, _, _ = select.select([self._master], [], [], max(0.0, end_s - time.monotonic()))
        if not ready:
            return False
        try:
            data = os.read(self._master, 65536)
        except OSError:
            # The program has closed its end.
            return False
        self.text += data.decode("utf-8", "replace").replace("\r\n", "\n")
        return bool(data)
