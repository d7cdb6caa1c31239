"""Append-only, hash-chained journal: one JSON object a line, each bound to the one before it.

A record is {seq, boot_id, t_mono_s, t_wall, kind, body, prev_sha, sha}. A line is the record's canonical JSON (sorted
keys, no spaces, UTF-8, unknown numbers null); `sha` is the SHA-256 of the canonical JSON without `sha`, and `prev_sha`
is the `sha` of the record before, so no byte can change unnoticed. A chain cannot tell that whole records are missing
at its end: the head that the report prints does.

Bytes after the last line feed are a write that a crash cut short: opening the journal drops them. Damage anywhere else
raises JournalCorrupt and the file stays as it is.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import math
import os
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path, PurePath
from typing import Any, Final

import numpy as np

from docking.errors import FileUnreadable, JournalBusy, JournalCorrupt, JournalUnwritable
from docking.ports import Aside, at_once

GENESIS: Final = "0" * 64
KEYS: Final = frozenset({"seq", "boot_id", "t_mono_s", "t_wall", "kind", "body", "prev_sha", "sha"})

Record = dict[str, Any]


@dataclass(frozen=True)
class Chain:
    """What a verified journal holds: `count` records, the `sha` of the last one, bytes of a torn tail."""

    count: int
    head: str
    torn_bytes: int


class JournalFile:
    """The `docking.ports.Journal` of one run, held by this process alone (flock) until `close`.

    `clock` gives the loop's time in s, `wall` the time of day; the disk is waited for `aside`. Records of earlier runs
    in the same file are verified and continued. Raises JournalBusy, JournalCorrupt, JournalUnwritable, FileUnreadable.
    """

    def __init__(
        self,
        path: Path,
        clock: Callable[[], float],
        wall: Callable[[], datetime] | None = None,
        aside: Aside = at_once,
    ) -> None:
        self.path = path
        self._aside = aside
        self._clock = clock
        self._wall = wall or _utc_now
        self._boot_id = uuid.uuid4().hex
        self._failed: str | None = None
        try:
            created = not path.exists()
            self._fd = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise FileUnreadable(str(path), error.strerror or str(error)) from error
        try:
            _lock(self._fd, path)
            if created:
                _sync_directory(path)
            self._count, self._head = _recover(self._fd, path)
        except BaseException:
            os.close(self._fd)
            raise
        self._open = True

    @property
    def head(self) -> str:
        """`sha` of the newest record; GENESIS while the journal is empty."""
        return self._head

    def write(self, kind: str, body: dict[str, Any]) -> None:
        """Append one record. The first failure, here or in `sync`, ends the journal for good."""
        self._require_usable()
        record = {
            "seq": self._count,
            "boot_id": self._boot_id,
            "t_mono_s": self._clock(),
            "t_wall": self._wall().isoformat(),
            "kind": kind,
            "body": body,
            "prev_sha": self._head,
        }
        line, sha = _sealed(record)
        try:
            _write_all(self._fd, line)
        except OSError as error:
            raise self._failure(error) from error
        self._count, self._head = self._count + 1, sha

    async def sync(self) -> None:
        """Return when every record written so far is on the disk, which may take a busy disk a second."""
        self._require_usable()
        try:
            await self._aside(lambda: os.fdatasync(self._fd))
        except OSError as error:
            raise self._failure(error) from error

    def _require_usable(self) -> None:
        if self._failed is not None or not self._open:
            raise JournalUnwritable(str(self.path), self._failed or "closed")

    def _failure(self, error: OSError) -> JournalUnwritable:
        """A failed sync may have dropped the dirty pages: a second try that succeeds would prove nothing."""
        self._failed = error.strerror or str(error)
        return JournalUnwritable(str(self.path), self._failed)

    def close(self) -> None:
        """Make everything durable and let the file go. May be called twice."""
        if not self._open:
            return
        self._open = False
        try:
            os.fdatasync(self._fd)
        except OSError as error:
            raise JournalUnwritable(str(self.path), error.strerror or str(error)) from error
        finally:
            os.close(self._fd)


def read(path: Path) -> list[Record]:
    """All records of a journal, oldest first, each verified; a torn tail is left out. Raises as `verify`."""
    return _parse(_content(path), path)[0]


def verify(path: Path) -> Chain:
    """Check every byte of the chain. Raises JournalCorrupt naming the first bad record, FileUnreadable."""
    records, torn, _ = _parse(_content(path), path)
    return Chain(len(records), records[-1]["sha"] if records else GENESIS, torn)


def canonical(value: Any) -> str:
    """The one JSON text of a value: sorted keys, no spaces; NaN and infinity become null, arrays become lists."""
    return json.dumps(_plain(value), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def _plain(value: Any) -> Any:
    """The same value made of dict, list, str, int, finite float, bool and None. Raises TypeError for anything else."""
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Enum):
        return _plain(value.value)
    if isinstance(value, str):
        # Undecodable bytes of a file name arrive as lone surrogates, which UTF-8 cannot carry: they are spelt out.
        return value if value.isascii() else value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, int) or value is None:
        return value
    if isinstance(value, Mapping):
        # Keys become text here, not in the encoder: it would sort numbers as numbers and the reader as text.
        return {_plain(str(key)): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, PurePath):
        return str(value)
    raise TypeError(f"a {type(value).__name__} cannot be kept in the journal")


def _sealed(record: Record) -> tuple[bytes, str]:
    """The line of a record and its sha."""
    text = canonical(record)
    sha = hashlib.sha256(text.encode()).hexdigest()
    # `sha` sorts between `seq` and `t_mono_s`; the body is encoded once and reused, traces are long.
    cut = text.rindex(',"t_mono_s":')
    return f'{text[:cut]},"sha":"{sha}"{text[cut:]}\n'.encode(), sha


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise FileUnreadable(str(path), error.strerror or str(error)) from error


def _parse(content: bytes, path: Path) -> tuple[list[Record], int, bool]:
    """Verified records, number of torn bytes at the end, and whether the last record only lacks its line feed."""
    *lines, tail = content.split(b"\n")
    records: list[Record] = []
    head = GENESIS
    for line in lines:
        record = _checked(line, len(records), head, path)
        records.append(record)
        head = record["sha"]
    if tail and _is_whole(tail, len(records), path):
        records.append(_checked(tail, len(records), head, path))
        return records, 0, True
    return records, len(tail), False


def _checked(line: bytes, seq: int, prev_sha: str, path: Path) -> Record:
    """The record of one line, proved byte for byte."""
    try:
        record = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise JournalCorrupt(str(path), "not a JSON line", value=seq) from error
    if not isinstance(record, dict) or record.keys() != KEYS:
        raise JournalCorrupt(str(path), "not a journal record", value=seq)
    if record["seq"] != seq or record["prev_sha"] != prev_sha:
        raise JournalCorrupt(str(path), "the chain is broken: records are missing, moved or altered", value=seq)
    body = {key: item for key, item in record.items() if key != "sha"}
    # Different texts can mean the same value (1e-05, 1E-05), so the bytes themselves are compared.
    if _sealed(body)[0] != line + b"\n":
        raise JournalCorrupt(str(path), "the content does not match its hash", value=seq)
    return record


def _is_whole(tail: bytes, seq: int, path: Path) -> bool:
    """Whether an unterminated tail is a whole JSON text; a text followed by more bytes is damage, not a cut."""
    try:
        _, end = json.JSONDecoder().raw_decode(tail.decode(errors="replace"))
    except (ValueError, RecursionError):
        return False
    if tail.decode(errors="replace")[end:]:
        raise JournalCorrupt(str(path), "bytes follow the record", value=seq)
    return True


def _recover(fd: int, path: Path) -> tuple[int, str]:
    """Verify an opened journal, drop a torn tail, end an unended last line; return (count, head)."""
    records, torn, unended = _parse(_content(path), path)
    try:
        if torn:
            os.ftruncate(fd, os.fstat(fd).st_size - torn)
            os.fdatasync(fd)
        if unended:
            _write_all(fd, b"\n")
            os.fdatasync(fd)
    except OSError as error:
        raise JournalUnwritable(str(path), error.strerror or str(error)) from error
    return len(records), records[-1]["sha"] if records else GENESIS


def _write_all(fd: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(fd, view) :]


def _lock(fd: int, path: Path) -> None:
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise JournalBusy(str(path), error.strerror or str(error)) from error


def _sync_directory(path: Path) -> None:
    """Make the name of a just created file durable."""
    try:
        fd = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)
    except OSError as error:
        raise JournalUnwritable(str(path), error.strerror or str(error)) from error


def _utc_now() -> datetime:
    return datetime.now(UTC)
