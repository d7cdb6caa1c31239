"""What every `docking.ports.Tracker` keeps, whoever implements it: the checks of the conformance suite."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

import numpy as np
import pytest

from docking.errors import LinkError, LinkLost, TargetLost
from docking.ports import Tracker
from docking.types import Array, Reading


@dataclass(frozen=True)
class Subject:
    """A tracker that is not connected yet, and where its reflectors are about: name -> (3,) mm in its own frame.

    `hidden` is a name (and a direction) where there is no reflector.
    """

    tracker: Tracker
    points: dict[str, Array]
    hidden: tuple[str, Array]


async def _connected(subject: Subject) -> None:
    await subject.tracker.connect()


def _judge(reading: Reading, name: str, near_mm: Array, face: int) -> None:
    assert (reading.target, reading.face) == (name, face)
    assert np.isfinite(reading.p_T_mm).all()
    np.testing.assert_allclose(reading.p_T_mm, near_mm, atol=25.0)
    np.testing.assert_allclose(reading.cov_mm2, reading.cov_mm2.T)
    assert np.all(np.linalg.eigvalsh(reading.cov_mm2) > 0.0)


async def says_who_it_is(subject: Subject) -> None:
    identity = await subject.tracker.connect()
    assert identity.where == "tracker"
    assert identity.product
    assert identity.serial


async def measures_every_point_with_its_covariance_and_time(subject: Subject) -> None:
    await _connected(subject)
    loop = asyncio.get_running_loop()
    for name, near_mm in subject.points.items():
        begun_s = loop.time()
        reading = await subject.tracker.measure(name, near_mm)
        _judge(reading, name, near_mm, 1)
        assert begun_s <= reading.t_s <= loop.time()


async def agrees_with_itself_in_both_faces(subject: Subject) -> None:
    await _connected(subject)
    name, near_mm = next(iter(subject.points.items()))
    faces = (1, 2) if subject.tracker.two_face else (1, 1)
    readings = [await subject.tracker.measure(name, near_mm, face) for face in faces]
    for reading, face in zip(readings, faces, strict=True):
        _judge(reading, name, near_mm, face)
    gap_mm = float(np.linalg.norm(readings[0].p_T_mm - readings[1].p_T_mm))
    sigma_mm = float(np.sqrt(np.trace(readings[0].cov_mm2 + readings[1].cov_mm2)))
    assert gap_mm <= max(0.5, 6.0 * sigma_mm)
    assert readings[1].t_s > readings[0].t_s


async def says_that_there_is_no_reflector(subject: Subject) -> None:
    await _connected(subject)
    name, near_mm = subject.hidden
    with pytest.raises(TargetLost) as caught:
        await subject.tracker.measure(name, near_mm)
    assert caught.value.where == name
    known, known_mm = next(iter(subject.points.items()))
    _judge(await subject.tracker.measure(known, known_mm), known, known_mm, 1)


async def takes_one_measurement_after_the_other(subject: Subject) -> None:
    await _connected(subject)
    names = list(subject.points)[:3]
    readings = await asyncio.gather(*(subject.tracker.measure(n, subject.points[n]) for n in names))
    for name, reading in zip(names, readings, strict=True):
        _judge(reading, name, subject.points[name], 1)


async def survives_a_measurement_that_is_given_up(subject: Subject) -> None:
    await _connected(subject)
    first, second = list(subject.points)[:2]
    task = asyncio.ensure_future(subject.tracker.measure(first, subject.points[first]))
    await asyncio.sleep(0.02)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    _judge(await subject.tracker.measure(second, subject.points[second]), second, subject.points[second], 1)


async def refuses_when_closed_and_can_be_opened_again(subject: Subject) -> None:
    name, near_mm = next(iter(subject.points.items()))
    with pytest.raises(LinkLost):
        await subject.tracker.measure(name, near_mm)
    await _connected(subject)
    await subject.tracker.close()
    with pytest.raises(LinkError):
        await subject.tracker.measure(name, near_mm)
    await _connected(subject)
    _judge(await subject.tracker.measure(name, near_mm), name, near_mm, 1)


CHECKS: tuple[Callable[[Subject], Awaitable[None]], ...] = (
    says_who_it_is,
    measures_every_point_with_its_covariance_and_time,
    agrees_with_itself_in_both_faces,
    says_that_there_is_no_reflector,
    takes_one_measurement_after_the_other,
    survives_a_measurement_that_is_given_up,
    refuses_when_closed_and_can_be_opened_again,
)
