"""What every streaming sensor keeps (`docking.ports.PointStream`, `InertialSensor`), whoever implements it."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import pytest

from docking.errors import LinkError


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


async def refuses_to_start_when_it_is_not_connected(stream: Stream) -> None:
    with pytest.raises(LinkError) as refused:
        await stream.sensor.start()
    assert refused.value.code
    assert not stream.heard


async def closes_at_any_time(stream: Stream) -> None:
    await stream.sensor.close()
    await stream.sensor.connect()
    await stream.sensor.start()
    await stream.sensor.close()
    await stream.sensor.close()
    count = len(stream.heard)
    await asyncio.sleep(0.3)
    assert len(stream.heard) == count
    assert not stream.lost


async def survives_a_connect_that_is_given_up(stream: Stream) -> None:
    task = asyncio.ensure_future(stream.sensor.connect())
    await asyncio.sleep(0.005)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    await stream.sensor.close()
    await stream.sensor.connect()
    await stream.sensor.start()
    for _ in range(50):
        await asyncio.sleep(0.1)
        if stream.heard:
            return
    pytest.fail("nothing within 5 s")


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
    refuses_to_start_when_it_is_not_connected,
    closes_at_any_time,
    survives_a_connect_that_is_given_up,
)
