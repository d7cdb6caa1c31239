"""CRC-16/ARC as the devices compute it: the remainder of each byte looked up, least significant bit first."""

from __future__ import annotations

GENERATOR = 0xA001
"""x^16 + x^15 + x^2 + 1, bits reversed."""


def _remainder(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ GENERATOR * (byte & 1)
    return byte


_REMAINDERS = [_remainder(byte) for byte in range(256)]


def checksum(text: bytes) -> int:
    """The register after `text`, started at 0, not inverted."""
    register = 0
    for byte in text:
        register = register >> 8 ^ _REMAINDERS[(register & 0xFF) ^ byte]
    return register
