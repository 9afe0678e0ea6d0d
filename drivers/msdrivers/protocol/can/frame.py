"""A CAN frame as it comes from the bus, and the reports of the interface itself."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

MAX_BASE_ID = 0x7FF
MAX_EXTENDED_ID = 0x1FFF_FFFF
MAX_DATA = 64
"""Bytes in a frame: 8 in classic CAN, 64 in CAN FD."""

BUS_OFF = 0x40
BUS_PASSIVE_OR_WARNING = 0x04
NO_ACKNOWLEDGE = 0x20
RESTARTED = 0x100
"""Classes of error in the identifier of an error frame, as Linux gives them (linux/can/error.h, CAN_ERR_*)."""


class FrameKey(NamedTuple):
    """What tells one kind of frame from another."""

    arbitration_id: int
    is_extended: bool = False

    def __str__(self) -> str:
        return f"0x{self.arbitration_id:08X}" if self.is_extended else f"0x{self.arbitration_id:03X}"


@dataclass(frozen=True, slots=True)
class CanFrame:
    """A frame of data, or with `is_error` a word of the interface about the bus.

    In an error frame `arbitration_id` holds the classes of error. `utime`: when it came, microseconds of the host's
    clock; 0: no more is known than when it was read. Frames of one content are equal whenever they came.
    """

    arbitration_id: int
    data: bytes = b""
    is_extended: bool = False
    is_error: bool = False
    utime: int = field(default=0, compare=False)

    @property
    def key(self) -> FrameKey:
        """What kind of frame this is."""
        return FrameKey(self.arbitration_id, self.is_extended)

    @property
    def is_bus_off(self) -> bool:
        """Whether the interface says that it has left the bus: too many of its frames failed."""
        return self.is_error and bool(self.arbitration_id & BUS_OFF)


def bus_off() -> CanFrame:
    """Return the word of an interface that it has left the bus."""
    return CanFrame(BUS_OFF, is_error=True)
