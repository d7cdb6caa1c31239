"""Deals out the frames of a bus that are no read-backs: SDO answers, heartbeats, emergencies, foreign set-points."""

from __future__ import annotations

from collections.abc import Sequence

from docking.ports import CanFrame
from drivers.canopen import codec
from drivers.canopen.bring_up import NodeBringUp
from drivers.canopen.cyclic import CyclicImage
from drivers.canopen.watch import NodeWatch


class Router:
    """COB-ID -> what it is and whose."""

    def __init__(self, setups: Sequence[NodeBringUp], image: CyclicImage, watch: NodeWatch) -> None:
        self._setups, self._watch = setups, watch
        self._routes: dict[int, tuple[str, int]] = {}
        for node in (setup.node for setup in setups):
            self._routes[codec.COB_SDO_REPLY + node.node] = ("sdo", node.index)
            self._routes[codec.COB_HEARTBEAT + node.node] = ("heartbeat", node.index)
            self._routes[codec.COB_EMERGENCY + node.node] = ("emergency", node.index)
        for cob, index in zip(image.set_point_cobs, image.powered, strict=True):
            self._routes[cob] = ("foreign", index)

    def take(self, frames: Sequence[CanFrame], now_s: float) -> None:
        """Frames with other identifiers pass by."""
        for cob, data in frames:
            route = self._routes.get(cob)
            if route is None:
                continue
            kind, index = route
            if kind == "sdo":
                self._setups[index].sdo.on_reply(data)
            elif kind == "heartbeat":
                self._watch.on_heartbeat(index, data, now_s)
            elif kind == "emergency":
                self._watch.on_emergency(index, data)
            else:
                self._watch.on_foreign(index)
