"""A simulated camera pair's vision computer: pixels of both cameras, sent as they are exposed, with noise.

Projection by its own formulas. Faults are attributes of `faults`, to be set while it runs.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from docking.config.live import StereoCameraConfig
from sim.shapes import pose_of
from sim.tracker.crc import checksum
from sim.tracker.faults import FaultySender, WireFaults
from sim.wires.pacing import DeviceEnd

Array = NDArray[np.float64]
Scene = Callable[[float], dict[str, Array]]
"""Loop time -> points (3,) in W by name."""


@dataclass
class PairFaults(WireFaults):
    """Run-time faults; each stays until it is set back."""

    blind: set[str] = field(default_factory=set)
    """cameras that see nothing"""
    occluded: bool = False
    """neither camera sees anything"""


class PixelPairComputer:
    """On `wire`, from the start on: `rate_hz` exposures a second of `scene`; `seed` drives the noise."""

    kind = "camera"

    def __init__(
        self,
        scene: Scene,
        cameras: tuple[StereoCameraConfig, ...],
        wire: DeviceEnd,
        loop: asyncio.AbstractEventLoop,
        rate_hz: float,
        seed: int = 0,
    ) -> None:
        self.faults = PairFaults()
        self._scene, self._cameras, self._loop, self._period_s = scene, cameras, loop, 1.0 / rate_hz
        self._out = FaultySender(wire, loop, self.faults, seed)
        self._rng = np.random.default_rng([seed, 77])
        self._number, self._on_since_s = 0, loop.time()
        self._timer = loop.call_soon(self._expose)

    def close(self) -> None:
        """Switch it off."""
        self._timer.cancel()

    def _expose(self) -> None:
        now_s = self._loop.time()
        self._number += 1
        points = self._scene(now_s)
        us = round((now_s - self._on_since_s) * 1e6)
        for camera in self._cameras:
            lost = self.faults.occluded or camera.name in self.faults.blind
            seen = {} if lost else {name: self._pixel(camera, p) for name, p in points.items()}
            marks = "".join(f",{name},{uv[0]:.3f},{uv[1]:.3f}" for name, uv in seen.items() if uv is not None)
            body = f"PX,{camera.name},{self._number},{us}{marks}".encode("ascii")
            crc = checksum(body) ^ (1 if self.faults.bad_crc else 0)
            self._out.send(b"$" + body + b"*%04X\r\n" % crc)
        self._timer = self._loop.call_at(self._on_since_s + self._number * self._period_s, self._expose)

    def _pixel(self, camera: StereoCameraConfig, p_W: Array) -> Array | None:
        x, y, z = pose_of(camera.pose).inverse().apply(p_W)
        if z <= 0.0:
            return None
        k1, k2, p1, p2, *more = camera.distortion
        a, b = x / z, y / z
        r2 = a * a + b * b
        radial = 1.0 + k1 * r2 + k2 * r2**2 + (more[0] if more else 0.0) * r2**3
        u = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)
        v = b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b
        pixel = np.array([camera.fx_px * u + camera.cx_px, camera.fy_px * v + camera.cy_px])
        if not (0.0 <= pixel[0] < camera.width_px and 0.0 <= pixel[1] < camera.height_px):
            return None
        result: Array = pixel + camera.pixel_sigma * self._rng.standard_normal(2)
        return result
