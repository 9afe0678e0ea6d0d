"""CAN frames and the error frames of the interface."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

BUS_OFF = 0x40
"""Class of error in the identifier of an error frame, as Linux gives it (linux/can/error.h, CAN_ERR_BUSOFF)."""


class FrameKey(NamedTuple):
    """Identifier of a kind of frame."""

    arbitration_id: int
    is_extended: bool = False

    def __str__(self) -> str:
        return f"0x{self.arbitration_id:08X}" if self.is_extended else f"0x{self.arbitration_id:03X}"


@dataclass(frozen=True, slots=True)
class CanFrame:
    """A data frame, or with `is_error` an error frame of the interface.

    In an error frame `arbitration_id` holds the error classes. `utime`: receive time by the host's clock, microseconds;
    0: unknown. Frames are compared by content only.
    """

    arbitration_id: int
    data: bytes = b""
    is_extended: bool = False
    is_error: bool = False
    utime: int = field(default=0, compare=False)

    @property
    def key(self) -> FrameKey:
        return FrameKey(self.arbitration_id, self.is_extended)

    @property
    def is_bus_off(self) -> bool:
        """Whether the interface reports bus-off: too many of its frames failed."""
        return self.is_error and bool(self.arbitration_id & BUS_OFF)


def make_bus_off_frame() -> CanFrame:
    """Make the error frame of an interface that went bus-off."""
    return CanFrame(BUS_OFF, is_error=True)
