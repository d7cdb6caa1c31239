"""Bring-up of a GeoCOM instrument: who it is, and every setting written, then read back."""

from __future__ import annotations

from docking.config.instruments import AirConfig, GeocomConfig
from docking.errors import BadReply, DeviceRefused, ReadBackMismatch
from docking.types import Identity
from drivers.geocom_codec import (
    AUS_SET_USER_ATR,
    COM_GET_DOUBLE_PRECISION,
    COM_SET_DOUBLE_PRECISION,
    CSV_INSTRUMENT_NAME,
    CSV_INSTRUMENT_NO,
    CSV_SW_VERSION,
    MM_PER_M,
    NOT_OFFERED,
    TMC_GET_AIR,
    TMC_GET_PRISM,
    TMC_SET_AIR,
    TMC_SET_PRISM,
    GeocomReply,
    number,
    words,
)
from drivers.geocom_line import GeocomLine

DOUBLE_DIGITS = 12
PRISM_TOLERANCE_MM = 0.01
AIR_TOLERANCE = 0.05
"""Of a pressure (hPa) or a temperature (C) read back: instruments keep a digit or two."""


async def set_up(line: GeocomLine, settings: GeocomConfig) -> Identity:
    """Identify the instrument; set precision, target recognition, prism and air.

    Raises ReadBackMismatch where the instrument keeps another value, DeviceRefused, DeviceSilent or BadReply.
    """
    serial = _one(await line.ask(CSV_INSTRUMENT_NO))
    name = _one(await line.ask(CSV_INSTRUMENT_NAME))
    firmware = await _firmware(line)
    await line.ask(COM_SET_DOUBLE_PRECISION, DOUBLE_DIGITS)
    digits = _number(_one(await line.ask(COM_GET_DOUBLE_PRECISION)))
    if digits != DOUBLE_DIGITS:
        raise ReadBackMismatch("tracker", "decimals of a number", value=digits, limit=DOUBLE_DIGITS)
    await line.ask(AUS_SET_USER_ATR, 1)
    if settings.prism_mm is not None:
        await _set_prism(line, settings.prism_mm)
    if settings.air is not None:
        await _set_air(line, settings.air)
    return Identity("tracker", "Leica", words(name), words(serial), firmware)


async def _firmware(line: GeocomLine) -> str:
    """Release, version and sub-version; empty where the instrument does not tell."""
    try:
        return ".".join((await line.ask(CSV_SW_VERSION)).params)
    except DeviceRefused as refused:
        if refused.value != NOT_OFFERED:
            raise
        return ""


async def _set_prism(line: GeocomLine, prism_mm: float) -> None:
    await line.ask(TMC_SET_PRISM, prism_mm / MM_PER_M)
    kept_mm = _number(_one(await line.ask(TMC_GET_PRISM))) * MM_PER_M
    if not abs(kept_mm - prism_mm) <= PRISM_TOLERANCE_MM:
        raise ReadBackMismatch("tracker", "prism constant, mm", value=kept_mm, limit=prism_mm)


async def _set_air(line: GeocomLine, air: AirConfig) -> None:
    """The wavelength belongs to the instrument and is handed back as it came."""
    wavelength = _four(await line.ask(TMC_GET_AIR))[0]
    wanted = (air.pressure_hpa, air.dry_c, air.wet_c)
    await line.ask(TMC_SET_AIR, wavelength, *map(float, wanted))
    kept = _four(await line.ask(TMC_GET_AIR))[1:]
    for what, value, limit in zip(("pressure, hPa", "dry bulb, C", "wet bulb, C"), kept, wanted, strict=True):
        if not abs(value - limit) <= AIR_TOLERANCE:
            raise ReadBackMismatch("tracker", f"atmospheric correction: {what}", value=value, limit=limit)


def _one(reply: GeocomReply) -> str:
    """The one parameter of a reply."""
    if len(reply.params) != 1:
        raise BadReply("tracker", "one parameter expected", value=len(reply.params))
    return reply.params[0]


def _four(reply: GeocomReply) -> tuple[float, ...]:
    if len(reply.params) != 4:
        raise BadReply("tracker", "four parameters expected", value=len(reply.params))
    return tuple(_number(p) for p in reply.params)


def _number(param: str) -> float:
    try:
        return number(param)
    except ValueError as error:
        raise BadReply("tracker", str(error), value=param) from error
