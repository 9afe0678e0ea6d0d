"""Encode NMEA 0183 sentences, as a receiver does."""

from __future__ import annotations

from collections.abc import Sequence

import pynmea2


def encode(talker: str, kind: str, fields: Sequence[str]) -> bytes:
    """Return a sentence with its checksum and end of line."""
    return str(pynmea2.TalkerSentence(talker, kind, fields)).encode("ascii") + b"\r\n"


def format_angle(degrees: float, sides: str, digits: int) -> tuple[str, str]:
    """Return `dddmm.mmmmmmm` with as many digits of whole degrees, and the hemisphere's letter; empty for nan."""
    if degrees != degrees:
        return "", ""
    # whole ten-millionths of a minute, so that no 60 minutes come out of rounding
    whole, part = divmod(round(abs(degrees) * 60e7), 60 * 10_000_000)
    text = f"{whole:0{digits}d}{part // 10_000_000:02d}.{part % 10_000_000:07d}"
    return text, sides[0] if degrees >= 0.0 else sides[1]


def format_time_of_day(microseconds: int) -> str:
    """Return `hhmmss.sss`, up to 23:59:60.999."""
    seconds, fraction = divmod(microseconds, 1_000_000)
    leap = max(0, seconds - 86_399)
    hours, rest = divmod(seconds - leap, 3600)
    return f"{hours:02d}{rest // 60:02d}{rest % 60 + leap:02d}.{fraction // 1000:03d}"


def format_number(value: float, digits: int) -> str:
    """Return a decimal; empty for nan."""
    return "" if value != value else f"{value:.{digits}f}"
