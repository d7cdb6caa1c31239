"""VectorNav ASCII as bytes: the manuals' examples, strict grammar, checksums, resynchronisation."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.vectornav_codec import (
    CRC_DIGITS,
    LINE_MAX,
    XOR_DIGITS,
    ErrorLine,
    Line,
    MotionLine,
    OtherLine,
    RegisterLine,
    VectorNavParser,
    checksum_text,
    crc16_ccitt,
    encode,
    parse_line,
)

YMR = "VNYMR,+010.071,+000.278,-002.026,+0.2500,+0.0000,-0.4000,+0.010,-0.020,-9.807,+0.000100,-0.000200,+0.000300"
IMU = "VNIMU,+0.2500,+0.0000,-0.4000,+0.010,-0.020,-9.807,+0.000100,-0.000200,+0.000300,+21.5,+101.325"


def framed(body: str, digits: int = XOR_DIGITS) -> bytes:
    return b"$" + body.encode() + b"*" + checksum_text(body.encode(), digits) + b"\r\n"


def test_the_lines_of_the_manuals() -> None:
    assert encode("VNRRG", 11) == b"$VNRRG,11*73\r\n"
    assert encode("VNRRG", 8) == b"$VNRRG,8*4B\r\n"
    assert encode("VNRRG", 5) == b"$VNRRG,5*46\r\n"
    assert encode("VNWRG", 5, 9600) == b"$VNWRG,5,9600*60\r\n"
    assert parse_line(b"$VNRRG,5,9600*65\r\n") == RegisterLine("VNRRG", 5, ("9600",))
    assert parse_line(b"$VNRRG,08,-114.314,+000.058,-001.773*5F\r\n") == RegisterLine(
        "VNRRG", 8, ("-114.314", "+000.058", "-001.773")
    )
    assert parse_line(b"$VNRRG,30,0,0,0,0,1,0,1*6C\r\n") == RegisterLine("VNRRG", 30, tuple("0000101"))
    assert parse_line(b"$VNERR,03*72\r\n") == ErrorLine(3)
    for line in (
        b"$VNYPR,+010.071,+000.278,-002.026*60\r\n",
        b"$VNYPR,+010.071,+000.278,-002.026,T1162704*2F\r\n",
        b"$VNYPR,+010.071,+000.278,-002.026,S0000*1F\r\n",
    ):
        assert parse_line(line) == OtherLine("VNYPR")


def test_crc_vector() -> None:
    assert crc16_ccitt(b"123456789") == 0x31C3
    assert crc16_ccitt(b"") == 0


def test_measurements_field_by_field() -> None:
    line = parse_line(framed(YMR + ",S00A0,T4294967295"))
    assert isinstance(line, MotionLine)
    assert line.values[6:9] == (0.01, -0.02, -9.807)
    assert line.values[9:] == (0.0001, -0.0002, 0.0003)
    assert (line.status, line.time_us) == (0xA0, 2**32 - 1)
    plain = parse_line(framed(IMU, CRC_DIGITS))
    assert isinstance(plain, MotionLine)
    assert (plain.kind, plain.values[3:6], plain.status, plain.time_us) == ("VNIMU", (0.01, -0.02, -9.807), None, None)


@pytest.mark.parametrize(
    "body",
    [YMR.replace("-9.807", bad) for bad in ("nan", "inf", "-inf", "1e400", "-9,807", "", " 1", "0x10", "9.", "1_0")]
    + [
        YMR + ",T4294967296",
        YMR + ",T12,S0000",
        YMR + ",+1.0",
        YMR[:-10],
        "VNRRG",
        "VNRRG,x",
        "VNERR,3",
        "VNERR",
        "GPGGA,1",
    ],
)
def test_the_grammar_is_strict(body: str) -> None:
    with pytest.raises(ValueError):
        parse_line(framed(body))


def test_only_the_form_in_use_is_taken() -> None:
    for mine, other in ((XOR_DIGITS, CRC_DIGITS), (CRC_DIGITS, XOR_DIGITS)):
        parse_line(framed(YMR, mine), mine)
        with pytest.raises(ValueError, match="form"):
            parse_line(framed(YMR, other), mine)
    with pytest.raises(ValueError, match="form"):
        parse_line(b"$" + YMR.encode() + b"\r\n")


@pytest.mark.parametrize("digits", [XOR_DIGITS, CRC_DIGITS])
@pytest.mark.parametrize("body", [YMR + ",T123456", IMU])
def test_no_single_bit_flip_is_accepted(body: str, digits: int) -> None:
    line = framed(body, digits)
    for bit in range(8 * len(line)):
        flipped = bytearray(line)
        flipped[bit // 8] ^= 1 << bit % 8
        parser = VectorNavParser()
        parser.digits = digits
        assert parser.feed(bytes(flipped)) == [], bit
        assert parser.feed(framed("VNERR,01", digits)) == [ErrorLine(1)], bit


def test_a_line_cut_anywhere_does_not_cost_the_next() -> None:
    line = framed(YMR)
    for cut in range(len(line)):
        assert VectorNavParser().feed(line[:cut] + line) == [parse_line(line)], cut


bodies = st.sampled_from([YMR, YMR + ",T5", IMU, "VNRRG,1,VN-100", "VNERR,0C", "VNYPR,1,2,3"])
noise = st.binary(max_size=60).map(lambda b: b.replace(b"$", b"#"))


@given(
    st.lists(st.tuples(noise, bodies, st.sampled_from([2, 4])), max_size=8), st.lists(st.integers(1, 90), max_size=60)
)
def test_every_intact_line_is_recovered(items: list[tuple[bytes, str, int]], sizes: list[int]) -> None:
    stream = b"".join(before + framed(body, digits) for before, body, digits in items)
    parser, found, at = VectorNavParser(), list[Line](), 0
    for size in sizes:
        found += parser.feed(stream[at : at + size])
        at += size
    found += parser.feed(stream[at:])
    assert found == [parse_line(framed(body)) for _, body, _ in items]
    assert parser.bad == 0


@given(st.binary(max_size=300), st.lists(bodies, min_size=1, max_size=4))
@settings(max_examples=300)
def test_after_any_garbage_no_whole_line_is_lost(garbage: bytes, items: list[str]) -> None:
    parser = VectorNavParser()
    found = parser.feed(garbage)
    found += parser.feed(b"".join(framed(body) for body in items))
    assert found[-len(items) :] == [parse_line(framed(body)) for body in items]


@given(st.lists(st.binary(max_size=400), max_size=20))
def test_no_bytes_raise_and_the_buffer_is_bounded(chunks: list[bytes]) -> None:
    parser = VectorNavParser()
    for chunk in chunks:
        parser.feed(chunk)
        assert len(parser._rest) <= LINE_MAX
