"""The messages between the cell process and the motion process: nouns to bytes and back, errors included.

One message is a header and a body, little-endian:

    "DM"   version u16   length of the body u32   body

The body is (kind, number, payload). Every value begins with one letter that says what follows: N none, T true, F false,
i int64, d float64, s text, a array of float64, b array of bool, t sequence, m mapping, o noun (name, fields in their
order), e member of an enumeration (its name, the member's), S states of axes, x error (class, where, cause, value,
limit). The same bytes cross a socket in production and a queue in virtual time.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache, lru_cache
from typing import Any, Final

import numpy as np

from docking import types
from docking.errors import BadReply, Defect, DockingError
from docking.types import AxisState

VERSION: Final = 1
HEADER: Final = struct.Struct("<2sHI")
LARGEST: Final = 1 << 28
"""Bytes of a body: a plan of a day at 100 Hz for 24 axes has fewer."""
WHERE: Final = "motion process"

_MAGIC: Final = b"DM"
_U32, _I64, _F64 = struct.Struct("<I"), struct.Struct("<q"), struct.Struct("<d")
_NOUNS: Final[dict[str, Any]] = {name: noun for name, noun in vars(types).items() if is_dataclass(noun)}
_ENUMS: Final = {name: kind for name, kind in vars(types).items() if isinstance(kind, type) and issubclass(kind, Enum)}
_FIELDS: Final = {noun: tuple(f.name for f in fields(noun)) for noun in _NOUNS.values()}
_STATES: Final = tuple(AxisState)
_STATE_NUMBER: Final = {state: number for number, state in enumerate(_STATES)}


def encode(kind: str, number: int, payload: Any = None) -> bytes:
    """One message: what it is, which call it belongs to (0: none), and what it carries."""
    parts: list[bytes] = []
    for value in (kind, number, payload):
        _put(value, parts)
    body = b"".join(parts)
    return HEADER.pack(_MAGIC, VERSION, len(body)) + body


def decode(message: bytes) -> tuple[str, int, Any]:
    """(kind, number, payload). Raises BadReply for anything that `encode` does not make."""
    length = body_length(message)
    if len(message) != HEADER.size + length:
        raise BadReply(WHERE, f"a message of {len(message)} bytes says {length}")
    reader = _Reader(message, HEADER.size)
    try:
        kind, number, payload = reader.take(), reader.take(), reader.take()
    except (struct.error, LookupError, ValueError, TypeError) as error:
        raise BadReply(WHERE, f"not a message of this program: {error}") from error
    if reader.at != len(message) or not isinstance(kind, str) or not isinstance(number, int):
        raise BadReply(WHERE, "not a message of this program")
    return kind, number, payload


def body_length(head: bytes | bytearray) -> int:
    """Length of the body that follows a header. Raises BadReply for another program's or version's header."""
    if len(head) < HEADER.size:
        raise BadReply(WHERE, f"{len(head)} bytes are no header")
    magic, version, length = HEADER.unpack_from(head)
    if magic != _MAGIC or version != VERSION or length > LARGEST:
        raise BadReply(WHERE, f"not a message of version {VERSION}", value=f"{magic!r} {version}")
    return int(length)


# to bytes ----------------------------------------------------------------------------------------------------------
def _put(value: Any, out: list[bytes]) -> None:
    writer = _WRITERS.get(type(value))
    if writer is not None:
        writer(value, out)
    elif isinstance(value, BaseException):
        _put_error(value, out)
    elif isinstance(value, Enum):
        out.append(b"e")
        _put_text(type(value).__name__, out)
        _put_text(value.name, out)
    elif isinstance(value, np.integer | np.floating | np.bool_):
        _put(value.item(), out)
    else:
        raise TypeError(f"no message carries a {type(value).__name__}")


def _put_text(value: str, out: list[bytes]) -> None:
    raw = value.encode()
    out.append(b"s" + _U32.pack(len(raw)) + raw)


def _put_array(value: np.ndarray[Any, Any], out: list[bytes]) -> None:
    boolean = value.dtype == np.bool_
    raw = np.ascontiguousarray(value, dtype=np.bool_ if boolean else "<f8")
    shape = struct.pack(f"<B{raw.ndim}I", raw.ndim, *raw.shape)
    out.append((b"b" if boolean else b"a") + shape)
    out.append(raw.tobytes())


def _put_sequence(value: tuple[Any, ...] | list[Any], out: list[bytes]) -> None:
    if value and type(value[0]) is AxisState:
        out.append(_state_bytes(tuple(value)))
        return
    out.append(b"t" + _U32.pack(len(value)))
    for item in value:
        _put(item, out)


@lru_cache(maxsize=256)
def _state_bytes(states: tuple[AxisState, ...]) -> bytes:
    return b"S" + _U32.pack(len(states)) + bytes(_STATE_NUMBER[state] for state in states)


def _put_mapping(value: dict[str, Any], out: list[bytes]) -> None:
    out.append(b"m" + _U32.pack(len(value)))
    for key, item in value.items():
        _put_text(key, out)
        _put(item, out)


def _put_noun(value: Any, out: list[bytes]) -> None:
    noun = type(value)
    out.append(b"o")
    _put_text(noun.__name__, out)
    for name in _FIELDS[noun]:
        _put(getattr(value, name), out)


def _put_error(error: BaseException, out: list[bytes]) -> None:
    """An error of the program itself travels as the Defect that it is."""
    if not isinstance(error, DockingError):
        error = Defect("motion", f"{type(error).__name__}: {error}")
    out.append(b"x")
    for item in (type(error).__name__, error.where, error.cause, error.value, error.limit):
        _put(item, out)


_WRITERS: Final[dict[type, Callable[[Any, list[bytes]], None]]] = {
    type(None): lambda value, out: out.append(b"N"),
    bool: lambda value, out: out.append(b"T" if value else b"F"),
    int: lambda value, out: out.append(b"i" + _I64.pack(value)),
    float: lambda value, out: out.append(b"d" + _F64.pack(value)),
    str: _put_text,
    np.ndarray: _put_array,
    tuple: _put_sequence,
    list: _put_sequence,
    dict: _put_mapping,
    **dict.fromkeys(_NOUNS.values(), _put_noun),
}


# from bytes --------------------------------------------------------------------------------------------------------
class _Reader:
    """Takes value after value from `data`, beginning at `at`."""

    def __init__(self, data: bytes, at: int) -> None:
        self._data, self.at = data, at

    def take(self) -> Any:
        letter = self._data[self.at : self.at + 1]
        self.at += 1
        return _READERS[letter](self)

    def number(self, layout: struct.Struct) -> Any:
        (value,) = layout.unpack_from(self._data, self.at)
        self.at += layout.size
        return value

    def raw(self) -> bytes:
        length = self.number(_U32)
        value = self._data[self.at : self.at + length]
        if len(value) != length:
            raise ValueError("cut short")
        self.at += length
        return value

    def text(self) -> str:
        return self.raw().decode()

    def array(self, dtype: str, size: int) -> np.ndarray[Any, Any]:
        """An array on a copy of its bytes: read-only, and the message need not live on."""
        data, at = self._data, self.at + 1
        dimensions = data[self.at]
        shape = struct.unpack_from(f"<{dimensions}I", data, at)
        at += 4 * dimensions
        self.at = at + size * math.prod(shape)
        raw = data[at : self.at]
        if len(raw) != self.at - at:
            raise ValueError("cut short")
        value = np.frombuffer(raw, dtype)
        return value if dimensions == 1 else value.reshape(shape)

    def sequence(self) -> tuple[Any, ...]:
        return tuple([self.take() for _ in range(self.number(_U32))])

    def mapping(self) -> dict[str, Any]:
        return {self.take(): self.take() for _ in range(self.number(_U32))}

    def noun(self) -> Any:
        noun = _NOUNS[self.take()]
        return noun(*[self.take() for _ in _FIELDS[noun]])

    def member(self) -> Enum:
        kind = _ENUMS[self.take()]
        member: Enum = kind[self.take()]
        return member

    def error(self) -> DockingError:
        name, where, cause, value, limit = (self.take() for _ in range(5))
        kind = _error_classes()[name]
        error = kind.__new__(kind)
        DockingError.__init__(error, where, cause, value=value, limit=limit)
        return error


@lru_cache(maxsize=256)
def _states_of(raw: bytes) -> tuple[AxisState, ...]:
    return tuple(_STATES[number] for number in raw)


_READERS: Final[dict[bytes, Callable[[_Reader], Any]]] = {
    b"N": lambda reader: None,
    b"T": lambda reader: True,
    b"F": lambda reader: False,
    b"i": lambda reader: reader.number(_I64),
    b"d": lambda reader: reader.number(_F64),
    b"s": _Reader.text,
    b"a": lambda reader: reader.array("<f8", 8),
    b"b": lambda reader: reader.array("?", 1),
    b"t": _Reader.sequence,
    b"m": _Reader.mapping,
    b"o": _Reader.noun,
    b"e": _Reader.member,
    b"S": lambda reader: _states_of(reader.raw()),
    b"x": _Reader.error,
}


@cache
def _error_classes() -> dict[str, type[DockingError]]:
    """All errors of the tree by name."""
    found: dict[str, type[DockingError]] = {}
    waiting = [DockingError]
    while waiting:
        kind = waiting.pop()
        found[kind.__name__] = kind
        waiting += kind.__subclasses__()
    return found
