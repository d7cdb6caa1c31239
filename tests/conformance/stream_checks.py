"""What every streaming sensor keeps (`docking.ports.PointStream`, `InertialSensor`), whoever implements it."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np


class Stream:
    """A sensor of either port, with what it has reported."""

    def __init__(self, sensor: Any) -> None:
        self.sensor = sensor
        self.heard: list[Any] = []
        self.lost: list[Exception] = []
        self.sink = "on_frame" if hasattr(sensor, "on_frame") else "on_sample"
        setattr(sensor, self.sink, self.heard.append)
        sensor.on_lost = self.lost.append


async def says_who_it_is(stream: Stream) -> None:
    identity = await stream.sensor.connect()
    assert identity.where
    assert identity.vendor
    assert identity.serial


async def is_silent_until_it_is_started_and_after_it_is_stopped(stream: Stream) -> None:
    await stream.sensor.connect()
    await asyncio.sleep(0.3)
    assert not stream.heard
    await stream.sensor.start()
    await asyncio.sleep(0.8)
    await stream.sensor.stop()
    count = len(stream.heard)
    assert count >= 2
    await asyncio.sleep(0.3)
    assert len(stream.heard) == count
    assert not stream.lost


async def tells_when_each_report_was_taken(stream: Stream) -> None:
    await stream.sensor.connect()
    await stream.sensor.start()
    await asyncio.sleep(1.0)
    now_s = asyncio.get_running_loop().time()
    taken_s = [report.t_s for report in stream.heard]
    assert all(np.diff(taken_s) > 0.0)
    assert all(report.t_s <= report.received_s <= now_s for report in stream.heard)
    assert all(report.received_s - report.t_s < 0.5 for report in stream.heard)


async def can_be_started_again_and_joined_again(stream: Stream) -> None:
    await stream.sensor.connect()
    for _ in range(2):
        await stream.sensor.start()
        await asyncio.sleep(0.5)
        await stream.sensor.stop()
        assert stream.heard
        stream.heard.clear()
    await stream.sensor.close()
    await stream.sensor.connect()
    await stream.sensor.start()
    await asyncio.sleep(0.5)
    assert stream.heard
    assert not stream.lost


CHECKS: tuple[Callable[[Stream], Awaitable[None]], ...] = (
    says_who_it_is,
    is_silent_until_it_is_started_and_after_it_is_stopped,
    tells_when_each_report_was_taken,
    can_be_started_again_and_joined_again,
)
