"""`python -m tests.fuzz PARSER [libFuzzer options]`: one parser of the serial drivers under coverage-guided fuzzing.

Any byte string, in any pieces: no exception, a bounded buffer, and a good frame behind it is found. What crashes is
kept in the working directory; run the same command with its path to see it again. Needs the extra `fuzz` (atheris).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import atheris

with atheris.instrument_imports():
    from drivers.geocom_codec import GeocomParser, number
    from drivers.line_codec import LineParser, crc16_arc
    from drivers.ndi_codec import NdiParser, parse_handles, parse_track
    from drivers.vectornav_codec import VectorNavParser, xor8

BUFFER_MAX = 8192


def _framed(body: bytes) -> bytes:
    return b"$" + body + b"*%04X\r\n" % crc16_arc(body)


def _whole(parser: Any, data: bytes, good: bytes) -> Any:
    """Feed `data` in pieces whose sizes it chooses itself, then a good frame; what was found last."""
    size = data[0] % 64 + 1 if data else 1
    found: list[Any] = []
    for at in range(0, len(data), size):
        found += parser.feed(data[at : at + size])
        assert len(parser._rest) <= BUFFER_MAX
    found += parser.feed(good)
    return found[-1] if found else None


def line(data: bytes) -> None:
    last = _whole(LineParser(), data, _framed(b"ACK,5"))
    assert last is not None
    assert last.seq == 5


def geocom(data: bytes) -> None:
    for checksum in (False, True):
        bare = b"%R1P,0,7:0,1.5"
        crc = b",%d" % crc16_arc(bare) if checksum else b""
        last = _whole(GeocomParser(checksum), data, b"%R1P,0,7" + crc + b":0,1.5\r\n")
        assert last is not None
        assert last.trid == 7
    for field in data.decode("latin-1").split(","):
        try:
            assert abs(number(field)) < float("inf")
        except ValueError:
            continue


def ndi(data: bytes) -> None:
    # A reply has no mark at its start: the one right behind noise may be lost, the next is not.
    assert _whole(NdiParser(), data, b"\rOKAYA896\r") == "OKAY"
    text = data.decode("latin-1")
    for parse in (lambda: parse_track(text, True), lambda: parse_track(text, False), lambda: parse_handles(text)):
        try:
            parse()
        except ValueError:
            continue


def vectornav(data: bytes) -> None:
    body = b"VNERR,01"
    last = _whole(VectorNavParser(), data, b"$" + body + b"*%02X\r\n" % xor8(body))
    assert getattr(last, "code", None) == 1


PARSERS: dict[str, Callable[[bytes], None]] = {"line": line, "geocom": geocom, "ndi": ndi, "vectornav": vectornav}


def main() -> None:
    if len(sys.argv) < 2 or sys.argv[1] not in PARSERS:
        sys.exit(f"which parser: {', '.join(PARSERS)}")
    atheris.Setup([sys.argv[0], *sys.argv[2:]], PARSERS[sys.argv[1]])
    atheris.Fuzz()


if __name__ == "__main__":
    main()
