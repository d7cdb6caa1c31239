"""The journal: what it promises to keep, to notice and to refuse."""

from __future__ import annotations

import asyncio
import hashlib
import json
import multiprocessing
import os
import threading
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from docking.errors import FileUnreadable, JournalBusy, JournalCorrupt, JournalUnwritable
from docking.journal import GENESIS, JournalFile, canonical, read, verify

WALL = datetime(2026, 5, 4, 8, 30, tzinfo=UTC)


class Ticks:
    """A loop clock that the test moves."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        self.now_s += 0.25
        return self.now_s


def open_journal(path: Path) -> JournalFile:
    return JournalFile(path, clock=Ticks(), wall=lambda: WALL)


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Three records with everything that has two spellings in JSON: exponents, non-ASCII text, control characters."""
    path = tmp_path / "run.jsonl"
    journal = open_journal(path)
    journal.write("run_started", {"cell": "机身", "eps": 1e-05, "text": "a\x1b*/\n"})
    journal.write("intent", {"plan_hash": "ab12", "start_mm": {"A.X": 0.1, "A.Y": -3.0}})
    journal.write("outcome", {"outcome": "docked", "e_mm": 0.30000000000000004})
    journal.close()
    return path


def test_record_has_the_agreed_keys_and_the_two_times(small: Path) -> None:
    first, second, third = read(small)
    assert set(first) == {"seq", "boot_id", "t_mono_s", "t_wall", "kind", "body", "prev_sha", "sha"}
    assert [r["seq"] for r in (first, second, third)] == [0, 1, 2]
    assert [r["t_mono_s"] for r in (first, second, third)] == [0.25, 0.5, 0.75]
    assert first["t_wall"] == "2026-05-04T08:30:00+00:00"
    assert second["kind"] == "intent"
    assert second["body"] == {"plan_hash": "ab12", "start_mm": {"A.X": 0.1, "A.Y": -3.0}}
    assert first["prev_sha"] == GENESIS
    assert (second["prev_sha"], third["prev_sha"]) == (first["sha"], second["sha"])


def test_the_chain_can_be_checked_without_this_program(small: Path) -> None:
    previous = "0" * 64
    for line in small.read_bytes().splitlines():
        record = json.loads(line)
        sha = record.pop("sha")
        text = json.dumps(record, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
        assert hashlib.sha256(text.encode()).hexdigest() == sha
        assert record["prev_sha"] == previous
        previous = sha
    assert verify(small).head == previous


@pytest.mark.parametrize("mask", [0x01, 0x02, 0x04, 0x08, 0x10, 0x20, 0x40, 0x80, 0xFF])
def test_every_flipped_byte_is_detected(small: Path, tmp_path: Path, mask: int) -> None:
    whole = small.read_bytes()
    damaged = tmp_path / "damaged.jsonl"
    first_line, second_line = (len(part) for part in whole.split(b"\n")[:2])
    for at in range(len(whole)):
        damaged.write_bytes(whole[:at] + bytes([whole[at] ^ mask]) + whole[at + 1 :])
        with pytest.raises(JournalCorrupt) as caught:
            verify(damaged)
        expected = 0 if at <= first_line else 1 if at <= first_line + 1 + second_line else 2
        assert caught.value.value == expected, f"byte {at}"


def test_truncation_at_every_offset_keeps_the_whole_records_and_goes_on(small: Path, tmp_path: Path) -> None:
    whole = small.read_bytes()
    ends = [i for i, byte in enumerate(whole) if byte == ord("\n")]
    for size in range(len(whole) + 1):
        cut = tmp_path / "cut.jsonl"
        cut.write_bytes(whole[:size])
        kept = sum(end <= size for end in ends)  # a record that lacks only its line feed is whole
        assert verify(cut).count == kept
        journal = open_journal(cut)
        journal.write("state", {"to": "FAULT"})
        journal.close()
        records = read(cut)
        assert [r["kind"] for r in records] == [*["run_started", "intent", "outcome"][:kept], "state"]
        assert verify(cut).torn_bytes == 0


def test_torn_bytes_are_counted_and_not_touched_by_reading(small: Path) -> None:
    whole = small.read_bytes()
    small.write_bytes(whole + b'{"body":{"x_mm"')
    assert verify(small).torn_bytes == 15
    assert len(read(small)) == 3
    assert small.stat().st_size == len(whole) + 15


@pytest.mark.parametrize("keep", [(0, 2), (1, 2), (1, 0, 2), (0, 0, 1, 2)], ids=str)
def test_missing_moved_or_doubled_records_are_named(small: Path, keep: tuple[int, ...]) -> None:
    lines = small.read_bytes().splitlines(keepends=True)
    small.write_bytes(b"".join(lines[i] for i in keep))
    first_wrong = next(i for i, line in enumerate(keep) if line != i)
    with pytest.raises(JournalCorrupt, match=f"record {first_wrong}"):
        read(small)


def test_damage_leaves_the_file_alone_and_open_refuses(small: Path) -> None:
    damaged = small.read_bytes().replace(b"ab12", b"ab13")
    small.write_bytes(damaged)
    with pytest.raises(JournalCorrupt, match="record 1"):
        open_journal(small)
    assert small.read_bytes() == damaged
    small.write_bytes(damaged.replace(b"ab13", b"ab12"))
    open_journal(small).close()  # the refused open holds no lock


def test_a_forged_record_with_a_right_hash_but_other_spelling_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "run.jsonl"
    journal = open_journal(path)
    journal.write("state", {"eps": 1e-05})
    journal.close()
    path.write_bytes(path.read_bytes().replace(b"1e-05", b"1E-05"))
    with pytest.raises(JournalCorrupt, match="record 0"):
        verify(path)


def test_reopening_continues_the_chain_under_another_boot_id(small: Path) -> None:
    journal = open_journal(small)
    assert journal.head == read(small)[-1]["sha"]
    journal.write("run_started", {})
    journal.close()
    records = read(small)
    assert [r["seq"] for r in records] == [0, 1, 2, 3]
    assert records[3]["boot_id"] != records[2]["boot_id"]
    assert verify(small).count == 4


def test_unknown_numbers_become_null_and_arrays_lists() -> None:
    class Phase(Enum):
        MOVING = "moving"

    body: dict[Any, Any] = {
        "nan": float("nan"),
        "inf": [float("-inf"), 1.5],
        "array": np.array([[1.0, np.nan], [3.0, 4.0]]),
        "scalar": np.float64(0.1),
        "count": np.int64(7),
        "yes": np.bool_(True),
        "phase": Phase.MOVING,
        "path": Path("a/b"),
        "pair": (1, 2),
        10: "ten",
        9: "nine",
    }
    assert json.loads(canonical(body)) == {
        "nan": None,
        "inf": [None, 1.5],
        "array": [[1.0, None], [3.0, 4.0]],
        "scalar": 0.1,
        "count": 7,
        "yes": True,
        "phase": "moving",
        "path": "a/b",
        "pair": [1, 2],
        "10": "ten",
        "9": "nine",
    }
    with pytest.raises(TypeError):
        canonical({"made_of": object()})


json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text()
    | st.text(alphabet=st.characters(categories=["Cs"])),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text() | st.integers(), inner, max_size=4),
    max_leaves=20,
)


@given(body=st.dictionaries(st.text() | st.integers(), json_values, max_size=5))
def test_whatever_is_written_verifies_and_comes_back(
    body: dict[Any, Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("any") / "run.jsonl"
    journal = open_journal(path)
    journal.write("state", body)
    journal.write("state", {})
    journal.close()
    assert verify(path).count == 2
    assert canonical(read(path)[0]["body"]) == canonical(body)


def test_same_run_writes_the_same_bodies(tmp_path: Path) -> None:
    def bodies(name: str) -> list[bytes]:
        journal = open_journal(tmp_path / name)
        for i in range(5):
            journal.write("measurement", {"i": i, "p_T_mm": np.array([i / 3.0, -0.0, 1e300])})
        journal.close()
        return [canonical(r["body"]).encode() for r in read(tmp_path / name)]

    assert bodies("one") == bodies("two")


def _try_open(path: str, answer: Any) -> None:
    try:
        JournalFile(Path(path), clock=lambda: 0.0)
    except JournalBusy:
        answer.put("busy")
    else:
        answer.put("opened")


def test_only_one_program_holds_a_journal(small: Path) -> None:
    held = open_journal(small)
    with pytest.raises(JournalBusy):
        open_journal(small)
    context = multiprocessing.get_context("spawn")
    answer = context.Queue()
    other = context.Process(target=_try_open, args=(str(small), answer))
    other.start()
    assert answer.get(timeout=60) == "busy"
    other.join()
    answer.close()
    answer.join_thread()
    held.close()
    open_journal(small).close()


async def test_a_sync_is_over_when_all_that_was_written_is_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = open_journal(tmp_path / "run.jsonl")
    synced: list[int] = []
    real = os.fdatasync

    def fdatasync(fd: int) -> None:
        synced.append(os.fstat(fd).st_size)
        real(fd)

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    journal.write("intent", {"plan_hash": "a"})
    assert synced == []
    await journal.sync()
    assert synced == [(tmp_path / "run.jsonl").stat().st_size]
    journal.close()


async def test_a_slow_disk_keeps_neither_the_loop_nor_a_record_waiting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = JournalFile(tmp_path / "run.jsonl", clock=Ticks(), aside=asyncio.to_thread)
    disk = threading.Event()
    with monkeypatch.context() as patch:
        patch.setattr(os, "fdatasync", lambda fd: disk.wait(30.0))
        journal.write("intent", {"plan_hash": "a"})
        waiting = asyncio.create_task(journal.sync())
        await asyncio.sleep(0)
        journal.write("command", {"verb": "stop"})
        assert not waiting.done()
        disk.set()
        await waiting
    journal.close()
    assert [r["kind"] for r in read(tmp_path / "run.jsonl")] == ["intent", "command"]


async def test_a_failed_sync_ends_the_journal_for_good(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = open_journal(tmp_path / "run.jsonl")

    def no_disk(_: int) -> None:
        raise OSError(5, "Input/output error")

    journal.write("intent", {})
    with monkeypatch.context() as patch:
        patch.setattr(os, "fdatasync", no_disk)
        with pytest.raises(JournalUnwritable, match="Input/output error"):
            await journal.sync()
    with pytest.raises(JournalUnwritable, match="Input/output error"):
        journal.write("state", {})
    with pytest.raises(JournalUnwritable, match="Input/output error"):
        await journal.sync()
    journal.close()


def test_a_full_disk_ends_the_journal_and_the_cut_record_is_recovered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.jsonl"
    journal = open_journal(path)
    journal.write("state", {"n": 1})
    real, room = os.write, [40]

    def almost_full(fd: int, data: Any) -> int:
        if not room:
            raise OSError(28, "No space left on device")
        return real(fd, bytes(data)[: room.pop()])

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", almost_full)
        with pytest.raises(JournalUnwritable, match="No space left"):
            journal.write("intent", {"n": 2})
    journal.close()
    assert verify(path).torn_bytes == 40
    open_journal(path).close()
    assert [r["body"] for r in read(path)] == [{"n": 1}]


def test_paths_that_cannot_be_a_journal_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileUnreadable):
        open_journal(tmp_path)
    with pytest.raises(FileUnreadable):
        open_journal(tmp_path / "no" / "such" / "folder.jsonl")
    with pytest.raises(FileUnreadable):
        read(tmp_path / "none.jsonl")


@pytest.mark.parametrize(
    "line", [b"[]", b"{}", b"1", b"null", b"[" * 100_000, b'{"seq":0}', b"\xff\xfe"], ids=lambda b: repr(b[:10])
)
def test_lines_that_are_no_records_are_damage_not_crashes(tmp_path: Path, line: bytes) -> None:
    path = tmp_path / "run.jsonl"
    path.write_bytes(line + b"\n")
    with pytest.raises(JournalCorrupt, match="record 0"):
        read(path)


def test_closed_journal_refuses_and_closing_twice_is_harmless(small: Path) -> None:
    journal = open_journal(small)
    journal.close()
    journal.close()
    with pytest.raises(JournalUnwritable, match="closed"):
        journal.write("state", {})
