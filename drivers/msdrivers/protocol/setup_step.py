"""A step in the configuration of a device."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SetupStep:
    """A configuration message, which the device acknowledges. `is_optional`: its rejection does not matter."""

    frame: bytes
    what: str
    is_optional: bool = False
