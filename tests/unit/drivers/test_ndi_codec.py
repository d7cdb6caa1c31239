"""The Combined API as bytes: published vectors, tracking data field by field, checksums, resynchronisation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.line_codec import crc16_arc
from drivers.ndi_codec import (
    REPLY_MAX,
    NdiParser,
    decode_reply,
    encode_command,
    parse_handles,
    parse_track,
    refusal,
)

SEEN = "+07071+00000-07071+00000-012050+003325-185000+00123"
TRACK = f"0302{SEEN}0000003100000A0B\n01MISSING0000003100000A0B\n03DISABLED0000001100000A0B\n"


def framed(text: str) -> bytes:
    return text.encode() + b"%04X\r" % crc16_arc(text.encode())


def test_commands_and_replies_carry_the_published_checksums() -> None:
    assert framed("RESET") == b"RESETBE6F\r"
    assert encode_command("INIT") == b"INIT:E3A5\r"
    assert encode_command("TX", "1001")[:-5] == b"TX:1001"
    assert decode_reply(b"OKAYA896") == "OKAY"
    for bad in (b"OKAYA897", b"OKAYa896", b"A896", b"", b"OKA", b"OK\x00" + b"%04X" % crc16_arc(b"OK\x00")):
        with pytest.raises(ValueError):
            decode_reply(bad)


def test_refusals() -> None:
    assert refusal("ERROR0C") == 0x0C
    assert refusal("OKAY") is None


def test_tracking_data_field_by_field() -> None:
    reply = parse_track(TRACK + "0002", strays=False)
    seen, missing, disabled = reply.tools
    np.testing.assert_allclose(seen.turn, (0.7071, 0.0, -0.7071, 0.0))
    np.testing.assert_allclose(seen.p_mm, (-120.5, 33.25, -1850.0))
    assert (seen.handle, seen.error_mm, seen.status, seen.frame) == ("02", 0.0123, 0x31, 0xA0B)
    assert (missing.word, disabled.word) == ("MISSING", "DISABLED")
    assert np.isnan(missing.p_mm).all()
    assert reply.status == 2
    assert len(reply.strays_mm) == 0


def test_markers_and_their_volume_flags() -> None:
    strays = "052" + "1" + "".join(f"{v:+07d}" for n in range(5) for v in (100 * n, -n, 5))
    # Five markers need two hexadecimal digits of flags: 21 marks the first and the sixth, which does not exist.
    reply = parse_track(TRACK + strays + "0000", strays=True)
    np.testing.assert_allclose(reply.strays_mm[4], (4.0, -0.04, 0.05))
    assert reply.outside == (True, False, False, False, False)
    assert parse_track("00000000", strays=True).strays_mm.shape == (0, 3)


@pytest.mark.parametrize(
    "text",
    [
        TRACK,
        TRACK + "00020",
        TRACK + "xyzw",
        TRACK.replace("MISSING", "MISSIN") + "0000",
        TRACK.replace("+07071", " 07071") + "0000",
        TRACK.replace("+07071", "+09999") + "0000",
        TRACK.replace("0302", "0402") + "0000",
        "",
        "zz",
    ],
)
def test_the_grammar_is_strict(text: str) -> None:
    with pytest.raises(ValueError):
        parse_track(text, strays=False)


def test_handles() -> None:
    assert parse_handles("02" + "01031" + "0A001") == {"01": 0x31, "0A": 0x01}
    assert parse_handles("00") == {}
    for bad in ("", "01", "0101", "0201031"):
        with pytest.raises(ValueError):
            parse_handles(bad)


def test_no_single_bit_flip_is_accepted() -> None:
    line = framed(TRACK + "0000")
    for bit in range(8 * len(line)):
        flipped = bytearray(line)
        flipped[bit // 8] ^= 1 << bit % 8
        parser = NdiParser()
        assert parser.feed(bytes(flipped)) == [], bit
        # What follows is read again from the next carriage return on.
        assert parser.feed(b"\r" + framed("OKAY")) == ["OKAY"], bit


texts = st.one_of(st.just("OKAY"), st.just(TRACK + "0000"), st.text("0123456789ABCDEF+-\n", max_size=60))


@given(st.lists(texts, max_size=8), st.lists(st.integers(1, 90), max_size=60))
def test_every_intact_reply_is_recovered(items: list[str], sizes: list[int]) -> None:
    stream = b"".join(framed(text) for text in items)
    parser, found, at = NdiParser(), list[str](), 0
    for size in sizes:
        found += parser.feed(stream[at : at + size])
        at += size
    found += parser.feed(stream[at:])
    assert found == items
    assert parser.bad == 0


@given(st.binary(max_size=200), st.lists(texts, min_size=1, max_size=4))
@settings(max_examples=300)
def test_noise_costs_no_more_than_the_reply_that_it_touches(garbage: bytes, items: list[str]) -> None:
    parser = NdiParser()
    found = parser.feed(garbage + b"".join(framed(text) for text in items))
    assert found[-(len(items) - 1) :] == items[1:] if len(items) > 1 else True


@given(st.lists(st.binary(max_size=6000), max_size=6), st.booleans())
def test_no_bytes_raise_and_the_buffer_is_bounded(chunks: list[bytes], strays: bool) -> None:
    parser = NdiParser()
    for chunk in chunks:
        parser.feed(chunk)
        assert len(parser._rest) <= REPLY_MAX


@given(st.text("0123456789ABCDEFMISGDL+-\n", max_size=200), st.booleans())
def test_no_text_raises_anything_but_value_error(text: str, strays: bool) -> None:
    try:
        reply = parse_track(text, strays)
    except ValueError:
        return
    assert np.isfinite(reply.strays_mm).all()
