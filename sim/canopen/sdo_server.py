"""SDO server of one simulated node: expedited and segmented transfers, aborts."""

from __future__ import annotations

import struct
from typing import Protocol

from sim.canopen.dictionary import Abort

_TOGGLE = 0x0503_0000
_UNKNOWN_COMMAND = 0x0504_0001
_LENGTH = 0x0607_0010


class Objects(Protocol):
    """An object dictionary; both methods may raise Abort."""

    def read(self, index: int, sub: int) -> bytes: ...

    def write(self, index: int, sub: int, data: bytes) -> None: ...


class SdoServer:
    """Answers one request frame (8 bytes) at a time."""

    def __init__(self, dictionary: Objects) -> None:
        self._dictionary = dictionary
        self._address = (0, 0)
        self._sending = b""
        self._receiving: bytearray | None = None
        self._announced = 0
        self._toggle = 0

    def answer(self, frame: bytes) -> bytes | None:
        """The answer to a client's frame; None where the protocol wants silence."""
        if len(frame) != 8 or frame[0] >> 5 == 4:
            self._sending, self._receiving = b"", None
            return None
        specifier = frame[0] >> 5
        if specifier in (1, 2):
            index, sub = struct.unpack_from("<HB", frame, 1)
            self._address = (index, sub)
        try:
            if specifier == 1:
                return self._download(frame)
            if specifier == 2:
                return self._upload()
            if specifier == 0:
                return self._download_segment(frame)
            if specifier == 3:
                return self._upload_segment(frame)
            raise Abort(_UNKNOWN_COMMAND)
        except Abort as abort:
            self._sending, self._receiving = b"", None
            return struct.pack("<BHBI", 0x80, *self._address, abort.code)

    def _upload(self) -> bytes:
        data = self._dictionary.read(*self._address)
        if 1 <= len(data) <= 4:
            return struct.pack("<BHB", 0x43 | (4 - len(data)) << 2, *self._address) + data.ljust(4, b"\x00")
        self._sending, self._toggle = data, 0
        return struct.pack("<BHBI", 0x41, *self._address, len(data))

    def _upload_segment(self, frame: bytes) -> bytes:
        self._check_toggle(frame[0])
        chunk, self._sending = self._sending[:7], self._sending[7:]
        head = self._toggle << 4 | (7 - len(chunk)) << 1 | int(not self._sending)
        self._toggle ^= 1
        return bytes((head,)) + chunk.ljust(7, b"\x00")

    def _download(self, frame: bytes) -> bytes:
        command = frame[0]
        if command & 2:
            size = 4 - (command >> 2 & 3) if command & 1 else 4
            self._dictionary.write(*self._address, frame[4 : 4 + size])
        else:
            self._receiving, self._toggle = bytearray(), 0
            self._announced = int(struct.unpack_from("<I", frame, 4)[0]) if command & 1 else 0
        return struct.pack("<BHB4x", 0x60, *self._address)

    def _download_segment(self, frame: bytes) -> bytes:
        if self._receiving is None:
            raise Abort(_UNKNOWN_COMMAND)
        self._check_toggle(frame[0])
        self._receiving += frame[1 : 8 - (frame[0] >> 1 & 7)]
        if frame[0] & 1:
            data, self._receiving = bytes(self._receiving), None
            if self._announced and len(data) != self._announced:
                raise Abort(_LENGTH)
            self._dictionary.write(*self._address, data)
        reply = bytes((0x20 | self._toggle << 4,)) + bytes(7)
        self._toggle ^= 1
        return reply

    def _check_toggle(self, command: int) -> None:
        if command >> 4 & 1 != self._toggle:
            raise Abort(_TOGGLE)
