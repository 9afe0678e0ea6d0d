"""What the vehicle controller says, and what it is asked to do; see the wire types of the same names."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TypeAlias

from modelserver.messages.flags import NAN
from modelserver.messages.samples import Sample, SensorHeader


class VehicleMode(IntEnum):
    """Who drives; the numbers are those of the wire, MODE_UNKNOWN and so on."""

    UNKNOWN = 0
    MANUAL = 1
    AUTONOMOUS = 2
    EMERGENCY_STOP = 3
    FAULT = 4


@dataclass(frozen=True, slots=True)
class VehicleStatusSample:
    """What the vehicle controller says of itself; see vehicle_status_t."""

    header: SensorHeader
    mode: VehicleMode = VehicleMode.UNKNOWN
    forward_speed: float = NAN
    steering_angle: float = NAN
    supply_voltage: float = NAN
    engine_speed: float = NAN
    fault_bits: int = 0
    commands_refused: int = 0


@dataclass(frozen=True, slots=True)
class VehicleCommand:
    """A wish to the vehicle controller; see vehicle_command_t."""

    utime: int
    valid_for: float
    seq: int
    source: str
    forward_speed: float
    steering_angle: float


DeviceSample: TypeAlias = Sample | VehicleStatusSample
"""What a device can say: what the core takes, and what is for others on the bus alone."""
