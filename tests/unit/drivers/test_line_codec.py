"""The line protocol as bytes: strict grammar, checksum, resynchronisation."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.line_codec import (
    LINE_MAX,
    AckLine,
    HeartbeatLine,
    IdentityLine,
    LineParser,
    PointLine,
    RefusalLine,
    Reply,
    crc16_arc,
    encode,
    parse_body,
    parse_line,
)
from sim.tracker.crc import checksum

PAGE = Path(__file__).parents[3] / "docs" / "line-protocol.md"
BODY = "PNT,2,82600000,N3,4123456,-876050,250000,22,31,30,1"


def framed(body: str) -> bytes:
    raw = body.encode()
    return b"$" + raw + f"*{crc16_arc(raw):04X}\r\n".encode()


def test_checksum_vectors() -> None:
    assert crc16_arc(b"123456789") == 0xBB3D
    assert crc16_arc(b"RESET") == 0xBE6F  # NDI's reset line ends in these digits
    assert crc16_arc(b"") == 0


@given(st.binary(max_size=700))
def test_the_checksum_is_that_of_the_devices_own_code(data: bytes) -> None:
    assert crc16_arc(data) == checksum(data)


def test_the_page_shows_true_lines() -> None:
    page = PAGE.read_text("utf-8")
    shown = re.findall(r"^    ([<>]) (\$.*)\\r\\n$", page, re.MULTILINE)
    assert len(shown) == 7
    for direction, text in shown:
        line = text.encode() + b"\r\n"
        assert line[1:-7].split(b"*")[0] == line[1:-7]
        assert line[-6:-2] == b"%04X" % crc16_arc(line[1:-7])
        if direction == "<":
            parse_line(line)
    octets = re.search(r"^    ((?:[0-9A-F]{2} )+0D 0A)$", page, re.MULTILINE)
    assert octets is not None
    assert bytes.fromhex(octets[1]) == encode("VER", 1)


def test_replies_are_read_field_by_field() -> None:
    assert parse_line(framed(BODY)) == PointLine(2, 82600000, "N3", (4123456, -876050, 250000), (22, 31, 30), 1)
    assert parse_body("ERR,9,10,no reflector found") == RefusalLine(9, 10, "no reflector found")
    assert parse_body("ACK,65535") == AckLine(65535)
    assert parse_body("HBT,4,1000000,2") == HeartbeatLine(4, 1000000, 2)
    assert parse_body("IDN,1,1,Maker,AT 500,77,2.1") == IdentityLine(1, 1, "Maker", "AT 500", "77", "2.1")


def test_requests_are_bytes_of_the_protocol() -> None:
    assert encode("MEA", 2, "N3", 1) == b"$MEA,2,N3,1*641A\r\n"
    with pytest.raises(ValueError):
        encode("MEA", 2, "N3,N4*", 1)
    with pytest.raises(ValueError):
        encode("MEA", 2, "N" * LINE_MAX, 1)


@pytest.mark.parametrize(
    "body",
    [
        BODY.replace("4123456", bad)
        for bad in ("nan", "inf", "1e400", "4123456.0", "4123,456", "+4123456", "0412", "-0", "", " 1", "1_000", "١")
    ]
    + [
        BODY.replace("N3", "N 3"),
        BODY.replace("N3", ""),
        BODY.replace(",30,", ",-30,"),
        BODY[:-1] + "32",
        BODY[:-1] + "01",
        BODY + ",0",
        BODY.lower(),
        "ACK,65536",
        "ACK,01",
        "HBT,1,5,3",
        "XYZ,1",
        "",
    ],
)
def test_grammar_is_strict(body: str) -> None:
    with pytest.raises(ValueError):
        parse_body(body)


def test_no_single_bit_flip_is_accepted() -> None:
    line = framed(BODY)
    for index in range(len(line)):
        for bit in range(8):
            flipped = bytearray(line)
            flipped[index] ^= 1 << bit
            parser = LineParser()
            assert parser.feed(bytes(flipped)) == [], (index, bit)
            # The line behind it is never lost with it.
            assert parser.feed(framed("ACK,5")) == [AckLine(5)], (index, bit)


def test_no_double_bit_flip_is_accepted_in_the_body() -> None:
    raw = bytearray(BODY.encode())
    crc = f"*{crc16_arc(bytes(raw)):04X}\r\n".encode()
    bits = [(i, b) for i in range(len(raw)) for b in range(8)]
    for first, (i, a) in enumerate(bits):
        for j, b in bits[first + 1 :: 7]:
            raw[i] ^= 1 << a
            raw[j] ^= 1 << b
            with pytest.raises(ValueError):
                parse_line(b"$" + raw + crc)
            raw[i] ^= 1 << a
            raw[j] ^= 1 << b


def test_a_line_cut_anywhere_does_not_cost_the_next() -> None:
    line = framed(BODY)
    for cut in range(len(line)):
        parser = LineParser()
        assert parser.feed(line[:cut] + line) == [parse_line(line)], cut


replies = st.one_of(
    st.builds(lambda s: f"ACK,{s}", st.integers(0, 65535)),
    st.builds(lambda s, t: f"HBT,{s},{t},1", st.integers(0, 65535), st.integers(0, 10**15)),
    st.builds(
        lambda s, x, y, z: f"PNT,{s},5,T-1,{x},{y},{z},1,2,3,1",
        st.integers(0, 65535),
        *[st.integers(-(10**8), 10**8)] * 3,
    ),
)
noise = st.binary(max_size=60).map(lambda b: b.replace(b"$", b"#"))
anything = st.binary(max_size=300)


@given(st.lists(st.tuples(noise, replies), max_size=8), st.lists(st.integers(1, 50), max_size=60))
def test_every_intact_line_is_recovered(items: list[tuple[bytes, str]], sizes: list[int]) -> None:
    stream = b"".join(before + framed(body) for before, body in items)
    parser, found, at = LineParser(), list[Reply](), 0
    for size in sizes:
        found += parser.feed(stream[at : at + size])
        at += size
    found += parser.feed(stream[at:])
    assert found == [parse_body(body) for _, body in items]
    assert parser.bad == 0
    assert parser.noise == sum(len(before) for before, _ in items)


@given(anything, st.lists(replies, min_size=1, max_size=4))
@settings(max_examples=300)
def test_after_any_garbage_no_whole_line_is_lost(garbage: bytes, bodies: list[str]) -> None:
    parser = LineParser()
    found = parser.feed(garbage)
    found += parser.feed(b"".join(framed(body) for body in bodies))
    assert found[-len(bodies) :] == [parse_body(body) for body in bodies]


@given(st.lists(anything, max_size=30))
def test_the_buffer_is_bounded(chunks: list[bytes]) -> None:
    parser = LineParser()
    for chunk in chunks:
        parser.feed(chunk)
        assert len(parser._rest) <= LINE_MAX


def test_an_endless_line_is_dropped() -> None:
    parser = LineParser()
    assert parser.feed(b"$PNT," + b"1" * 100_000) == []
    assert len(parser._rest) <= LINE_MAX
    assert parser.bad == 1
    assert parser.feed(framed("ACK,1")) == [AckLine(1)]
