"""GeoCOM as bytes: the manual's examples, numbers, polar geometry in both faces, resynchronisation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.geocom_codec import (
    LINE_MAX,
    GeocomParser,
    GeocomReply,
    decode_reply,
    encode_request,
    number,
    point_from_polar,
    polar_from_point,
    words,
)
from drivers.line_codec import crc16_arc

REPLY = b"%R1P,0,7:0,1.234567890123,1.570796326795,9.000123456789"


def test_requests_as_the_manual_writes_them() -> None:
    assert encode_request(0, 3, ()) == b"%R1Q,0,3:\r\n"
    assert encode_request(9027, 12, (0.5, 1.5, 0, 0, 0)) == b"%R1Q,9027,12:0.500000000000,1.500000000000,0,0,0\r\n"
    assert encode_request(9027, 1, (1e-9, 1.0, 0, 0, 0)).startswith(b"%R1Q,9027,1:0.000000001000,")


def test_replies_as_the_manual_writes_them() -> None:
    date = decode_reply(b"%R1P,0,0:0,1996,'07','19','10','13','2f'")
    assert date == GeocomReply(0, 0, 0, ("1996", "'07'", "'19'", "'10'", "'13'", "'2f'"))
    assert decode_reply(b"%R1P,0,5:0") == GeocomReply(0, 5, 0, ())
    assert decode_reply(b"%R1P,3081,5:0").com == 3081
    assert decode_reply(b"%R1P,0,5:1285,1.5,1.6,0.0").rc == 1285


def test_a_quoted_comma_does_not_split() -> None:
    reply = decode_reply(rb'%R1P,0,1:0,"TM30, 0.5\" \\ x",7')
    assert reply.params == (r'"TM30, 0.5\" \\ x"', "7")
    assert words(reply.params[0]) == 'TM30, 0.5" \\ x'
    with pytest.raises(ValueError):
        decode_reply(b'%R1P,0,1:0,"open,7')


def test_checksum_form() -> None:
    bare = b"%R1P,0,7:0,1.5"
    line = b"%%R1P,0,7,%d:0,1.5" % crc16_arc(bare)
    assert decode_reply(line, checksum=True).params == ("1.5",)
    with pytest.raises(ValueError, match="without"):
        decode_reply(bare, checksum=True)
    for index in range(len(line)):
        for bit in range(8):
            flipped = bytearray(line)
            flipped[index] ^= 1 << bit
            with pytest.raises(ValueError):
                decode_reply(bytes(flipped), checksum=True)
    request = encode_request(2108, 7, (3000, 1), checksum=True)
    assert request == b"%%R1Q,2108,7,%d:3000,1\r\n" % crc16_arc(b"%R1Q,2108,7:3000,1")


@pytest.mark.parametrize(
    "bad", ["nan", "inf", "-inf", "1e400", "1,5", "0x10", "", " 1", "1.", ".5", "1_0", "--1", "1e999"]
)
def test_numbers_are_strict(bad: str) -> None:
    with pytest.raises(ValueError):
        number(bad)


def test_numbers() -> None:
    assert number("-1.5e-3") == -0.0015
    assert number("12") == 12.0


def test_polar_axes() -> None:
    # North is Hz 0, east is a quarter turn clockwise, the zenith is V 0.
    assert polar_from_point([0.0, 1000.0, 0.0], 1) == pytest.approx((0.0, math.pi / 2))
    assert polar_from_point([1000.0, 0.0, 0.0], 1) == pytest.approx((math.pi / 2, math.pi / 2))
    assert polar_from_point([0.0, 0.0, 1000.0], 1)[1] == pytest.approx(0.0)
    assert polar_from_point([0.0, 1000.0, 0.0], 2) == pytest.approx((math.pi, 3 * math.pi / 2))
    half = point_from_polar(math.pi / 2, math.pi / 3, 2.0)
    np.testing.assert_allclose(half, [1732.0508075688772, 0.0, 1000.0], atol=1e-9)


@given(*[st.floats(-20_000.0, 20_000.0).filter(lambda v: abs(v) > 1.0)] * 3, st.sampled_from([1, 2]))
def test_polar_round_trip_in_both_faces(x: float, y: float, z: float, face: int) -> None:
    hz, v = polar_from_point([x, y, z], face)
    assert 0.0 <= hz < 2.0 * math.pi
    assert (v > math.pi) == (face == 2)
    slope_m = math.sqrt(x * x + y * y + z * z) / 1000.0
    np.testing.assert_allclose(point_from_polar(hz, v, slope_m), [x, y, z], atol=1e-8)


noise = st.binary(max_size=40).filter(lambda b: b"%R1P," not in b)


@given(st.lists(st.tuples(noise, st.integers(0, 32767)), max_size=8), st.lists(st.integers(1, 40), max_size=60))
@settings(max_examples=300)
def test_every_intact_reply_is_recovered(items: list[tuple[bytes, int]], sizes: list[int]) -> None:
    stream = b"".join(before + b"%R1P,0," + str(trid).encode() + b":0,1.5\r\n" for before, trid in items)
    parser, found, at = GeocomParser(), list[GeocomReply](), 0
    for size in sizes:
        found += parser.feed(stream[at : at + size])
        at += size
    found += parser.feed(stream[at:])
    assert [r.trid for r in found] == [trid for _, trid in items]


@given(st.lists(st.binary(max_size=700), max_size=20))
def test_no_bytes_raise_and_the_buffer_is_bounded(chunks: list[bytes]) -> None:
    parser = GeocomParser()
    for chunk in chunks:
        parser.feed(chunk)
        assert len(parser._rest) <= LINE_MAX


def test_a_reply_cut_anywhere_does_not_cost_the_next() -> None:
    for cut in range(len(REPLY)):
        parser = GeocomParser()
        replies = parser.feed(REPLY[:cut] + REPLY + b"\r\n")
        assert replies == [decode_reply(REPLY)], cut
