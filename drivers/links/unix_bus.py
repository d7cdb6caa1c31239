"""python-can interface `docking-unix`: a CAN bus over an AF_UNIX socket, for machines without SocketCAN.

`channel` is the path of a SEQPACKET socket (`docking sim` serves one). Each packet is one frame in the layout of Linux'
`struct can_frame`. The socket keeps the order and loses nothing.
"""

from __future__ import annotations

import select
import socket
import struct
from typing import Any

import can

_RECORD = struct.Struct("=IB3x8s")
_EXTENDED, _REMOTE, _ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000


class UnixBus(can.BusABC):
    """One station on the bus. Registered as entry point `can.interface`: `docking-unix`."""

    def __init__(self, channel: str, can_filters: Any = None, **kwargs: Any) -> None:
        """Connect to the socket at `channel`; can.CanInitializationError where nobody serves it."""
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._socket.connect(channel)
        except OSError as error:
            self._socket.close()
            # Keeps the destructor of the base class from calling for a shutdown of what never opened.
            self._is_shutdown = True
            raise can.CanInitializationError(f"{channel}: {error.strerror}", error.errno) from error
        self.channel_info = f"docking-unix {channel}"
        super().__init__(channel, can_filters=can_filters, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one data frame; can.CanOperationError when the far end is gone or takes nothing."""
        flags = (_EXTENDED if msg.is_extended_id else 0) | (_REMOTE if msg.is_remote_frame else 0)
        record = _RECORD.pack(msg.arbitration_id | flags, msg.dlc, bytes(msg.data))
        try:
            self._socket.send(record, 0 if timeout else socket.MSG_DONTWAIT)
        except OSError as error:
            raise can.CanOperationError(f"cannot send: {error.strerror}", error.errno) from error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if timeout != 0:
            ready, _, _ = select.select([self._socket], [], [], timeout)
            if not ready:
                return None, False
        try:
            record = self._socket.recv(64, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return None, False
        except OSError as error:
            raise can.CanOperationError(f"cannot receive: {error.strerror}", error.errno) from error
        if not record:
            raise can.CanOperationError("the far end closed the bus")
        if len(record) != _RECORD.size:
            return None, False
        return _message(record), False

    def fileno(self) -> int:
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Leave the bus."""
        super().shutdown()
        self._socket.close()


def _message(record: bytes) -> can.Message:
    identifier, length, data = _RECORD.unpack(record)
    return can.Message(
        arbitration_id=identifier & 0x1FFF_FFFF,
        is_extended_id=bool(identifier & _EXTENDED),
        is_remote_frame=bool(identifier & _REMOTE),
        is_error_frame=bool(identifier & _ERROR),
        dlc=min(length, 8),
        data=data[: min(length, 8)],
    )
