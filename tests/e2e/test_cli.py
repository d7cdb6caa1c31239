"""The command line as programs and people meet it: help, exit codes, one JSON object, and every bad input named."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from docking.cli import call
from docking.errors import catalogue
from tests.support.program import CELLS, PROGRAM, cell_copy, environment, quick_cell, served, unwired

LAB = CELLS / "lab-can.toml"
MODBUS = CELLS / "lab-modbus.toml"
COMMANDS = (
    ["check"],
    ["plan"],
    ["layout"],
    ["network"],
    ["dry-run"],
    ["run"],
    ["sim"],
    ["fit"],
    ["study"],
    ["study", "dock"],
)
SUMMARY = {
    "outcome",
    "tolerance_mm",
    "max_feature_error_mm",
    "feature_sigma_mm",
    "true_max_feature_error_mm",
    "moves",
    "rejected_points",
    "max_consistency_residual_mm",
    "max_internal_force_n",
    "virtual_time_s",
    "wall_time_s",
    "alarms",
    "report",
}


class Ran:
    """One command that was run with `--json`."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.err = code, err
        assert out.count("\n") == 1, out
        assert "Traceback" not in out + err
        self.told: dict[str, Any] = json.loads(out, parse_constant=_no_constant)

    def error(self) -> dict[str, Any]:
        """The error of a command that exits with 2."""
        assert self.code == 2
        assert set(self.told) == {"error"}
        return self._checked(self.told["error"])

    def alarm(self) -> dict[str, Any]:
        """The first alarm of a run that was refused or failed."""
        assert set(self.told) == SUMMARY
        return self._checked(self.told["alarms"][0])

    @staticmethod
    def _checked(error: dict[str, Any]) -> dict[str, Any]:
        """What every error has: a known code, its remedy, and where it is, said in its message."""
        assert {"code", "message", "where", "value", "limit", "remedy"} <= set(error)
        assert error["remedy"] == catalogue("en")[str(error["code"])]["remedy"]
        assert error["where"]
        assert error["where"] in error["message"]
        assert "{" not in error["message"].replace("{uncalibrated_base}", "")
        return error


def _no_constant(name: str) -> None:
    raise AssertionError(f"{name} is no JSON; unknown numbers are null")


@pytest.fixture
def docking(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    """Run a command in this process."""
    for name in ("DOCKING_LANGUAGE", "LC_ALL", "LANG"):
        monkeypatch.delenv(name, raising=False)

    def run(*arguments: object) -> Ran:
        code = call([*map(str, arguments), "--json"])
        out, err = capsys.readouterr()
        return Ran(code, out, err)

    return run


def program(*arguments: object, **more: str) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own."""
    return subprocess.run(
        [*PROGRAM, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=60.0,
        stdin=subprocess.DEVNULL,
        env=environment(**more),
    )


# help and versions ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_every_command_has_help_with_an_example(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert call([*command, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"Usage: docking {' '.join(command)}" in text
    example = re.search(r"Example: docking (.+)", text)
    assert example is not None
    assert example[1].split()[: len(command)] == command


def test_the_program_lists_its_commands_and_says_what_it_is_not(capsys: pytest.CaptureFixture[str]) -> None:
    assert call(["--help"]) == 0
    text = capsys.readouterr().out
    for name, *_ in COMMANDS:
        assert re.search(rf"^  {name} ", text, re.MULTILINE)
    assert "not a safety function" in text
    assert call(["--version"]) == 0


# exit codes ----------------------------------------------------------------------------------------------------------
def test_a_docking_exits_with_0_and_one_object(docking, tmp_path: Path) -> None:
    ran = docking("dry-run", LAB, "--report", tmp_path / "r" / "report.html")
    assert ran.code == 0
    assert set(ran.told) == SUMMARY
    assert ran.told["outcome"] == "docked"
    assert (tmp_path / "r" / "report.html").stat().st_size > 10_000
    assert (tmp_path / "r" / "report.journal.jsonl").exists()
    assert "DOCKED" not in ran.err
    assert "station located" in ran.err


def test_a_checked_pair_of_files_exits_with_0(docking) -> None:
    assert docking("check", LAB).code == 0
    assert docking("check", LAB, CELLS / "lab-can.job.toml").told["ok"] is True


def test_a_tolerance_that_the_run_cannot_prove_exits_with_3(docking, tmp_path: Path) -> None:
    cell = unwired(cell_copy(tmp_path, "lab-can", (".job.toml", " tolerance_mm = 0.1,", " tolerance_mm = 0.042,")))
    ran = docking("dry-run", cell)
    assert (ran.code, ran.told["outcome"]) == (3, "out_of_tolerance")
    alarm = ran.alarm()
    assert alarm["code"] == 5011
    assert alarm["value"] > alarm["limit"] == 2.5


@pytest.mark.wires
def test_an_interrupted_run_exits_with_4_and_one_object(tmp_path: Path) -> None:
    cell = quick_cell(tmp_path, "lab-can")
    with subprocess.Popen(
        [*PROGRAM, "run", str(cell), "--sim", "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        text=True,
        env=environment(),
    ) as run:
        assert run.stdout is not None
        assert run.stderr is not None
        for line in run.stderr:
            if line.startswith("measuring the component"):
                break
        run.send_signal(signal.SIGINT)
        out, err = run.communicate(timeout=30.0)
    ran = Ran(run.returncode, out, err)
    assert (ran.code, ran.told["outcome"], ran.told["moves"]) == (4, "stopped", 0)


def test_an_interrupted_rehearsal_exits_with_4() -> None:
    with subprocess.Popen(
        [*PROGRAM, "dry-run", str(CELLS / "fuselage-can.toml"), "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
        # A test run in the background of a shell is born deaf to interrupts; a person's terminal is not.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as run:
        assert run.stdout is not None
        assert run.stderr is not None
        run.stderr.readline()
        time.sleep(0.5)
        run.send_signal(signal.SIGINT)
        out, err = run.communicate(timeout=30.0)
    ran = Ran(run.returncode, out, err)
    assert (ran.code, ran.told["error"]["code"]) == (4, 6003)


# usage ---------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((), "--json"),
        (("dokc",), "dokc"),
        (("dry-run",), "CELL"),
        (("dry-run", LAB, "--sed", "3"), "--seed"),
        (("dry-run", LAB, "--seed", "x"), "'x'"),
        (("dry-run", LAB, "--seed", "-1"), "-1"),
        (("dry-run", LAB, LAB, "third"), "third"),
        (("fit", "a.csv"), "MEASURED"),
        (("fit", "a.csv", "b.csv", "--method", "best"), "least-squares"),
        (("run", LAB), "--step"),
        (("run", LAB, "--step", "--wires", "w.json"), "--sim"),
        (("study", "doc"), "dock"),
        (("study", "dock", LAB, "--seeds", "0"), "0"),
        (("study", "dock", LAB, "--workers", "0"), "0"),
        (("study", "dock", LAB, "--error", "sagg=1"), "stick_slip"),
        (("study", "dock", LAB, "--error", "sag"), "NAME=SCALE"),
    ],
    ids=str,
)
def test_a_wrong_call_is_named(docking, arguments: tuple[object, ...], named: str) -> None:
    error = docking(*arguments).error()
    assert error["code"] == 4004
    assert named in error["message"]


def test_a_wrong_call_shows_the_usage_to_a_person(capsys: pytest.CaptureFixture[str]) -> None:
    assert call(["dry-run"]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert "Usage: docking dry-run" in err
    assert "    -> " in err


# files ---------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "command", [("check",), ("plan",), ("dry-run",), ("run", "--sim"), ("run", "--step"), ("study", "dock")]
)
def test_a_missing_cell_file_is_named(docking, command: tuple[str, ...]) -> None:
    error = docking(*command, "nowhere/cell.toml").error()
    assert (error["code"], error["where"]) == (4001, "nowhere/cell.toml")
    assert "no such file" in error["message"]


def bad_files(folder: Path) -> Iterator[tuple[str, int, str, str]]:
    """(arguments, code, file that is named, what is said)."""
    only = cell_copy(folder / "only", "lab-can")
    only.with_name("lab-can.job.toml").unlink()
    yield f"check {only}", 4001, "lab-can.job.toml", "no such file"
    untold = cell_copy(folder / "untold", "lab-can")
    untold.with_name("lab-can.sim.toml").unlink()
    yield f"dry-run {untold}", 4001, "lab-can.sim.toml", "no such file"
    binary = folder / "binary.toml"
    binary.write_bytes(bytes(range(256)))
    yield f"check {binary}", 4001, "binary.toml", "UTF-8"
    broken = cell_copy(folder / "broken", "lab-can", (".toml", "[tracker]", "[tracker"))
    yield f"check {broken}", 4001, "lab-can.toml", "line"
    yield f"check {folder}", 4001, str(folder), "directory"
    yield f"check {CELLS / 'lab-can.job.toml'}", 4002, "lab-can.job.toml", "a CELL file is wanted"
    yield f"check {LAB} {LAB}", 4002, "lab-can.toml", "a JOB file is wanted"
    misspelt = cell_copy(folder / "misspelt", "lab-can", (".toml", "temperature_c =", "temperatur_c ="))
    yield f"dry-run {misspelt}", 4002, "lab-can.toml", "nearest valid key: temperature_c"
    unknown = cell_copy(folder / "nan", "lab-can", (".toml", "temperature_c = 20.0", "temperature_c = nan"))
    yield f"run --sim {unknown}", 4002, "lab-can.toml", "temperature_c = NaN"
    yield f"check {collinear(folder / 'line')}", 4002, "lab-can.job.toml", "the targets lie on a line"


def collinear(folder: Path) -> Path:
    """A laboratory cell whose component has all its targets on one line."""
    cell = cell_copy(folder, "lab-can")
    job = cell.with_name("lab-can.job.toml")
    head, rest = job.read_text("utf-8").split("targets = [", 1)
    targets, tail = rest.split("\n]", 1)
    places = iter(range(-400, 400, 100))
    targets = re.sub(r" xyz_mm = \[[^]]*\]", lambda _: f" xyz_mm = [{next(places)}.0, -250.0, 0.0]", targets)
    job.write_text(f"{head}targets = [{targets}\n]{tail}", "utf-8")
    return cell


def test_every_bad_file_is_named_with_its_fault(docking, tmp_path: Path) -> None:
    for arguments, code, named, said in bad_files(tmp_path):
        ran = docking(*arguments.split())
        error = ran.error()
        assert error["code"] == code, error
        assert named in error["where"], error
        assert said in error["message"], error
        assert (code != 4002) or error["problems"], error


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "no such file"),
        ("{", "not JSON"),
        ("[]", "not for cell lab-can"),
        ('{"cell": "lab-modbus"}', "not for cell lab-can"),
        ('{"cell": "lab-can", "tracker": "/dev/pts/99"}', "lacks addresses"),
        ('{"cell": "lab-can", "tracker": "/dev/pts/99", "can": "/tmp/x"}', "/tmp/x is no simulated device"),
    ],
)
def test_a_wrong_wires_file_is_named(docking, tmp_path: Path, content: str | None, said: str) -> None:
    wires = tmp_path / "w.json"
    if content is not None:
        wires.write_text(content, "utf-8")
    error = docking("run", LAB, "--sim", "--wires", wires).error()
    assert said in error["message"]
    assert str(wires) in error["message"]


def test_what_cannot_be_written_is_named_before_anything_runs(docking, tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("", "utf-8")
    for option, target in (
        ("--report", blocked / "report.html"),
        ("--report", tmp_path),
        ("--journal", blocked / "run.jsonl"),
    ):
        ran = docking("dry-run", LAB, option, target)
        error = ran.error()
        assert (error["code"], error["where"]) == (4005, str(target))
        assert "station located" not in ran.err


# point files ---------------------------------------------------------------------------------------------------------
NOMINAL = "name,x_mm,y_mm,z_mm\n" + "".join(f"P{i},{x},{y},{z}\n" for i, (x, y, z) in enumerate(
    [(0, 0, 0), (1000, 0, 0), (0, 800, 0), (0, 0, 600), (900, 700, 50), (300, 650, 500), (750, 90, 420)]
))  # fmt: skip


def points(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, "utf-8")
    return path


@pytest.mark.parametrize(
    ("text", "code", "said"),
    [
        ("", 4003, "measured.csv"),
        ("name;x_mm;y_mm;z_mm\n", 4003, "semicolons"),
        ("name,x_mm,y_mm,z_mm\nP0,1,2,nan\n", 4003, "nan"),
        ("name,x_mm,y_mm,z_mm\nP0,1,2\n", 4003, "line 2"),
    ],
)
def test_a_bad_point_file_is_named(docking, tmp_path: Path, text: str, code: int, said: str) -> None:
    nominal, measured = points(tmp_path, "nominal.csv", NOMINAL), points(tmp_path, "measured.csv", text)
    error = docking("fit", nominal, measured).error()
    assert error["code"] == code
    assert said in error["message"]
    assert error["where"] == str(measured)


def test_a_missing_point_file_is_named(docking, tmp_path: Path) -> None:
    error = docking("fit", points(tmp_path, "n.csv", NOMINAL), tmp_path / "gone.csv").error()
    assert (error["code"], error["where"]) == (4001, str(tmp_path / "gone.csv"))


def test_a_refused_fit_says_why_and_exits_with_1(docking, tmp_path: Path) -> None:
    nominal = points(tmp_path, "nominal.csv", NOMINAL)
    mirrored = re.sub(r"(P\d,)(\d)", r"\1-\2", NOMINAL).replace("-0,", "0,")
    line = "name,x_mm,y_mm,z_mm\n" + "".join(f"P{i},{100 * i},0,0\n" for i in range(7))
    for measured in (mirrored, "name,x_mm,y_mm,z_mm\nP0,0,0,0\nP1,1000,0,0\n"):
        ran = docking("fit", nominal, points(tmp_path, "measured.csv", measured))
        assert ran.code == 1
        assert ran.told["pose"] is None
        assert ran.told["refused"]
    ran = docking("fit", points(tmp_path, "line.csv", line), points(tmp_path, "measured.csv", line))
    assert ran.code == 1
    assert "line" in ran.told["refused"]


# runs that are refused -----------------------------------------------------------------------------------------------
def test_swapped_serial_numbers_are_a_wrong_identity(docking, tmp_path: Path) -> None:
    cell = cell_copy(
        tmp_path,
        "lab-can",
        (".toml", "node = 1, serial_number = 402001,", "node = 1, serial_number = 402002,"),
        (".toml", "node = 2, serial_number = 402002,", "node = 2, serial_number = 402001,"),
    )
    ran = docking("dry-run", cell)
    assert (ran.code, ran.told["outcome"], ran.told["moves"]) == (1, "refused", 0)
    alarm = ran.alarm()
    assert (alarm["code"], alarm["where"]) == (1003, "A.X")
    assert (alarm["value"], alarm["limit"]) == ("serial 402001", "serial 402002")


def test_an_unreachable_pose_names_the_axis_and_its_stroke(docking, tmp_path: Path) -> None:
    mate = "[mate_pose]  # where the mate stands beside the job's approximate pose [K]\nmm = 0.5"
    cell = cell_copy(
        tmp_path,
        "lab-can",
        (".toml", "stroke_mm = [-25.0, 25.0]", "stroke_mm = [-9.0, 9.0]"),
        (".toml", "stroke_margin_mm = 1.0", "stroke_margin_mm = 0.5"),
        (".toml", "first_correction_mm = 15.0", "first_correction_mm = 90.0"),
        (".sim.toml", mate, "[mate_pose]\nmm = 4.0"),
    )
    ran = docking("dry-run", cell, "--seed", 2)
    assert (ran.code, ran.told["outcome"]) == (1, "refused")
    alarm = ran.alarm()
    assert (alarm["code"], alarm["where"]) == (5001, "A.X")
    assert alarm["value"] < alarm["limit"] == -8.5


def test_a_correction_over_the_guard_is_refused(docking, tmp_path: Path) -> None:
    cell = cell_copy(tmp_path, "lab-can", (".toml", "first_correction_mm = 15.0", "first_correction_mm = 2.0"))
    ran = docking("dry-run", cell)
    alarm = ran.alarm()
    assert (ran.code, alarm["code"]) == (1, 5004)
    assert alarm["value"] > alarm["limit"] == 2.0


def test_an_alarm_speaks_chinese_to_a_person(tmp_path: Path) -> None:
    cell = cell_copy(tmp_path, "lab-can", (".toml", "first_correction_mm = 15.0", "first_correction_mm = 2.0"))
    run = program("dry-run", cell, DOCKING_LANGUAGE="zh")
    assert run.returncode == 1
    assert catalogue("zh")["5004"]["remedy"] in run.stdout
    assert "已拒绝" in run.stdout
    run = program("check", tmp_path / "gone.toml", DOCKING_LANGUAGE="zh")
    assert run.returncode == 2
    assert catalogue("zh")["4001"]["remedy"] in run.stderr


# hardware that is not there ------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["lab-can", "lab-modbus"])
def test_a_missing_port_is_named_by_a_run_on_real_devices(tmp_path: Path, name: str) -> None:
    cell = cell_copy(tmp_path, name, (".toml", 'port = "/dev/ttyUSB0"', 'port = "/dev/ttyUSB77"'))
    run = program("run", cell, "--step", "--json")
    ran = Ran(run.returncode, run.stdout, run.stderr)
    assert (ran.code, ran.told["outcome"]) == (1, "refused")
    alarm = ran.alarm()
    assert (alarm["code"], alarm["where"], alarm["value"]) == (1001, "tracker", "/dev/ttyUSB77")
    assert "/dev/ttyUSB77" in alarm["message"]


@pytest.mark.wires
class TestOnWires:
    """Real wires to a served cell, some of them cut, swapped or silent."""

    @staticmethod
    def _changed(wires: Path, **entries: object) -> Path:
        changed = wires.with_name("changed.json")
        changed.write_text(json.dumps({**json.loads(wires.read_text("utf-8")), **entries}), "utf-8")
        return changed

    @staticmethod
    def _refused(docking, cell: Path, wires: Path) -> dict[str, Any]:
        ran = docking("run", cell, "--sim", "--wires", wires)
        assert (ran.code, ran.told["outcome"], ran.told["moves"]) == (1, "refused", 0)
        return ran.alarm()

    def test_can(self, docking, tmp_path: Path) -> None:
        silent = tmp_path / "silent.sock"
        master, slave = pty.openpty()
        with (
            served(LAB, tmp_path) as wires,
            closing(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)) as listener,
        ):
            listener.bind(str(silent))
            listener.listen()
            alarm = self._refused(docking, LAB, self._changed(wires, tracker="/dev/pts/none"))
            assert (alarm["code"], alarm["value"]) == (1001, "/dev/pts/none")
            with closing(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)) as deserted:
                deserted.bind(str(tmp_path / "gone.sock"))
            alarm = self._refused(docking, LAB, self._changed(wires, can=str(tmp_path / "gone.sock")))
            assert (alarm["code"], alarm["value"]) == (1001, str(tmp_path / "gone.sock"))
            assert "nobody serves it" in alarm["message"]
            alarm = self._refused(docking, LAB, self._changed(wires, tracker=os.ttyname(slave)))
            assert (alarm["code"], alarm["where"]) == (1002, "tracker")
            alarm = self._refused(docking, LAB, self._changed(wires, can=str(silent)))
            assert (alarm["code"], alarm["where"]) == (1002, "A.X")
        os.close(master)
        os.close(slave)

    def test_modbus(self, docking, tmp_path: Path) -> None:
        with served(MODBUS, tmp_path) as wires, closing(socket.create_server(("127.0.0.1", 0))) as mute:
            at = json.loads(wires.read_text("utf-8"))["modbus"]
            swapped = self._changed(wires, modbus={**at, "A": at["B"], "B": at["A"]})
            alarm = self._refused(docking, MODBUS, swapped)
            assert (alarm["code"], alarm["where"]) == (1003, "positioner A")
            assert "B" in str(alarm["value"])
            with closing(socket.create_server(("127.0.0.1", 0))) as closed:
                free = closed.getsockname()
            alarm = self._refused(docking, MODBUS, self._changed(wires, modbus={**at, "C": list(free)}))
            assert (alarm["code"], alarm["where"]) == (1001, "positioner C")
            assert alarm["value"] == f"{free[0]}:{free[1]}"
            silent = list(mute.getsockname())
            alarm = self._refused(docking, MODBUS, self._changed(wires, modbus={**at, "D": silent}))
            assert (alarm["code"], alarm["where"]) == (1002, "positioner D")

    def test_targets_that_are_not_congruent(self, docking, tmp_path: Path) -> None:
        """The job says other nominal coordinates than the part has: seven of eight targets elsewhere."""
        cell = quick_cell(tmp_path, "lab-can")
        text = cell.with_name("lab-can.job.toml").read_text("utf-8")
        for number in range(1, 8):
            away = f"{number * 6.0 - 20.0}, -250.0, {5.0 * number**2 - 100.0}"
            text, changed = re.subn(rf'(name = "J0{number}", xyz_mm = )\[[^]]*\]', rf"\1[{away}]", text)
            assert changed == 1
        other = tmp_path / "other.job.toml"
        other.write_text(text, "utf-8")
        with served(cell, tmp_path) as wires:
            ran = docking("run", cell, other, "--sim", "--wires", wires)
        assert (ran.code, ran.told["outcome"], ran.told["moves"]) == (1, "refused", 0)
        assert ran.alarm()["code"] in (3003, 3004)


def test_a_defect_of_the_program_becomes_words_and_a_file(docking, monkeypatch: pytest.MonkeyPatch) -> None:
    def break_down(*_: object) -> None:
        raise ZeroDivisionError("on purpose")

    monkeypatch.setattr("docking.config.check.check_files", break_down)
    ran = docking("check", LAB)
    error = ran.told["error"]
    assert (ran.code, error["code"]) == (1, 6007)
    kept = Path(re.search(r"details in (\S+?)\)", error["message"])[1])  # type: ignore[index]
    assert "break_down" in kept.read_text("utf-8")
    kept.unlink()
