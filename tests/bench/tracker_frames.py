"""P1: tracker frames a second from bytes to checked nouns, against the line itself and against pyserial's readline."""

from __future__ import annotations

import os
import pty
import statistics
import threading
import time
import tty

import serial

from drivers.line_codec import LineParser, crc16_arc
from tests.bench.metric import Metric, Sizes, median_ratio, side_by_side

BAUD = 115200
CHUNK = 4096
"""What one read of a busy port returns."""


def measure(sizes: Sizes) -> list[Metric]:
    lines = [_line(i) for i in range(sizes.tracker_frames)]
    data = b"".join(lines)
    times = side_by_side(
        {"ours": lambda: _parse(data, len(lines)), "readline": lambda: _readline(lines)}, sizes.repeats
    )
    # The line is as fast on a busy machine as on an idle one: beside it stands the time of the processor.
    ours = statistics.median(_cpu_s(data, len(lines)) for _ in range(sizes.repeats))
    theirs = statistics.median(times["readline"])
    line_rate = BAUD / 10.0 / (len(data) / len(lines))
    rate = len(lines) / ours
    return [
        Metric(
            "P1",
            "tracker frames, bytes to checked points, a second of CPU",
            f"{rate:.0f}/s",
            f"the line at {BAUD} baud {line_rate:.1f}/s",
            rate / line_rate,
            500.0,
        ),
        Metric(
            "P1",
            "the same against reading the lines only",
            f"{len(lines) / statistics.median(times['ours']):.0f}/s",
            f"pyserial readline over a pty {len(lines) / theirs:.0f}/s",
            median_ratio(times["readline"], times["ours"]),
            50.0,
        ),
    ]


def _line(i: int) -> bytes:
    """A point of 100 bytes, as long as the protocol's names and numbers commonly make it."""
    body = b"PNT,%d,%d,TARGET_UPPER_LEFT_%02d,%d,%d,%d,%d,%d,%d,1" % (
        i % 65536, 82_600_000_000 + 10_000 * i, i % 100, 14_123_456 + i, -8_876_050 - i, 1_250_000 + i, 122, 131, 130,
    )  # fmt: skip
    return b"$" + body + b"*%04X\r\n" % crc16_arc(body)


def _cpu_s(data: bytes, count: int) -> float:
    began_s = time.process_time()
    _parse(data, count)
    return time.process_time() - began_s


def _parse(data: bytes, count: int) -> None:
    parser, found = LineParser(), 0
    for at in range(0, len(data), CHUNK):
        found += len(parser.feed(data[at : at + CHUNK]))
    assert found == count


def _readline(lines: list[bytes]) -> None:
    """What a first driver does: open the port, readline. Nothing is checked or parsed."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    with serial.Serial(os.ttyname(slave), BAUD, timeout=5.0) as port:
        writer = threading.Thread(target=_write, args=(master, b"".join(lines)))
        writer.start()
        assert all(port.readline() == line for line in lines)
        writer.join()
    os.close(master)
    os.close(slave)


def _write(master: int, data: bytes) -> None:
    while data:
        data = data[os.write(master, data[:CHUNK]) :]
