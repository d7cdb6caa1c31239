"""Enabling and disabling the powered axes as one group: all together, or none."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import numpy as np

from docking.errors import EnableFailed
from drivers.canopen import cia402
from drivers.canopen.cia402 import DriveState, Goal
from drivers.canopen.cyclic import CyclicImage

FIRST_SET_POINT_MM = 0.01
SWITCH_ON_S = 0.5
ENABLE_S = 1.0
DISABLE_S = 1.5
FORCE_SETTLE_S = 1.0

_STANDING = (DriveState.SWITCHED_ON, DriveState.QUICK_STOP_ACTIVE, DriveState.OPERATION_ENABLED)
_OFF = (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT)
_FAULTS = (DriveState.FAULT, DriveState.FAULT_REACTION)

Step = Callable[[], Awaitable[None]]
"""Waits one cycle; raises when the link is lost or a quick stop interrupts."""


class PowerGroup:
    """Moves all axes under power through the CiA 402 states in step with the bus cycle.

    `step` lets one SYNC pass. `cause_of(index)` says in words why a drive is in fault. While an axis is not enabled its
    target is its own read-back.
    """

    def __init__(self, image: CyclicImage, step: Step, cause_of: Callable[[int], str]) -> None:
        self._image, self._step, self._cause_of = image, step, cause_of
        self._powered = image.powered

    async def enable(self, rest_mm: float, contact: float) -> None:
        """Enable all axes, each first commanded to where it stands or to press as hard as it does; then let those that
        hold a force come to it.

        Raises EnableFailed naming the first axis that did not come along; all are disabled again by then.
        `rest_mm` is how far an axis may lie from its first set-point once enabled, `contact` how much of its force an
        axis must carry before it may press.
        """
        try:
            self._check_contact(contact)
            await self._advance(cia402.SWITCH_ON, lambda i: self._image.state(i) in _STANDING, SWITCH_ON_S)
            self._image.aim_at_read_back()
            await self._step()
            self._check_first_set_points(FIRST_SET_POINT_MM)
            await self._advance(cia402.ENABLE_OPERATION, self._image.follows, ENABLE_S)
            self._check_first_set_points(rest_mm)
            await self._come_to_force()
        except EnableFailed:
            await self.disable()
            raise

    async def disable(self) -> None:
        """Disable all driven axes: brakes closed first, then the power stages.

        Raises EnableFailed naming an axis whose brake does not report closed; that axis keeps its torque.
        """
        loop = asyncio.get_running_loop()
        deadline = loop.time() + DISABLE_S
        while True:
            open_axes = [index for index in self._powered if self._image.state(index) not in _OFF]
            if not open_axes:
                self._image.command_all(cia402.DISABLE_VOLTAGE)
                return
            if not (loop.time() < deadline):
                raise self._failed(open_axes[0], "it could not be disabled; its brake is not reported closed")
            for index in self._powered:
                self._image.command(index, self._towards_off(index))
            await self._step()

    def _towards_off(self, index: int) -> int:
        state = self._image.state(index)
        return cia402.next_controlword(state, Goal.DISABLED, self._image.brake_closed(index))

    async def _advance(self, highest: int, done: Callable[[int], bool], limit_s: float) -> None:
        """Give every axis its next controlword, at most `highest`, until all are `done`."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + limit_s
        while True:
            waiting = [index for index in self._powered if not done(index)]
            if not waiting:
                return
            for index in waiting:
                if self._image.state(index) in _FAULTS:
                    raise self._failed(index, self._cause_of(index))
            if not (loop.time() < deadline):
                raise self._failed(waiting[0], f"not reached within {limit_s} s")
            for index in self._powered:
                self._image.command(index, self._towards_on(index, highest))
            await self._step()

    def _towards_on(self, index: int, highest: int) -> int:
        state = self._image.state(index)
        if state is DriveState.QUICK_STOP_ACTIVE and highest != cia402.ENABLE_OPERATION:
            return cia402.QUICK_STOP
        word = cia402.next_controlword(state, Goal.ENABLED, brake_closed=True)
        if state is DriveState.OPERATION_ENABLED:
            return word
        return min(word, highest)

    def _check_first_set_points(self, limit_mm: float) -> None:
        distance = np.abs(self._image.first_step_mm())
        if not (distance.max() <= limit_mm):
            worst = int(np.argmax(~(distance <= limit_mm)))
            cause = f"it stands {distance[worst]:.4f} mm from its first set-point, limit {limit_mm} mm"
            raise self._failed(self._powered[worst], cause)

    def _check_contact(self, contact: float) -> None:
        """An axis that carries nothing has no part to press against."""
        for index in self._image.forces.indices:
            carried, held = self._image.force_n(index), self._image.nodes[index].force_n or 0.0
            if not (carried >= contact * held):
                raise self._failed(index, f"its ball carries {carried:.0f} N, less than {contact * held:.0f} N")

    async def _come_to_force(self) -> None:
        """Let the forces run to what they shall be, and prove them on the load cells."""
        loop, forces = asyncio.get_running_loop(), self._image.forces
        deadline = loop.time() + forces.longest_s() + FORCE_SETTLE_S
        while waiting := [i for i in forces.indices if not (forces.arrived(i) and self._force_is_held(i))]:
            index = waiting[0]
            if self._image.state(index) is not DriveState.OPERATION_ENABLED:
                raise self._failed(index, self._cause_of(index))
            if not (loop.time() < deadline):
                node, reads = self._image.nodes[index], self._image.force_n(index)
                raise self._failed(index, f"its load cell reads {reads:.0f} N, {node.force_n:g} N shall be held")
            await self._step()

    def _force_is_held(self, index: int) -> bool:
        axis = self._image.nodes[index].axis
        held = axis.force_n or 0.0
        return abs(self._image.force_n(index) - held) <= axis.force_tolerance * held

    def _failed(self, index: int, cause: str) -> EnableFailed:
        return EnableFailed(self._image.nodes[index].name, cause, value=self._image.state(index).value)
