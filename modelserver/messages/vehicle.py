"""What the vehicle controller is asked to do; see the wire type of the same name."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class VehicleCommand:
    """A wish to the vehicle controller; see vehicle_command_t."""

    utime: int
    valid_for: float
    seq: int
    source: str
    forward_speed: float
    steering_angle: float
